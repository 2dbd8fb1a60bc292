"""Truth of a simulated flight, and the quality of its orbit.

The file is a motion (``drocap evaluate compare MOTION TRUTH`` reads it) with ``camera_position`` added.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.motion import Motion, load_motion, save_motion
from drocap_ros.simulation.pinhole import project
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import read_npz

#: The world keeps this many exposures: two hours at 15 Hz.
MAX_EXPOSURES = 108_000


@dataclass(frozen=True)
class FlightTruth:
    """Truth at F exposures, rendered or not.

    stamp_ns : (F,) int64, increasing
    joints3d : (F, P, 3) m ENU, order of ``BODY_17``, of ``BODY_15`` in older files
    camera_rotation, camera_position : (F, 3, 3) world -> optical, (F, 3) m ENU, the vehicle's position
    camera_matrix, image_size : (3, 3) px; width, height px
    """

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    camera_rotation: np.ndarray
    camera_position: np.ndarray
    camera_matrix: np.ndarray
    image_size: tuple[int, int]

    @property
    def keypoints(self) -> np.ndarray:
        """(F, P, 2) px, exact; NaN behind the camera."""
        return project(self.joints3d, self.camera_rotation, self.camera_position, self.camera_matrix)


def save_flight_truth(path: Path, truth: FlightTruth) -> None:
    """Write the file atomically."""
    frames, joints = truth.joints3d.shape[:2]
    motion = Motion(
        joints3d=truth.joints3d,
        joints=BODY_17.joints[:joints],
        parents=BODY_17.parents[:joints],
        stamp_ns=truth.stamp_ns,
        frame="world",
        metric=True,
        scale_source="simulation",
        camera_rotation=truth.camera_rotation,
        confidence=np.ones((frames, joints)),
        keypoints=truth.keypoints,
        reprojection_px=np.zeros((frames, joints)),
        meta={"method": "truth of a simulated flight"},
        camera_position=truth.camera_position,
    )
    work = path.with_name(f".{path.name}.part.npz")
    try:
        save_motion(work, motion, camera_matrix=truth.camera_matrix, image_size=np.array(truth.image_size))
        os.replace(work, path)
    finally:
        work.unlink(missing_ok=True)


def load_flight_truth(path: Path) -> FlightTruth:
    """Read a file of :func:`save_flight_truth`."""
    motion = load_motion(path)
    more = read_npz(path, ("camera_position", "camera_matrix", "image_size"))
    frames = len(motion.stamp_ns)
    for name, shape in (("camera_position", (frames, 3)), ("camera_matrix", (3, 3)), ("image_size", (2,))):
        if more[name].shape != shape or more[name].dtype.kind not in "fiu":
            raise InputError(f"{path}: {name}: expected numbers of shape {shape}, got {more[name].shape}")
    width, height = (int(v) for v in more["image_size"])
    return FlightTruth(
        stamp_ns=motion.stamp_ns,
        joints3d=motion.joints3d,
        camera_rotation=motion.camera_rotation,
        camera_position=more["camera_position"],
        camera_matrix=more["camera_matrix"],
        image_size=(width, height),
    )


class OrbitQuality(NamedTuple):
    """Quality of a flown orbit: mean absolute errors, shares of the exposures, extremes.

    in_middle_third : the middle of the person's extent lies in the middle third of the image, in both directions
    turned_deg : angle of the vehicle's path about the person
    """

    exposures: int
    radius_error_m: float
    yaw_error_deg: float
    in_middle_third: float
    least_distance_m: float
    top_speed_m_s: float
    turned_deg: float


def orbit_quality(truth: FlightTruth, within: np.ndarray, radius_m: float) -> OrbitQuality:
    """Quality of the orbit over the exposures ``within`` (F,) bool; angles and speeds from pairs of neighbours."""
    if int(within.sum()) < 2:
        raise InputError("orbit: expected at least two exposures within it, found fewer; fly longer")
    sight = truth.joints3d[:, 0, :2] - truth.camera_position[:, :2]
    distance = np.linalg.norm(sight, axis=1)
    bearing = np.arctan2(sight[:, 1], sight[:, 0])
    nose = np.arctan2(truth.camera_rotation[:, 2, 1], truth.camera_rotation[:, 2, 0])
    yaw_error = np.abs(np.angle(np.exp(1j * (nose - bearing))))
    pairs = within[1:] & within[:-1]
    seconds = np.diff(truth.stamp_ns) * 1e-9
    speed = np.linalg.norm(np.diff(truth.camera_position, axis=0), axis=1) / seconds
    turned = np.abs(np.sum(np.angle(np.exp(1j * np.diff(bearing)))[pairs]))
    return OrbitQuality(
        int(within.sum()),
        float(np.abs(distance - radius_m)[within].mean()),
        float(np.degrees(yaw_error[within].mean())),
        float(middle_third(truth)[within].mean()),
        float(distance[within].min()),
        float(speed[pairs].max()) if pairs.any() else float("nan"),
        float(np.degrees(turned)),
    )


def middle_third(truth: FlightTruth) -> np.ndarray:
    """(F,) bool, the middle of the person's extent is in the middle third of the image; False behind the camera."""
    px = truth.keypoints
    size = np.array(truth.image_size, dtype=float)
    middle = 0.5 * (px.min(axis=1) + px.max(axis=1)) - size / 2
    return np.asarray(np.all(np.abs(middle) < size / 6, axis=1))
