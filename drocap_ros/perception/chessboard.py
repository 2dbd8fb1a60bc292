"""A camera's lens from pictures of a chessboard: Zhang (2000), OpenCV's corners, five coefficients of distortion."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.perception.sources import Frame

#: Most views that are used, and least: five parameters of distortion and four of the lens need some turns.
_MOST_VIEWS, _LEAST_VIEWS = 60, 8
#: Least angle between two views of the board: from one side a long lens and a near board look alike.
_LEAST_TILT_DEG = 20.0
#: Residual of a view over the median one beyond which it is left out: blur, or a board that bends.
_WORSE = 2.0


class Calibration(NamedTuple):
    """A lens and how well it is known.

    views : pictures of the board that were used, seen : pictures that were looked at
    residual_px : root mean square distance of corners from the board's
    focal_std : share of the focal length; covered : share of the picture in which corners were seen
    """

    camera: CameraModel
    views: int
    seen: int
    residual_px: float
    focal_std: float
    covered: float


def calibrate(frames: Iterable[Frame], corners: tuple[int, int], step_s: float) -> Calibration:
    """The lens by a board with so many inner corners (columns, rows), all of it in each picture that counts.

    step_s : time between two pictures that are looked at
    Raises InputError where too few pictures show the board, or all from one side.
    """
    import cv2

    found: list[np.ndarray] = []
    size, seen, next_ns = (0, 0), 0, 0
    for frame in frames:
        if frame.stamp_ns < next_ns or len(found) == _MOST_VIEWS:
            continue
        next_ns, seen, size = (
            frame.stamp_ns + round(step_s * 1e9),
            seen + 1,
            (frame.image.shape[1], frame.image.shape[0]),
        )
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        ok, points = cv2.findChessboardCornersSB(grey, corners, flags=cv2.CALIB_CB_ACCURACY)
        if ok:
            found.append(np.asarray(points, np.float32).reshape(-1, 1, 2))
    if len(found) < _LEAST_VIEWS:
        raise InputError(
            f"expected {_LEAST_VIEWS} pictures of a whole board with {corners[0]}x{corners[1]} inner corners, found"
            f" {len(found)} of {seen}; count the corners between four squares, film the board flat, lit and unblurred"
        )
    board = np.zeros((corners[0] * corners[1], 3), np.float32)
    board[:, :2] = np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2)
    while True:
        rms, matrix, distortion, turns, _, std, _, each = cv2.calibrateCameraExtended(
            [board] * len(found), found, size, np.eye(3), np.zeros(5)
        )
        errors = np.asarray(each, np.float64)[:, 0]
        kept = [view for view, error in zip(found, errors, strict=True) if error <= _WORSE * np.median(errors)]
        if len(kept) == len(found) or len(kept) < _LEAST_VIEWS:
            break
        found = kept
    focal_std = float(std[0, 0] / matrix[0, 0])
    normals = exp_so3(np.array(turns).reshape(-1, 3))[:, :, 2]
    tilted_deg = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max()))
    if not (np.isfinite(std[:4]).all() and tilted_deg > _LEAST_TILT_DEG):
        raise InputError(
            f"expected the board from several sides, found views that differ by {tilted_deg:.0f} degrees; tilt it by 30"
            " degrees to each side, near and far, in the corners of the picture too"
        )
    places = np.floor(np.concatenate(found).reshape(-1, 2) / size * 8).astype(int)
    covered = len(np.unique(places, axis=0)) / 64
    camera = CameraModel(*size, np.asarray(matrix), np.asarray(distortion).ravel()[:5])
    return Calibration(camera, len(found), seen, float(rms), focal_std, covered)
