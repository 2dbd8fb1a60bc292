"""A simulated capture flight: person, orbiting camera, detected keypoints, telemetry, and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.parameters import Parameters, param
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import ACTIONS, simulate_person
from drocap_ros.skeleton import BODY_15, JointSet
from drocap_ros.tracks import MAX_FRAMES, Tracks
from lab.simulation.keypoint_errors import NoisyKeypoints, detect_person
from lab.simulation.orbit import orbit_camera


@dataclass(frozen=True)
class SimulationConfig(Parameters):
    """Person, orbit, camera and observation quality of a simulated capture."""

    action: str = param("mixed", "motion of the person", choices=ACTIONS)
    stature_m: float = param(1.75, "height of the person", unit="m", minimum=0.5, maximum=2.5)
    radius_m: float = param(6.0, "horizontal distance of the camera from the person", unit="m", minimum=2.0, maximum=50)
    height_m: float = param(2.5, "height of the camera above the ground", unit="m", minimum=0.2, maximum=50)
    angular_speed_deg_s: float = param(
        25.0, "angular speed of the orbit, counter-clockwise from above", unit="deg/s", minimum=-90, maximum=90
    )
    image_width: int = param(1280, "width of the images", unit="px", minimum=64, maximum=8192)
    image_height: int = param(720, "height of the images", unit="px", minimum=64, maximum=8192)
    horizontal_fov_deg: float = param(60.0, "horizontal field of view", unit="deg", minimum=5, maximum=150)
    noise_scale: float = param(1.0, "keypoint noise, 1 = a good detector, 0 = none", minimum=0, maximum=10)
    outlier_fraction: float = param(0.03, "share of grossly wrong keypoints", minimum=0, maximum=0.5)
    missed_fraction: float = param(0.015, "share of missed keypoints", minimum=0, maximum=0.5)
    attitude_error_deg: float = param(0.5, "slow error of the camera telemetry", unit="deg", minimum=0, maximum=20)
    position_error_m: float = param(0.2, "slow error of the position telemetry", unit="m", minimum=0, maximum=20)
    seconds: float = param(20.0, "length of the simulated flight", unit="s", minimum=0.1, maximum=36000)
    rate_hz: float = param(30.0, "images per second", unit="Hz", minimum=1, maximum=240)
    seed: int = param(0, "seed of person, take and noise", minimum=0)


@dataclass(frozen=True)
class SimulatedCapture:
    """Recording of a flight, and its truth.

    tracks : keypoints with noise, and camera telemetry with its slow errors
    joints3d_world : (F, P, 3) m ENU, truth
    camera_rotation, camera_position : (F, 3, 3) world -> camera, (F, 3) m ENU, truth
    keypoints_exact : (F, P, 2) px, truth
    detection : the noisy keypoints, with the occluded ones and the outliers marked
    """

    tracks: Tracks
    joints3d_world: np.ndarray
    camera_rotation: np.ndarray
    camera_position: np.ndarray
    keypoints_exact: np.ndarray
    detection: NoisyKeypoints


def simulate_capture(
    seconds: float,
    fps: float = 30.0,
    seed: int = 0,
    config: SimulationConfig | None = None,
    start_ns: int = 0,
    joint_set: JointSet = BODY_15,
) -> SimulatedCapture:
    """Simulate a capture flight.

    seconds, fps : length and image rate; at least one frame
    seed : person, take and noise
    start_ns : stamp of the first image
    joint_set : ``BODY_15`` or ``BODY_17``
    """
    config = config or SimulationConfig()
    if not (np.isfinite(fps) and 0 < fps <= 1000):
        raise InputError(f"fps: expected above 0 and at most 1000, got {fps!r}; choose an image rate")
    if not (np.isfinite(seconds) and 0 < seconds <= 36_000) or seconds * fps > MAX_FRAMES:
        raise InputError(f"seconds: expected above 0 and at most {MAX_FRAMES} images, got {seconds!r} s at {fps:g}/s")
    t = np.arange(max(1, round(seconds * fps))) / fps
    joints = simulate_person(t, config.action, seed, config.stature_m, joint_set)
    centre = _aim(t, seed, config)
    rng = np.random.default_rng([seed, 0xCA])
    rotation, position = orbit_camera(
        t, centre, config.radius_m, config.height_m, config.angular_speed_deg_s, rng.uniform(-180, 180)
    )
    matrix = pinhole_matrix(config.image_width, config.image_height, config.horizontal_fov_deg)
    exact = project(joints, rotation, position, matrix)
    size = (config.image_width, config.image_height)
    errors = {name: getattr(config, name) for name in ("noise_scale", "outlier_fraction", "missed_fraction")}
    detection = detect_person(joints, rotation, position, matrix, size, seed, **errors)
    reported_rotation, reported_position = _telemetry(t, rotation, position, rng, config)
    tracks = Tracks(
        keypoints=detection.keypoints,
        joints=joint_set.joints,
        stamp_ns=start_ns + np.round(t * 1e9).astype(np.int64),
        image_size=size,
        confidence=detection.confidence,
        covariance=detection.covariance,
        camera_rotation=reported_rotation,
        camera_position=reported_position,
        camera_matrix=matrix,
    )
    return SimulatedCapture(tracks, joints, rotation, position, exact, detection)


def _aim(t: np.ndarray, seed: int, config: SimulationConfig) -> np.ndarray:
    """(F, 3) m, the centre of the orbit: the person's position as a follower estimates it, 0.3 s late and smoothed."""
    late = np.maximum(t[:, None] - 0.3 + np.linspace(-0.3, 0.3, 7), 0.0)
    pelvis = simulate_person(late.ravel(), config.action, seed, config.stature_m)[:, 0].reshape(*late.shape, 3)
    aim = pelvis.mean(axis=1)
    aim[:, 2] = 0.5 * config.stature_m
    return np.asarray(aim)


def _telemetry(
    t: np.ndarray, rotation: np.ndarray, position: np.ndarray, rng: np.random.Generator, config: SimulationConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Camera pose as reported by the autopilot: with slow errors of the configured size (RMS over axes)."""
    from scipy.spatial.transform import Rotation

    rate = rng.uniform(0.02, 0.2, (2, 3))
    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    wave = np.sin(2 * np.pi * rate[:, None] * t[:, None] + phase[:, None]) * np.sqrt(2 / 3)
    error = Rotation.from_rotvec(np.deg2rad(config.attitude_error_deg) * wave[0]).as_matrix()
    return error @ rotation, position + config.position_error_m * wave[1]
