"""Fixed points of the scene and the camera's motion by them: a step of an image that may run beside the last one's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drocap_ros.background import FixedPoints
from drocap_ros.perception.background_tracks import BackgroundTracks
from drocap_ros.perception.tracking.camera_motion import CameraMotion, moved_box

JITTER_NS = 5_000_000  # by which an image may come earlier than at its rate
_COMPARED_ROWS = 4  # every so many rows tell whether an image is the last one again,
_FIRST_ROWS = 64  # and every so many of them, compared first, mostly that it is not
_SELDOM_NS = 100_000_000 - JITTER_NS  # between two steps of a machine that is too slow, whose camera does not pan


class SceneStep(NamedTuple):
    """The scene in one image.

    points : fixed points, without those on persons; None in an image that was left out, or is the last one again:
        points that stand still would say that the camera does
    motion : (2, 3) of the image by the camera's since the last one; None where it is small or unknown
    again : whether the image is the last one again
    """

    points: FixedPoints | None
    motion: np.ndarray | None
    again: bool = False


class Scene:
    """Follows the scene through images; equal images and boxes give equal steps."""

    def __init__(self) -> None:
        self._background, self._camera = BackgroundTracks(), CameraMotion()
        self._rows: np.ndarray | None = None
        self._last_ns, self._followed_ns = 0, -_SELDOM_NS
        self._motion: np.ndarray | None = None

    def step(
        self, image: np.ndarray, stamp_ns: int, persons: Sequence[np.ndarray], *, seldom: bool = False
    ) -> SceneStep:
        """The scene in the next image (H, W, 3) uint8 BGR; an earlier stamp than the last one starts a new scene.

        persons : boxes (4,) px of two images ago, so that this image need not wait for the last one's persons
        seldom : images within a tenth of a second are left out, while the camera's motion is small
        """
        rows = image[::_COMPARED_ROWS]
        if stamp_ns >= self._last_ns and self._again(rows):
            self._last_ns, self._motion = stamp_ns, None
            return SceneStep(None, None, again=True)
        if stamp_ns < self._last_ns:
            self._background.reset()
            self._camera.reset()
            self._motion = None
        self._rows, self._last_ns = rows.copy(), stamp_ns
        if seldom and self._motion is None and 0 <= stamp_ns - self._followed_ns < _SELDOM_NS:
            return SceneStep(None, None)
        self._followed_ns = stamp_ns
        last = self._background.points
        now = self._background.follow(image)
        before, self._motion = self._motion, self._camera.update(last, now, (image.shape[1], image.shape[0]))
        boxes = list(persons)
        for motion in (before, self._motion):
            if motion is not None:
                boxes = [moved_box(motion, box) for box in boxes]
        return SceneStep(self._background.renew(boxes, stamp_ns), self._motion)

    def _again(self, rows: np.ndarray) -> bool:
        """Whether rows of an image (N, W, 3) are those of the last one."""
        last = self._rows
        return last is not None and all(np.array_equal(rows[::step], last[::step]) for step in (_FIRST_ROWS, 1))
