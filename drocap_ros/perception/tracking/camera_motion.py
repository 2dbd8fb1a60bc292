"""Motion of the image by the camera's own: a pan or a shake moves the ground, and with it the places of all persons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Longer side (px) of the image in which it is measured, and points of the ground.
_SIDE_PX, _POINTS = 480, 150
#: Quality of the points over the best one's, and their least distance (px).
_QUALITY, _APART_PX = 0.01, 8
#: Window and pyramid levels of the optical flow.
_WINDOW_PX, _LEVELS = (15, 15), 4
#: Points that agree on a motion: distance (px) up to which they do, least number and share of them, and the share that
#: makes it certain.
_AGREE_PX, _LEAST, _SHARE, _CERTAIN = 2.0, 15, 0.4, 0.7
#: Largest change of the size between two images.
_MOST_ZOOM = 1.5


class CameraMotion:
    """Similarity transform from the last image to the present one: optical flow of points, and their consensus."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the last image."""
        self._last = None

    def update(self, image: np.ndarray, persons: Sequence[np.ndarray]) -> np.ndarray | None:
        """Motion since the last image.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        persons : (4,) px each, boxes of the last image, whose points do not belong to the ground

        Returns
        -------
        (2, 3) transform of pixels; None for the first image, without persons, or where too few points agree.
        """
        import cv2

        scale = min(1.0, _SIDE_PX / max(image.shape[:2]))
        grey = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(grey, cv2.COLOR_BGR2GRAY)
        last, self._last = self._last, grey
        if last is None or last.shape != grey.shape or not len(persons):
            return None
        points = cv2.goodFeaturesToTrack(last, _POINTS, _QUALITY, _APART_PX, mask=_ground(last.shape, scale, persons))
        if points is None or len(points) < _LEAST:
            return None
        matrix, share = _consensus(last, grey, points, np.zeros(2))
        if share < _CERTAIN:
            # A pan of a blurred image exceeds the reach of the flow: from the shift of the whole image once more.
            window = cv2.createHanningWindow(grey.shape[::-1], cv2.CV_32F)
            shift, _ = cv2.phaseCorrelate(last.astype(np.float32), grey.astype(np.float32), window)
            again, share_again = _consensus(last, grey, points, np.array(shift))
            if share_again > share:
                matrix, share = again, share_again
        if matrix is None or share < _SHARE or share * len(points) < _LEAST:
            return None
        if not _MOST_ZOOM**-2 < np.linalg.det(matrix[:, :2]) < _MOST_ZOOM**2:
            return None
        return np.column_stack([matrix[:, :2], matrix[:, 2] / scale])


def _ground(shape: tuple[int, ...], scale: float, persons: Sequence[np.ndarray]) -> np.ndarray:
    mask = np.full(shape, 255, np.uint8)
    for x_min, y_min, x_max, y_max in np.clip(scale * np.array(persons), 0, max(shape)).astype(int):
        mask[y_min : y_max + 1, x_min : x_max + 1] = 0
    return mask


def _consensus(
    last: np.ndarray, grey: np.ndarray, points: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray | None, float]:
    """Transform (2, 3) of points (N, 1, 2), by optical flow that starts at a shift, and the share that agrees."""
    import cv2

    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        last, grey, points, (points + shift).astype(np.float32), winSize=_WINDOW_PX, maxLevel=_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    ok = found[:, 0] == 1
    if ok.sum() < _LEAST:
        return None, 0.0
    matrix, agree = cv2.estimateAffinePartial2D(
        points[ok], moved[ok], method=cv2.RANSAC, ransacReprojThreshold=_AGREE_PX
    )
    return matrix, 0.0 if matrix is None else float(agree.sum()) / len(points)


def moved_box(matrix: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Box (4,) px whose centre and size follow the transform (2, 3)."""
    centre = matrix[:, :2] @ ((box[:2] + box[2:]) / 2) + matrix[:, 2]
    half = (box[2:] - box[:2]) / 2 * np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    moved: np.ndarray = np.concatenate([centre - half, centre + half]).astype(box.dtype)
    return moved
