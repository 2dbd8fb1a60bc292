"""The world protocol: MoCap with its root motion, seen by a simulated drone whose telemetry errs.

Sequences of at least 8 s, their first 20 s at 24 fps.  A perspective camera (1280x720, 70 degrees wide) orbits at 6 m,
2.5 m high, 19 deg/s, aimed at the person's smoothed place.  2D noise is 3 px per coordinate, correlated over 0.1 s;
2 % of the joints are thrown by up to 80 px.  There are no confidences.  Fixed points of the scene are those of
:mod:`world_scene`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.skeleton import BODY_15, BODY_17, indices
from drocap_ros.tracks import Tracks
from lab.studies.protocol import FPS, Sequence, protocol_sequences
from lab.studies.world_scene import PinholePath, followed_points

# The numbers of the protocol; docs/accuracy.md compares under them.
SHORTEST_S = 8.0
LONGEST_S = 20.0  # s, from the first frame on
#: Width and height px.
IMAGE_SIZE = (1280, 720)
#: A view of 70 degrees across.
FOCAL_PX = 0.5 * IMAGE_SIZE[0] / np.tan(np.deg2rad(35.0))
RADIUS_M = 6.0  # m, of the orbit
HEIGHT_M = 2.5  # m above the ground
SPEED_DEG_S = 19.0  # deg/s: two metres a second at the radius
#: Height at which the camera aims, m, and the smoothing of the aim's path.
_AIM_M = 0.95
_AIM_SMOOTHING_S = 1.0  # s, standard deviation
#: Angle between two cameras about the person, deg.
APART_DEG = 120.0
#: Half the time that the orbit takes to turn round.
_TURN_S = 0.5
#: Height of a standing ankle, m.
_ANKLE_M = 0.07
#: Standard deviation and correlation time of the noise.
_NOISE_PX = 3.0
_NOISE_S = 0.1  # s
#: Share of the joints that are thrown, and their largest shift per coordinate.
_OUTLIERS = 0.02
_OUTLIER_PX = 80.0  # px
#: Correlation times of the errors of position and attitude.
_POSITION_WANDER_S = 60.0
_ATTITUDE_WANDER_S = 10.0  # s
#: Between the seeds of two cameras: more than there are sequences.
_CAMERA_SEEDS = 1_000_000


class TelemetryErrors(NamedTuple):
    """Wander of the position, misalignment about each axis, wander of the attitude (standard deviations), and delay.

    yaw_deg turns every attitude about the vertical, counter-clockwise seen from above.
    """

    position_m: float = 0.0
    misalignment_deg: float = 0.0
    attitude_deg: float = 0.0
    late_s: float = 0.0
    yaw_deg: float = 0.0


TELEMETRY = {
    "exact": TelemetryErrors(),
    "rtk": TelemetryErrors(0.05, 0.3, 0.1),
    "gps": TelemetryErrors(0.5, 1.0, 0.3, 0.08),
}
#: Level without any telemetry: only the lens is known.
NONE = "none"


@dataclass(frozen=True)
class WorldCase:
    """What the study varies.

    telemetry : a key of ``TELEMETRY`` or ``NONE``
    still : the camera keeps its bearing from the person instead of orbiting
    reverse_s : the orbit turns back every so many seconds, first after half of them, within a second; 0 = never
    background : the tracks hold fixed points of the scene
    camera : its number; each flies ``APART_DEG`` ahead of the one before and errs on its own
    """

    telemetry: str = "exact"
    still: bool = False
    reverse_s: float = 0.0
    background: bool = False
    camera: int = 0

    def __post_init__(self) -> None:
        if not (self.reverse_s == 0.0 or 2 * _TURN_S <= self.reverse_s < np.inf):
            raise InputError(
                f"--reverse: expected 0 (never) or at least {2 * _TURN_S:g} s, got {self.reverse_s:g}; choose another"
            )

    def words(self) -> str:
        """The case in a table's title."""
        known = "no telemetry" if self.telemetry == NONE else f"{self.telemetry} telemetry"
        way = "still camera" if self.still else "orbit"
        back = f" that turns back every {self.reverse_s:g} s" if self.reverse_s and not self.still else ""
        return f"{known}, {way}{back}{', background' if self.background else ''}"


@dataclass(frozen=True)
class WorldView:
    """A sequence as the simulated drone records it.

    tracks : keypoints in px and the telemetry
    truth : (F, P, 3) m, ENU; the lowest ankles stand 7 cm above z = 0
    camera_rotation : (F, 3, 3) true, world -> camera
    camera_position : (F, 3) m, true
    """

    tracks: Tracks
    truth: np.ndarray
    camera_rotation: np.ndarray
    camera_position: np.ndarray


def world_sequences(folder: Path, every: int = 1, limit: int | None = None) -> list[tuple[int, Sequence]]:
    """Every ``every``-th sequence of a MoCap folder, by name, each with its seed: the same for any ``every``."""
    for name, value in (("every", every), ("limit", limit)):
        if value is not None and value < 1:
            raise InputError(f"--{name}: expected at least 1, got {value}")
    found = enumerate(protocol_sequences(folder, shortest_s=SHORTEST_S, longest_s=LONGEST_S))
    # The published figures are of every third sequence, with the seeds 0, 1, 2 and so on.
    return [(index // 3 + 1000 * (index % 3), sequence) for index, sequence in found][::every][:limit]


def world_view(
    sequence: Sequence, case: WorldCase | None = None, errors: TelemetryErrors | None = None, *, seed: int = 0
) -> WorldView:
    """View of one sequence.

    Parameters
    ----------
    case : default: exact telemetry of an orbit
    errors : others than those of the case's telemetry
    seed : of the orbit's phase, the 2D noise, the errors of the telemetry and the scene
    """
    case = case or WorldCase()
    errors = errors or TELEMETRY.get(case.telemetry, TelemetryErrors())
    rng = np.random.default_rng(seed)
    truth = _on_ground(sequence.x / 1000.0)
    frames = len(truth)
    phase = rng.uniform(0, 2 * np.pi) + case.camera * np.deg2rad(APART_DEG)
    if case.camera:
        seed += _CAMERA_SEEDS * case.camera
        rng = np.random.default_rng(seed)
    orbit = _Orbit(phase, 0.0 if case.still else np.deg2rad(SPEED_DEG_S), case.reverse_s)
    position, rotation = _camera(truth, orbit, 0.0)
    # The toes have draws of their own: those of the other joints are the same with and without them.
    body, toes = np.split(_project(truth, position, rotation), [len(BODY_15)], axis=1)
    seen = [_with_noise(rng, body), _with_noise(np.random.default_rng([seed, len(BODY_15)]), toes)]
    tracks = Tracks(
        keypoints=np.concatenate(seen, axis=1),
        joints=BODY_17.joints[: truth.shape[1]],
        stamp_ns=np.round(np.arange(frames) * (1e9 / FPS)).astype(np.int64),
        image_size=IMAGE_SIZE,
        camera_matrix=np.array(
            [[FOCAL_PX, 0.0, IMAGE_SIZE[0] / 2], [0.0, FOCAL_PX, IMAGE_SIZE[1] / 2], [0.0, 0.0, 1.0]]
        ),
    )
    if case.telemetry != NONE:
        reported = _reported(rng, _camera(truth, orbit, errors.late_s), errors)
        tracks = replace(tracks, camera_position=reported[0], camera_rotation=reported[1])
    if case.background:
        path = PinholePath(position, rotation, FOCAL_PX, IMAGE_SIZE)
        tracks = replace(tracks, background=followed_points(path, truth, FPS, seed))
    return WorldView(tracks, truth, rotation, position)


def _reported(
    rng: np.random.Generator, camera: tuple[np.ndarray, np.ndarray], errors: TelemetryErrors
) -> tuple[np.ndarray, np.ndarray]:
    """Position (F, 3) and rotation (F, 3, 3) with errors."""
    position, rotation = camera
    frames = len(position)
    drift = _wander(rng, frames, _POSITION_WANDER_S, 3) * [1.0, 1.0, 0.7]
    misalignment = np.deg2rad(errors.misalignment_deg) * rng.choice([-1.0, 1.0], 3)
    north = exp_so3(np.array([0.0, 0.0, -np.deg2rad(errors.yaw_deg)]))
    wander = np.deg2rad(errors.attitude_deg) * _wander(rng, frames, _ATTITUDE_WANDER_S, 3)
    return position + errors.position_m * drift, exp_so3(misalignment) @ exp_so3(wander) @ rotation @ north


def _on_ground(joints: np.ndarray) -> np.ndarray:
    """Joints moved so that the mean pelvis is at the origin and the lowest ankles stand at their height above z = 0."""
    feet = joints[:, indices(BODY_15.joints, ("rankle", "lankle")), 2]
    moved: np.ndarray = joints - [*joints[:, 0, :2].mean(axis=0), np.percentile(feet, 2) - _ANKLE_M]
    return moved


class _Orbit(NamedTuple):
    """Bearing at the first frame rad, its rate rad/s, and the time between two turns back s (0 = none)."""

    phase: float
    rate: float
    reverse_s: float

    def bearing(self, at: np.ndarray) -> np.ndarray:
        """(F,) rad at times (F,) s."""
        if self.reverse_s:
            # The share of the rate falls from 1 to -1 within a second, after half the time between two turns.
            time = np.arange(min(at[0], 0.0), at[-1] + 0.01, 0.01)
            saw = np.abs((time / self.reverse_s) % 2 - 1) - 0.5
            share = np.clip(saw * self.reverse_s / _TURN_S, -1.0, 1.0)
            way = np.concatenate([[0.0], np.cumsum(0.5 * (share[1:] + share[:-1]) * np.diff(time))])
            at = np.interp(at, time, way) - np.interp(0.0, time, way)
        return np.asarray(self.phase + self.rate * at)


def _camera(truth: np.ndarray, orbit: _Orbit, ahead_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Position (F, 3) and rotation (F, 3, 3) world -> camera, each ``ahead_s`` after its frame."""
    from scipy.ndimage import gaussian_filter1d

    time = np.arange(len(truth)) / FPS
    aim = gaussian_filter1d(truth[:, 0], _AIM_SMOOTHING_S * FPS, axis=0, mode="nearest", truncate=3.0)
    aim = np.stack([np.interp(time + ahead_s, time, aim[:, axis]) for axis in range(3)], axis=1)
    bearing = orbit.bearing(time + ahead_s)
    flat = aim[:, :2] + RADIUS_M * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    position = np.column_stack([flat, np.full(len(time), HEIGHT_M)])
    forward = np.column_stack([aim[:, :2], np.full(len(time), _AIM_M)]) - position
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return position, np.stack([right, np.cross(forward, right), forward], axis=1)


def _project(joints: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    seen = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    return np.asarray(FOCAL_PX * seen[..., :2] / seen[..., 2:] + np.array(IMAGE_SIZE) / 2)


def _with_noise(rng: np.random.Generator, keypoints: np.ndarray) -> np.ndarray:
    """Keypoints (F, P, 2) px with correlated noise and outliers."""
    frames, joints = keypoints.shape[:2]
    keypoints = keypoints + _NOISE_PX * _wander(rng, frames, _NOISE_S, 2 * joints).reshape(keypoints.shape)
    thrown = rng.random((frames, joints)) < _OUTLIERS
    noisy: np.ndarray = keypoints + thrown[..., None] * rng.uniform(-_OUTLIER_PX, _OUTLIER_PX, keypoints.shape)
    return noisy


def _wander(rng: np.random.Generator, frames: int, correlated_s: float, dims: int) -> np.ndarray:
    """(F, dims) Gauss-Markov process of unit variance."""
    from scipy.signal import lfilter

    decay = np.exp(-1.0 / (correlated_s * FPS))
    draws = rng.standard_normal((frames, dims))
    draws[1:] *= np.sqrt(1.0 - decay**2)
    process: np.ndarray = lfilter([1.0], [1.0, -decay], draws, axis=0)
    return process
