"""Belief in a track by the confidence of its poses: a shadow, a sign or a tree has no believable joints."""

from __future__ import annotations

import numpy as np

#: Mean confidence of the joints of a believable pose: on boxes without a person below 0.33, on shadows 0.2 to 0.6, on
#: persons in bad light or from steeply above 0.5 to 0.9.
EMPTY_CONFIDENCE, CONFIRM_CONFIDENCE = 0.33, 0.5
#: Confidence from which a pose is certainly a person's.
SURE_CONFIDENCE = 0.7
#: A pose below this share of the track's usual confidence is not believed: persons of 0.9 do not stay at 0.6.
_USUAL_SHARE = 0.7
_USUAL_RATE, _LENGTH_RATE, _RATE = 0.1, 0.1, 0.3
#: Mean confidence of a track without a person.
_IMPLAUSIBLE = 0.45
#: Time of poses without belief after which a track is questioned, and after which one without a person is dropped.
_QUESTION_S, _DROP_S = 1.0, 2.5


class PoseBelief:
    """History of the pose confidence of one track.

    length : px, usual longer side of the believable boxes; partly hidden persons have shorter ones
    value, last : recent mean of the confidence, and that of the last pose; NaN before the first one
    judged_ns : last pose; believed_ns, box : last believable one and its box (4,) px, None = none yet
    plausible_ns : from when on the track was a person, as far as its poses show; None = it is none
    other : whether track and subject were certainly persons at the same time, hence two of them
    """

    def __init__(self, stamp_ns: int) -> None:
        self.value = self.last = float("nan")
        self.judged_ns: int | None = None
        self.believed_ns: int | None = None
        self.box: np.ndarray | None = None
        self.plausible_ns: int | None = stamp_ns
        self.other = False
        self.length = 0.0
        self._usual = 0.0
        self._failing_ns: int | None = None

    def judge(self, confidence: float, box: np.ndarray, stamp_ns: int, blurred: bool = False) -> None:
        """Add a pose by its mean confidence, found in a box (4,) px; a weak one in a blurred image says nothing."""
        if blurred and confidence < CONFIRM_CONFIDENCE:
            self.judged_ns = stamp_ns
            return
        first = np.isnan(self.value) or (self.plausible_ns is None and confidence >= CONFIRM_CONFIDENCE)
        self.value = confidence if first else self.value + _RATE * (confidence - self.value)
        self.last, self.judged_ns = confidence, stamp_ns
        if confidence >= max(CONFIRM_CONFIDENCE, _USUAL_SHARE * self._usual):
            self.choose(box, stamp_ns)
            self._usual = confidence if not self._usual else self._usual + _USUAL_RATE * (confidence - self._usual)
            return
        if self._failing_ns is None:
            self._failing_ns = stamp_ns
        if self.value < _IMPLAUSIBLE:
            self.plausible_ns = None

    def choose(self, box: np.ndarray, stamp_ns: int) -> None:
        """Believe a box (4,) px that a user or a drone's tracker gave, whatever its pose."""
        self.believed_ns, self.box, self._failing_ns = stamp_ns, np.array(box, float), None
        if self.plausible_ns is None:
            self.plausible_ns = stamp_ns
        length = float((self.box[2:] - self.box[:2]).max())
        self.length = length if not self.length else self.length + _LENGTH_RATE * (length - self.length)

    def growth(self, box: np.ndarray, length: float) -> float:
        """Absolute logarithm of the size of a box (4,) px over the last or the usual one, whichever is nearer.

        length : px, of the person before there is a believable box
        """
        size = max(float((box[2:] - box[:2]).max()), 1.0)
        known = [length] if self.box is None else [self.length, float((self.box[2:] - self.box[:2]).max())]
        return min(abs(float(np.log(size / max(value, 1.0)))) for value in known)

    def refute(self, confidence: float, stamp_ns: int) -> None:
        """Mark the track as no person, by a pose that lost against another one."""
        self.value, self.last, self.judged_ns, self.plausible_ns = confidence, confidence, stamp_ns, None
        self._failing_ns = stamp_ns

    @property
    def believed(self) -> bool:
        """Whether the last pose was believable; a track without poses is believed."""
        return self._failing_ns is None

    @property
    def questioned(self) -> bool:
        """Whether the poses have not been believable for a second."""
        return self._fails(_QUESTION_S)

    @property
    def refuted(self) -> bool:
        """Whether the poses have shown for seconds that there is no person."""
        return self._fails(_DROP_S) and self.value < _IMPLAUSIBLE

    def _fails(self, seconds: float) -> bool:
        if self._failing_ns is None or self.judged_ns is None:
            return False
        return (self.judged_ns - self._failing_ns) * 1e-9 >= seconds
