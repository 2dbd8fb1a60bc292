"""The matrix of a camera whose axis meets the middle of its image, and the turns of its rays."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import exp_so3

#: Focal length of a lens of which nothing is known, share of the image's longer side: ``assumed_focal`` says why.
ASSUMED_FOCAL = 0.85

#: Ratio of the focal lengths up to which a matrix is one of a lens: anamorphic ones squeeze by two.
MOST_ASPECT = 4.0


def pixels_are_usual(matrix: np.ndarray) -> bool:
    """Whether the focal lengths of a matrix (3, 3) belong to one lens."""
    fx, fy = np.diagonal(matrix)[:2].tolist()
    return bool(0.0 < max(fx, fy) <= MOST_ASPECT * min(fx, fy))


def centred_camera(size: tuple[int, int], focal_px: float) -> np.ndarray:
    """Camera matrix (3, 3) px of images of ``size`` (width, height); pixel 0 has its centre at 0, as in OpenCV."""
    matrix = np.diag([focal_px, focal_px, 1.0])
    matrix[:2, 2] = (np.array(size) - 1) / 2
    return matrix


def assumed_camera(size: tuple[int, int]) -> np.ndarray:
    """Camera matrix (3, 3) px of images of ``size`` (width, height) of which nothing is known."""
    return centred_camera(size, ASSUMED_FOCAL * max(size))


def towards(ray: np.ndarray) -> np.ndarray:
    """(F, 3, 3) least turns that bring rays (F, 2), x and y at depth 1, to the axis."""
    length = np.linalg.norm(ray, axis=-1)
    angle = np.arctan(length) / np.maximum(length, 1e-12)
    return exp_so3(np.stack([ray[:, 1] * angle, -ray[:, 0] * angle, np.zeros(len(ray))], axis=-1))
