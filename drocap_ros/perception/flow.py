"""Keypoints carried from one picture to the next by optical flow: what is done where there is no time for the network.

Pyramidal Lucas-Kanade (Bouguet 2001) around each joint, there and back again (forward-backward error, Kalal et al.
2010).  From one picture to the next of a video at 30 Hz, joints that come back to within 0.2 % of the box are
carried as well as the network repeats itself: median 0.3 to 0.6 % of the box, 1 to 2 % at the 90th percentile.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from drocap_ros.observation import PoseObservation
from drocap_ros.perception.detection.letterbox import shrink

#: The box's longer side is brought to this many px, no smaller picture is enlarged.
_SIDE_PX = 192
#: Seen around the box, shares of its longer side.
_MARGIN = 0.25
_WINDOW_PX, _LEVELS = (15, 15), 2
#: Share of the box's longer side by which a joint may miss its start on the way back.
_MISSED = 0.01
#: Standard deviation that a carried joint has more, same unit, beside what it missed its start by.
_SIGMA = 0.005
#: Share of the joints seen before that have to arrive; else the picture is another one, or too blurred.
_ARRIVED = 0.5
#: Longest time between the two pictures.
_LONGEST_S = 0.1


@dataclass(frozen=True)
class _Seen:
    observation: PoseObservation
    region: tuple[int, int, int, int]
    view: np.ndarray
    length: float


class KeypointFlow:
    """Finds one picture's keypoints in the next.

    Attributes
    ----------
    steps : pictures through which the keypoints have come since the network saw them
    """

    def __init__(self) -> None:
        self.steps = 0
        self._seen: _Seen | None = None

    def begin(self, image: np.ndarray | None, observation: PoseObservation | None) -> None:
        """Keep what is needed of a picture (H, W, 3) uint8 BGR and of what the network saw in it; None = nothing."""
        self.steps = 0
        self._seen = None if image is None or observation is None else _seen(image, observation)

    def carry(self, image: np.ndarray, stamp_ns: int) -> PoseObservation | None:
        """The same subject in the next picture; None when that cannot be.

        Joints that were lost are NaN, the box goes with the others; covariances grow by the flow's own error, scores
        and confidences stay.
        """
        seen = self._seen
        size = (image.shape[1], image.shape[0])
        if seen is None or size != seen.observation.image_size:
            return None
        before = seen.observation
        if not 0 < (stamp_ns - before.stamp_ns) * 1e-9 <= _LONGEST_S:
            return None
        known = np.isfinite(before.keypoints).all(axis=1)
        view = _view(image, seen.region, seen.length)
        origin = np.array(seen.region[:2], float)
        scale = np.array([view.shape[1], view.shape[0]]) / (np.array(seen.region[2:]) - origin)
        start = ((before.keypoints[known] - origin) * scale).astype(np.float32)
        there, found = _follow(seen.view, view, start)
        back, found_back = _follow(view, seen.view, there)
        missed = np.linalg.norm((back - start) / scale, axis=1) / seen.length
        moved = there / scale + origin
        arrived = found & found_back & (missed <= _MISSED) & ((moved >= 0) & (moved < size)).all(axis=1)
        if arrived.sum() < _ARRIVED * known.sum():
            return None
        joints = np.nonzero(known)[0][arrived]
        keypoints = np.full_like(before.keypoints, np.nan)
        covariance = np.full_like(before.covariance, np.nan)
        confidence = np.zeros_like(before.confidence)
        keypoints[joints] = moved[arrived]
        variance = ((_SIGMA**2 + missed[arrived] ** 2) * seen.length**2)[:, None]
        covariance[joints] = before.covariance[joints] + variance * np.array([1.0, 0.0, 1.0])
        confidence[joints] = before.confidence[joints]
        shift = np.median(keypoints[joints] - before.keypoints[joints], axis=0)
        roi = np.clip(before.roi + np.tile(shift, 2), 0, np.tile(size, 2)).astype(np.float32)
        observation = dataclasses.replace(
            before, stamp_ns=stamp_ns, roi=roi, keypoints=keypoints, covariance=covariance, confidence=confidence
        )
        self.steps += 1
        self._seen = _seen(image, observation)
        return observation


def _seen(image: np.ndarray, observation: PoseObservation) -> _Seen | None:
    """What is needed to follow the observed joints from this picture on; None when there are none."""
    if not observation.has_subject or not np.isfinite(observation.keypoints).any():
        return None
    box = observation.roi.astype(float)
    length = float((box[2:] - box[:2]).max())
    low = np.clip(np.floor(box[:2] - _MARGIN * length), 0, None)
    high = np.minimum(np.ceil(box[2:] + _MARGIN * length), observation.image_size)
    if (high - low).min() <= 2 * max(_WINDOW_PX):
        return None
    region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return _Seen(observation, region, _view(image, region, length), length)


def _follow(view: np.ndarray, later: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) float32 px in the later view, and whether they were found (N,)."""
    import cv2

    there, found, _ = cv2.calcOpticalFlowPyrLK(view, later, points, points.copy(), winSize=_WINDOW_PX, maxLevel=_LEVELS)
    return np.asarray(there), np.asarray(found)[:, 0] == 1


def _view(image: np.ndarray, region: tuple[int, int, int, int], length: float) -> np.ndarray:
    """The region in grey, the person ``_SIDE_PX`` long at most."""
    import cv2

    x0, y0, x1, y1 = region
    grey = cv2.cvtColor(image[y0:y1, x0:x1], cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _SIDE_PX / length)
    return shrink(grey, (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))))
