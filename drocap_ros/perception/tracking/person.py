"""One person seen in the image, the subject or a bystander."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.tracking.appearance import similarity
from drocap_ros.perception.tracking.motion import BoxMotion

#: Share of a new look taken into the remembered one.
_LOOK_RATE = 0.08
#: Images after which the remembered look is settled.
_LOOK_SETTLED = 10


#: Share of a new score in the quality.
_QUALITY_RATE = 0.3


class Person:
    """Motion, look and history of one person.

    seen_ns : last detection; sure_ns : last one that was certain
    quality : recent mean of the detection score: low for parts of somebody and for clutter
    """

    def __init__(self, box: np.ndarray, score: float, stamp_ns: int, look: np.ndarray | None) -> None:
        self.motion = BoxMotion(box, stamp_ns)
        self.box = np.asarray(box, float)
        self.first_ns = stamp_ns
        self.seen_ns = stamp_ns
        self.sure_ns = stamp_ns
        self.score = score
        self.quality = score
        self.hits = 1
        self.look = look
        self._looks = 1 if look is not None else 0

    def gap_s(self, stamp_ns: int) -> float:
        """Seconds since the person was last seen."""
        return (stamp_ns - self.seen_ns) * 1e-9

    def unsure_s(self, stamp_ns: int) -> float:
        """Seconds since the person was surely seen."""
        return (stamp_ns - self.sure_ns) * 1e-9

    def see(self, box: np.ndarray, score: float, stamp_ns: int) -> None:
        """Take in a doubtful detection; :meth:`assure` makes it a sure one."""
        self.motion.update(box)
        self.box = np.asarray(box, float)
        self.seen_ns = stamp_ns
        self.score = score
        self.quality += _QUALITY_RATE * (score - self.quality)
        self.hits += 1

    def assure(self, stamp_ns: int) -> None:
        """Note that it was surely the person, not clutter."""
        self.seen_ns = self.sure_ns = stamp_ns

    def learn_look(self, look: np.ndarray | None) -> None:
        """Blend a look into the remembered one, faster at first."""
        if look is None:
            return
        self._looks += 1
        if self.look is None:
            self.look = look
            return
        rate = max(_LOOK_RATE, 1 / self._looks) if self._looks < _LOOK_SETTLED else _LOOK_RATE
        # The squares are the histograms; blending these keeps their sum.
        self.look = np.sqrt((1 - rate) * self.look**2 + rate * look**2)

    @property
    def look_settled(self) -> bool:
        """Whether the remembered look is a mean over enough images."""
        return self._looks >= _LOOK_SETTLED

    def likeness(self, look: np.ndarray | None) -> float:
        """Similarity to a look in [0, 1]."""
        return similarity(self.look, look)
