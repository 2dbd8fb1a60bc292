"""Study of planned flights: MoCap seen from the path that a plan flies, and from a steady orbit of equal length.

Both begin at the same place and are judged by the offline reconstruction of all of their images.  The plan sees what a
live one does: reconstructions of the last six seconds, every two seconds.  Keypoints err as the simulated detector's,
limbs that hide joints included; telemetry is exact.  Sequences shorter than the flight are played to and fro.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.evaluation.compare import world_errors
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.planner import OrbitState, reference_position
from drocap_ros.flight.orbit.view_plan import choose_view, fly_plan, reach_of
from drocap_ros.flight.orbit_goal import Wish, goal_of
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.live.view_forecast import ViewForecaster
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.keypoint_errors import detect_person
from drocap_ros.simulation.orbit_camera import look_at
from drocap_ros.skeleton import BODY_17, indices
from drocap_ros.tracks import Tracks
from lab.studies.protocol import FPS, Progress, reported, resample
from lab.studies.world_protocol import FOCAL_PX, IMAGE_SIZE

#: Walks, squats, boxing, arms that the body hides or that move.
SEQUENCES = (
    "cmu_03_03", "cmu_03_04", "cmu_17_03", "hdm05_mm_squat1Reps_037", "hdm05_tr_squat1Reps_043", "cmu_17_10",
    "hdm05_mm_rotateArmsBothBackward1Reps_011", "hdm05_mm_grabHighR_018", "hdm05_tr_throwBasketball_012",
    "hdm05_mm_depositFloorR_020",
)  # fmt: skip
SECONDS = 36.0  # of a flight
_EVERY, _PAST = round(2.0 * FPS), round(6.0 * FPS)  # images between two choices, and that each sees
_LEAST = round(4.0 * FPS)  # images of the first one
_SPEED_M_S = 1.76  # at which an orbit is flown under ArduPilot
_AIM_M, _AIM_S = 0.95, 1.0  # height of the camera's aim, and smoothing of its path, as in the world protocol
_MATRIX = np.array([[FOCAL_PX, 0.0, IMAGE_SIZE[0] / 2], [0.0, FOCAL_PX, IMAGE_SIZE[1] / 2], [0.0, 0.0, 1.0]])


class PlannedRow(NamedTuple):
    """One sequence: errors in mm of the steady and of the planned flight."""

    sequence: str
    steady_pa: float
    planned_pa: float
    steady_w: float
    planned_w: float


def planned_study(folder: Path, limit: int | None = None, progress: Progress | None = None) -> list[PlannedRow]:
    """Every sequence of :data:`SEQUENCES`, each with its own seed."""
    names = SEQUENCES[:limit]
    return [
        _measure(folder / f"{name}.npz", seed)
        for seed, name in reported(enumerate(names), len(names), "planned flights", progress)
    ]


def planned_markdown(rows: list[PlannedRow]) -> str:
    """A table with the means in its last row."""
    mean = PlannedRow("mean", *np.mean([row[1:] for row in rows], axis=0).tolist())
    head = "| sequence | PA mm, steady | planned | change % | W-MPJPE100 mm, steady | planned | change % |"
    return "\n".join([head, "|" + "---|" * 7, *(_line(row) for row in (*rows, mean))]) + "\n"


def _line(row: PlannedRow) -> str:
    pa, w = (100.0 * (after / before - 1.0) for before, after in ((row[1], row[2]), (row[3], row[4])))
    return f"| {row.sequence} | {row[1]:.1f} | {row[2]:.1f} | {pa:+.0f} | {row[3]:.0f} | {row[4]:.0f} | {w:+.0f} |"


class _View:
    """A person (F, P, 3) m whom a camera sees that aims at his smoothed place."""

    def __init__(self, truth: np.ndarray) -> None:
        from scipy.ndimage import gaussian_filter1d

        self.truth = truth
        self.ground: np.ndarray = gaussian_filter1d(truth[:, 0], _AIM_S * FPS, axis=0, mode="nearest")
        self.ground[:, 2] = 0.0

    def tracks(self, frames: slice, position: np.ndarray, seed: int) -> Tracks:
        """What is seen in some of the frames from positions (F, 3) m."""
        rotation = look_at(position, self.ground[frames] + [0.0, 0.0, _AIM_M])
        truth = self.truth[frames]
        seen = detect_person(truth, rotation, position, _MATRIX, IMAGE_SIZE, seed)
        return Tracks(
            keypoints=seen.keypoints,
            joints=BODY_17.joints[: truth.shape[1]],
            stamp_ns=np.round(np.arange(len(self.truth))[frames] * (1e9 / FPS)).astype(np.int64),
            image_size=IMAGE_SIZE,
            confidence=seen.confidence,
            covariance=seen.covariance,
            camera_matrix=_MATRIX,
            camera_rotation=rotation,
            camera_position=position,
        )


class _Planner:
    """Chooses as the live graph does, by reconstructions of the last seconds of the flight."""

    def __init__(self, view: _View, config: MavlinkBridgeConfig, seed: int) -> None:
        self._view, self._seed = view, seed
        self._reach = reach_of(config, goal_of(config), config.radius_m, _SPEED_M_S)
        self._forecaster, self._places = ViewForecaster(Lifter.load()), [np.zeros(3)]
        self._wish: Wish | None = None

    def wish(self, frame: int, state: OrbitState) -> Wish | None:
        """The wish of a frame."""
        self._places[frame:] = [reference_position(state)]
        if frame >= _LEAST and frame % _EVERY == 0:
            past = slice(max(frame - _PAST, 0), frame)
            motion = reconstruct(self._view.tracks(past, np.array(self._places[past]), 1000 * self._seed + frame))
            views = self._forecaster.forecast(motion.stamp_ns, motion.joints3d) if motion.frame == "world" else None
            if views is not None:
                place = (state.phase, state.height.value)
                self._wish = choose_view(views, place, self._reach, self._wish, frame / FPS)
        return self._wish


def _measure(path: Path, seed: int) -> PlannedRow:
    view, config = _View(_played(path)), MavlinkBridgeConfig()
    goal, bearing = goal_of(config), np.random.default_rng([seed, 0]).uniform(0.0, 2 * math.pi)
    away = [config.radius_m * math.cos(bearing), config.radius_m * math.sin(bearing), config.height_m]
    errors = []
    for wish in (lambda *_: None, _Planner(view, config, seed).wish):
        position, _ = fly_plan(config, goal, view.ground, 1.0 / FPS, _SPEED_M_S, wish, view.ground[0] + away)
        motion = reconstruct(view.tracks(slice(None), position, seed))
        errors.append(world_errors(motion.joints3d, view.truth, FPS))
    steady, planned = errors
    return PlannedRow(path.stem, steady.pa_mm, planned.pa_mm, steady.w_mm, planned.w_mm)


def _played(path: Path) -> np.ndarray:
    """(F, P, 3) m of a flight's length, the mean place at the origin, the ankles on the ground."""
    joints, fps = load_mocap(path, joints=BODY_17)
    joints = resample(joints, fps, FPS) / 1000.0
    there = np.arange(len(joints))
    played: np.ndarray = joints[np.resize(np.concatenate([there, there[-2:0:-1]]), round(SECONDS * FPS))]
    ankles = played[:, indices(BODY_17.joints, ("rankle", "lankle")), 2]
    played -= [*played[:, 0, :2].mean(axis=0), np.percentile(ankles, 2) - 0.07]
    return played
