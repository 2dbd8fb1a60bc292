"""Motion of the image by the camera's own: a pan or a shake moves the ground, and with it the places of all persons."""

from __future__ import annotations

import numpy as np

from drocap_ros.background import FixedPoints

_AGREE = 0.004  # distance up to which points agree on a motion, share of the image's longer side: 2 px of 480
_LEAST = 15  # least number of points that agree,
_SHARE = 0.4  # and least share of those that there were
_SMALL = 0.01  # share of the longer side that counts as motion: the tracks bear less, and each step costs accuracy
_BLUR = 0.25  # way between two images, lengths of the person, from which the blur takes joints from the pose
_MOST_ZOOM = 1.5  # largest change of the size between two images; more is a wrong consensus


class CameraMotion:
    """Similarity transform between images: the consensus of the scene's fixed points."""

    def __init__(self) -> None:
        self._since: FixedPoints | None = None

    def reset(self) -> None:
        """Forget the last image."""
        self._since = None

    def update(self, last: FixedPoints, now: FixedPoints, image_size: tuple[int, int]) -> np.ndarray | None:
        """Motion since the last image, or since an earlier one, as long as it was small.

        last : points of the last image, without those on persons
        now : those of them that this image shows
        image_size : (width, height) px

        Returns
        -------
        (2, 3) transform of pixels; None where too few points agree, or where the motion is small.
        """
        since = self._since or last
        matrix = _motion(since, now, _AGREE * max(image_size))
        small = matrix is not None and _largest(matrix, image_size) < _SMALL * max(image_size)
        self._since = since if small else None
        return None if small else matrix


def _motion(since: FixedPoints, now: FixedPoints, agree_px: float) -> np.ndarray | None:
    """Transform (2, 3) of the points in one image to those in another, or None."""
    import cv2

    _, i, j = np.intersect1d(since.track, now.track, assume_unique=True, return_indices=True)
    if len(i) < _LEAST:
        return None
    matrix, agree = cv2.estimateAffinePartial2D(
        since.point[i], now.point[j], method=cv2.RANSAC, ransacReprojThreshold=agree_px
    )
    if matrix is None or agree.sum() < max(_LEAST, _SHARE * len(since)):
        return None
    zoom = np.sqrt(abs(np.linalg.det(np.asarray(matrix[:, :2], float))))
    return matrix if 1 / _MOST_ZOOM < zoom < _MOST_ZOOM else None


def _largest(matrix: np.ndarray, image_size: tuple[int, int]) -> float:
    """Largest way (px) of the corners of an image."""
    width, height = image_size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
    return float(np.linalg.norm(corners @ matrix[:, :2].T + matrix[:, 2] - corners, axis=1).max())


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
