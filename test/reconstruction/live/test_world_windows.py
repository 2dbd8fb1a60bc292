"""Live windows in the world: near the truth with telemetry, in the camera's axes without, and the latest pose there."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from telemetry_stream import FPS, Orbit, orbit

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.evaluation.compare import WorldErrors, world_errors
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.geometry.rotations import exp_so3, log_so3, quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.initializer import LiveInitializer, LivePose
from drocap_ros.reconstruction.live.window import AdjustedWindow, TelemetryUse
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.tracks import Tracks

S = 10**9
ADJUSTER = BundleAdjusterConfig()
#: Half the windows, where the last one counts.
SELDOM = BundleAdjusterConfig(period_s=2.0)
#: Poses of streams that were lifted before, by all their images so far, which it keeps alive.
LIFTED: dict[int, tuple[LivePose | None, StreamEvent, PoseObservation]] = {}


class Remembering(LiveInitializer):
    """An initializer that lifts no stream twice: telemetry, of which these tests are, does not change its poses."""

    event: StreamEvent

    def __init__(self, config: InitializerConfig) -> None:
        self._config, self._past, self._key = config, list[PoseObservation](), 0
        self._own: LiveInitializer | None = None

    def push(self, observation: PoseObservation) -> LivePose | None:
        self._key = hash((self._key, id(observation)))
        if self._key not in LIFTED:
            if self._own is None:
                self._own = LiveInitializer(self._config)
                for earlier in self._past:
                    self._own.push(earlier)
            LIFTED[self._key] = self._own.push(observation), self._own.event, observation
        self._past.append(observation)
        pose, self.event, _ = LIFTED[self._key]
        return pose


def run(
    observations: list[PoseObservation],
    cameras: CameraHistory | None,
    adjuster: BundleAdjusterConfig = ADJUSTER,
    points_at: Callable[[np.ndarray], Background | None] | None = None,
) -> list[Any]:
    """Steps and windows."""
    core = LiveCore(adjuster)
    core.cameras = cameras or core.cameras
    core.points = SimpleNamespace(along=points_at, newest_ns=0) if points_at else core.points  # type: ignore[assignment]
    return list(live_results(observations, Remembering(InitializerConfig()), core, LiveAdjuster(adjuster), delay_s=0.0))


def windows_of(results: list[Any]) -> list[AdjustedWindow]:
    return [r[1] for r in results if not isinstance(r, Step)]


@lru_cache(maxsize=1)
def flown() -> Orbit:
    return orbit(13.0)


@lru_cache(maxsize=1)
def followed() -> list[Any]:
    return run(flown().observations, flown().history(keep_s=60.0))


@lru_cache(maxsize=1)
def without_telemetry() -> AdjustedWindow:
    """The last window of the same flight when no pose of the camera arrives."""
    return windows_of(run(flown().observations, None, SELDOM))[-1]


def errors(poses: dict[int, np.ndarray], truth: Orbit) -> WorldErrors:
    place = {int(stamp): i for i, stamp in enumerate(truth.stamp_ns)}
    stamps = sorted(poses)
    return world_errors(np.array([poses[s] for s in stamps], float), truth.truth[[place[s] for s in stamps]], FPS)


def newest(windows: list[AdjustedWindow]) -> dict[int, np.ndarray]:
    return {int(s): j for w in windows for s, j in zip(w.stamp_ns, w.joints3d, strict=True)}


def test_windows_with_telemetry_are_in_map_and_as_near_the_truth_as_offline() -> None:
    windows = windows_of(followed())
    use = [w.telemetry for w in windows]
    # Too short at first, then without a measured scale.
    assert use[0] is TelemetryUse.LATE
    first = use.index(TelemetryUse.USED)
    assert first < 12
    assert set(use[first:]) == {TelemetryUse.USED}
    found = [w for w in windows if w.in_map is not None]
    for w in found:
        assert w.in_map is not None
        assert len(w.stamp_ns) == len(w.joints3d) == len(w.covariance) == len(w.in_map.rotation)
        assert np.linalg.norm(w.in_map.correction[:3]) < 0.2
    live = errors(newest(found), flown())
    o = flown().observations
    tracks = Tracks(
        np.array([x.keypoints for x in o], float), o[0].joints.joints, flown().stamp_ns, o[0].image_size,
        np.array([x.confidence for x in o], float), np.array([x.covariance for x in o], float), flown().rotation,
        flown().position, flown().matrix,
    )  # fmt: skip
    motion = reconstruct(tracks)
    part = {int(s): j for s, j in zip(motion.stamp_ns, motion.joints3d, strict=True) if int(s) in newest(found)}
    offline = errors(part, flown())
    assert live.absolute_mm < 1.5 * offline.absolute_mm + 20.0
    assert live.w_mm < 1.5 * offline.w_mm + 20.0
    assert live.absolute_mm < 150.0
    assert abs(live.scale) < 0.03
    assert live.foot_m_s < 0.25


def test_a_window_continues_the_one_before_without_a_step() -> None:
    found = [w for w in windows_of(followed()) if w.in_map is not None]
    steps, changes = [], []
    for before, after in itertools.pairwise(found):
        same, _, there = np.intersect1d(before.stamp_ns, after.stamp_ns, return_indices=True)
        here = np.searchsorted(before.stamp_ns, same)
        gap = np.linalg.norm(after.joints3d[there] - before.joints3d[here], axis=-1).max(axis=1)
        steps.append(gap[:2].max())
        changes.append(gap[2:].max())
    # The scale may change a little, and turns about the middle of the camera's path.
    assert max(steps) < 0.02
    # Later frames are adjusted again.
    assert max(changes) > 0.03


def test_findings_are_carried_from_window_to_window() -> None:
    """After the orbit the camera stands still: no window of its own measures the scale any more."""
    still = orbit(16.0, action="stand")
    joints = still.truth
    stop = round(8.0 * FPS)
    at = np.minimum(np.arange(len(joints)), stop)
    sway = 0.002 * np.sin(np.arange(len(joints)))[:, None]
    hover = replace(still, rotation=still.rotation[at], position=still.position[at] + sway)
    cameras = hover.history(keep_s=60.0)
    # The person is projected again, as the standing camera sees her.
    seen = (joints - hover.position[:, None]) @ np.swapaxes(hover.rotation, 1, 2)
    image = seen[..., :2] / seen[..., 2:] * np.diagonal(still.matrix)[:2] + still.matrix[:2, 2]
    noise = np.random.default_rng(0).normal(0.0, 1.5, image.shape)
    stream = [
        replace(o, keypoints=p.astype(np.float32)) for o, p in zip(still.observations, image + noise, strict=True)
    ]
    use = [w.telemetry for w in windows_of(run(stream, cameras, SELDOM))]
    assert use[-1] is TelemetryUse.USED
    # Without the orbit before, the same last seconds measure no scale.
    alone = [w.telemetry for w in windows_of(run(stream[stop:], cameras, SELDOM))]
    assert TelemetryUse.USED not in alone
    assert alone[-1] is TelemetryUse.UNSCALED


def test_windows_fall_back_to_the_camera_when_telemetry_stops() -> None:
    history = flown().history(slice(0, round(7.0 * FPS)), keep_s=60.0)
    windows = windows_of(run(flown().observations[: round(10.0 * FPS)], history))
    use = {round(float(w.stamp_ns[-1] / S), 1): w for w in windows}
    assert use[6.3].telemetry is TelemetryUse.USED
    for last in (8.3, 9.3):
        w = use[last]
        assert w.telemetry is TelemetryUse.LATE
        assert w.in_map is None
        # Camera axes, pelvis at the origin, all images of the window.
        assert np.abs(w.joints3d[:, 0]).max() < 1e-9
        assert w.stamp_ns[0] == flown().stamp_ns[0]


@pytest.mark.parametrize("kind", ["yaw", "frozen", "other time"])
def test_wrong_telemetry_is_refused_and_bends_no_body(kind: str) -> None:
    true = flown()
    rotation, position = true.rotation.copy(), true.position.copy()
    if kind == "yaw":
        turn = exp_so3(np.array([0.0, 0.0, np.deg2rad(40.0)]))
        rotation = rotation @ turn
    elif kind == "frozen":
        stop = round(8.0 * FPS)
        rotation[stop:], position[stop:] = rotation[stop], position[stop]
    else:
        late = round(2.0 * FPS)
        rotation, position = np.roll(rotation, late, axis=0), np.roll(position, late, axis=0)
        rotation[:late], position[:late] = rotation[late], position[late]
    history = replace(true, rotation=rotation, position=position).history(keep_s=60.0)
    windows = windows_of(run(true.observations, history, SELDOM))
    last = windows[-1]
    assert last.telemetry is TelemetryUse.REFUSED
    assert last.in_map is None
    assert {"yaw": "foot", "frozen": "stopped", "other time": "feet"}[kind] in last.reason
    # The poses are those of a graph without telemetry.
    without = without_telemetry()
    place = np.searchsorted(true.stamp_ns, last.stamp_ns)
    bent, free = (pa_mpjpe(w.joints3d.astype(float), true.truth[place]).mean() for w in (windows[-1], without))
    assert bent < 1.05 * free + 0.001


def test_poses_that_stop_are_refused_even_when_no_window_remembers_the_motion() -> None:
    true = orbit(16.0, action="stand")
    rotation, position = true.rotation.copy(), true.position.copy()
    stop = round(6.0 * FPS)
    rotation[stop:], position[stop:] = rotation[stop], position[stop]
    history = replace(true, rotation=rotation, position=position).history(keep_s=60.0)
    # A standing person looks like one who turns: her feet do not tell.
    use = [w.telemetry for w in windows_of(run(true.observations, history))]
    assert TelemetryUse.USED in use[:7]
    assert set(use[8:]) == {TelemetryUse.REFUSED}


def test_fixed_points_measure_the_reports_and_correct_them_from_window_to_window() -> None:
    true = flown()
    # Pitch, yaw and roll of a cheap gimbal.
    wrong = exp_so3(np.deg2rad([1.0, -2.0, 0.8]))
    cameras = replace(true, rotation=wrong @ true.rotation).history(keep_s=60.0)
    begin_ns = true.stamp_ns[0]
    with_points = run(true.observations, cameras, points_at=true.points_at)
    without = run(true.observations, cameras, SELDOM)
    found, blind = ([w for w in windows_of(results) if w.in_map is not None] for results in (with_points, without))
    assert (found[0].stamp_ns[-1] - begin_ns) * 1e-9 < 2.5
    assert all(w.calibration for w in found)
    assert not any(w.calibration for w in blind)
    last = found[-1]
    assert last.in_map is not None
    at = np.searchsorted(true.stamp_ns, last.stamp_ns)
    turned = log_so3(last.in_map.rotation @ np.swapaxes(true.rotation[at], 1, 2))
    assert np.degrees(np.linalg.norm(turned, axis=1)).max() < 0.3
    with_it, without_it = errors(newest(found), true), errors(newest(blind), true)
    assert with_it.absolute_mm < 0.7 * without_it.absolute_mm
    # Points that end leave their calibration to nobody, and their scale to the windows after them.
    dark_ns = begin_ns + 8 * S

    def until(stamp_ns: np.ndarray) -> Background | None:
        return true.points_at(stamp_ns) if stamp_ns[-1] < dark_ns else None

    after = windows_of(run(true.observations, cameras, SELDOM, until))
    assert {w.telemetry for w in after if w.stamp_ns[-1] > dark_ns} == {TelemetryUse.USED}


def test_reports_of_another_flight_are_refused_by_the_points_and_seldom_asked_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    true, asked = flown(), list[int]()

    def counted(camera: CameraPath, *rest: Any) -> Fusion | Refusal | None:
        asked.append(int(camera.stamp_ns[-1]))
        return fuse_telemetry(camera, *rest)

    monkeypatch.setattr("drocap_ros.reconstruction.live.world_windows.fuse_telemetry", counted)
    other = replace(true, rotation=true.rotation[::-1], position=true.position[::-1])
    # The same vehicle films the second subject: the pause goes on.
    half = len(true.observations) // 2
    stream = [replace(o, track_id=1 + (i >= half)) for i, o in enumerate(true.observations)]
    windows = windows_of(run(stream, other.history(keep_s=60.0), points_at=true.points_at))
    told = [w for w in windows if w.telemetry is not TelemetryUse.LATE]
    assert {w.telemetry for w in told} == {TelemetryUse.REFUSED}
    assert "turn otherwise" in told[0].reason
    assert told[0].reason.endswith("asked again after 4 s")
    assert told[-1].reason.endswith("asked again after 8 s")
    pauses = np.diff(asked) / S
    assert len(told) > 2 * len(asked)
    assert (pauses >= [4.0, 8.0][: len(pauses)]).all()


def test_another_subject_starts_without_the_findings_of_the_first() -> None:
    second = orbit(6.0, begin_ns=40 * S, track_id=2)
    history = flown().history(keep_s=100.0)
    for stamp, position, turn in zip(second.stamp_ns.tolist(), second.position, second.rotation, strict=True):
        history.add_pose(stamp, position, quaternion_from_matrix(turn.T))
    alone = windows_of(run(second.observations, history, SELDOM))
    first = flown().observations[: round(6.5 * FPS)]
    both = windows_of(run([*first, *second.observations], history, SELDOM))
    assert TelemetryUse.USED in [w.telemetry for w in both[: -len(alone)]]
    for a, b in zip(alone, both[-len(alone) :], strict=True):
        assert a.telemetry is b.telemetry
        np.testing.assert_array_equal(a.joints3d, b.joints3d)


def test_the_latest_pose_is_in_its_place_in_map() -> None:
    steps = [r for r in followed() if isinstance(r, Step)]
    placed = {s.latest.stamp_ns: s.latest for s in steps if s.latest and s.latest.rotation is not None}
    found = errors({stamp: pose.joints3d for stamp, pose in placed.items()}, flown())
    assert len(placed) > 30
    assert found.absolute_mm < 250.0
    assert all(pose.covariance.shape == (17, 6) for pose in placed.values())
    # Without the camera's pose, and before a window is in the world, there is no place.
    first_ns = next(w.stamp_ns[-1] for w in windows_of(followed()) if w.in_map is not None)
    assert min(placed) > first_ns
    end = round(10.5 * FPS)
    blind = run(flown().observations[:end], flown().history(slice(0, round(10.0 * FPS)), keep_s=60.0))
    last = [r.latest for r in blind if isinstance(r, Step)][-1]
    assert last is not None
    assert last.rotation is None
    assert np.abs(last.joints3d[0]).max() < 1e-9
