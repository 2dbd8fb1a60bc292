"""Motion of the image by the camera's own: a pan or a shake moves the ground, and with it the places of all persons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_SIDE_PX = 480  # longer side of the image in which it is measured
_POINTS = 150  # of the ground: ten times the least number that has to agree
_QUALITY = 0.01  # of the points over the best one's, as in the examples of OpenCV
_APART_PX = 8  # least distance of the points
_WINDOW_PX = (15, 15)  # of the optical flow around each point
_LEVELS = 4  # of the flow's pyramid: steps up to 7 * 2^4 = 112 px
_AGREE_PX = 2.0  # distance up to which points agree on a motion
_LEAST = 15  # least number of points that agree,
_SHARE = 0.4  # least share of them,
_CERTAIN = 0.7  # and the share that makes the motion certain
_SMALL = 0.01  # share of the longer side that counts as motion: the tracks bear less, and each step costs accuracy
_BLUR = 0.25  # way between two images, lengths of the person, from which the blur takes joints from the pose
_MOST_ZOOM = 1.5  # largest change of the size between two images; more is a wrong consensus


class CameraMotion:
    """Similarity transform between images: optical flow of points, and their consensus."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the last image."""
        self._last = None

    def update(self, image: np.ndarray, persons: Sequence[np.ndarray]) -> np.ndarray | None:
        """Motion since the last image, or since an earlier one, as long as it was small.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        persons : (4,) px each, boxes of the last image, whose points do not belong to the ground

        Returns
        -------
        (2, 3) transform of pixels; None for the first image, without persons, where too few points agree, or where the
        motion is small.
        """
        scale = min(1.0, _SIDE_PX / max(image.shape[:2]))
        grey, last = _small(image), self._last
        if last is None or last.shape != grey.shape or not len(persons):
            self._last = grey
            return None
        matrix = _motion(last, grey, _ground(last.shape, scale, persons))
        if matrix is not None and _largest(matrix, grey.shape) < _SMALL * max(grey.shape):
            return None
        self._last = grey
        return None if matrix is None else np.column_stack([matrix[:, :2], matrix[:, 2] / scale])


def _motion(last: np.ndarray, grey: np.ndarray, ground: np.ndarray) -> np.ndarray | None:
    """Transform (2, 3) of one grey image to another, or None."""
    import cv2

    points = cv2.goodFeaturesToTrack(last, _POINTS, _QUALITY, _APART_PX, mask=ground)
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
    zoom = np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    return matrix if 1 / _MOST_ZOOM < zoom < _MOST_ZOOM else None


def _largest(matrix: np.ndarray, shape: tuple[int, ...]) -> float:
    """Largest way (px) of the corners of an image."""
    corners = np.array([[0, 0], [shape[1], 0], [0, shape[0]], [shape[1], shape[0]]], float)
    return float(np.linalg.norm(corners @ matrix[:, :2].T + matrix[:, 2] - corners, axis=1).max())


def _small(image: np.ndarray) -> np.ndarray:
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    # Means of four pixels are fast, those of other numbers are not.
    while max(grey.shape) >= 2 * _SIDE_PX and min(grey.shape) > 1:
        grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    size = [max(1, round(side * min(1.0, _SIDE_PX / max(image.shape[:2])))) for side in image.shape[1::-1]]
    small: np.ndarray = cv2.resize(grey, size, interpolation=cv2.INTER_LINEAR)
    return small


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

    start = (points + shift).astype(np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        last, grey, points, start, winSize=_WINDOW_PX, maxLevel=_LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    ok = found[:, 0] == 1
    if ok.sum() < _LEAST:
        return None, 0.0
    matrix, agree = cv2.estimateAffinePartial2D(
        points[ok], moved[ok], method=cv2.RANSAC, ransacReprojThreshold=_AGREE_PX
    )
    return matrix, 0.0 if matrix is None else float(agree.sum()) / len(points)


def sweeps(matrix: np.ndarray | None, box: np.ndarray) -> bool:
    """Whether the transform (2, 3) moves a box (4,) px so far that its image is blurred; None = no motion."""
    if matrix is None:
        return False
    way = (moved_box(matrix, box) - box)[:2]
    return float(np.linalg.norm(way)) > _BLUR * float((box[2:] - box[:2]).max())


def moved_box(matrix: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Box (4,) px whose centre and size follow the transform (2, 3)."""
    centre = matrix[:, :2] @ ((box[:2] + box[2:]) / 2) + matrix[:, 2]
    half = (box[2:] - box[:2]) / 2 * np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    moved: np.ndarray = np.concatenate([centre - half, centre + half]).astype(box.dtype)
    return moved
