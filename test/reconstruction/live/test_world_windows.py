"""Live windows in the world: near the truth with telemetry, in the camera's axes without, and the latest pose there."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from telemetry_stream import FPS, Orbit, orbit

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.evaluation.compare import WorldErrors, world_errors
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.rotations import exp_so3, log_so3, quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.initializer import InitialPose, LiveInitializer
from drocap_ros.reconstruction.live.latest_pose import LatestPlace, LatestPose, median_bone_lengths
from drocap_ros.reconstruction.live.replay import LivePose, LiveWindow, live_poses
from drocap_ros.reconstruction.live.window import TelemetryUse
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.tracks import Tracks

S = 10**9
ADJUSTER = BundleAdjusterConfig()
#: Half the windows, where the last one counts.
SELDOM = BundleAdjusterConfig(period_s=2.0)
#: Poses of streams that were lifted before, by all their images so far, which it keeps alive.
LIFTED: dict[int, tuple[InitialPose | None, StreamEvent, PoseObservation]] = {}
CameraAt = Callable[[np.ndarray, tuple[int, int]], CameraPath | None]


class Remembering:
    """An initializer that lifts no stream twice: telemetry, of which these tests are, does not change its poses."""

    event: StreamEvent

    def __init__(self, config: InitializerConfig) -> None:
        self._config, self._past, self._key = config, list[PoseObservation](), 0
        self._own: LiveInitializer | None = None

    def push(self, observation: PoseObservation) -> InitialPose | None:
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


@pytest.fixture(autouse=True)
def lifted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drocap_ros.reconstruction.live.replay.LiveInitializer", Remembering)


def run(
    observations: list[PoseObservation],
    camera_at: CameraAt,
    adjuster: BundleAdjusterConfig = ADJUSTER,
    points_at: Callable[[np.ndarray], Background | None] | None = None,
) -> list[LivePose | LiveWindow]:
    return list(live_poses(observations, InitializerConfig(), adjuster, camera_at=camera_at, points_at=points_at))


def windows_of(results: list[LivePose | LiveWindow]) -> list[LiveWindow]:
    return [r for r in results if isinstance(r, LiveWindow)]


@lru_cache(maxsize=1)
def flown() -> Orbit:
    return orbit(13.0)


@lru_cache(maxsize=1)
def followed() -> list[LivePose | LiveWindow]:
    return run(flown().observations, flown().history(keep_s=60.0).along)


@lru_cache(maxsize=1)
def without_telemetry() -> LiveWindow:
    """The last window of the same flight when no pose of the camera arrives."""
    return windows_of(run(flown().observations, lambda *_: None, SELDOM))[-1]


def errors(poses: dict[int, np.ndarray], truth: Orbit) -> WorldErrors:
    place = {int(stamp): i for i, stamp in enumerate(truth.stamp_ns)}
    stamps = sorted(poses)
    return world_errors(np.array([poses[s] for s in stamps], float), truth.truth[[place[s] for s in stamps]], FPS)


def newest(windows: list[LiveWindow]) -> dict[int, np.ndarray]:
    return {int(s): j for w in windows for s, j in zip(w.window.stamp_ns, w.joints3d, strict=True)}


def test_windows_with_telemetry_are_in_map_and_as_near_the_truth_as_offline() -> None:
    windows = windows_of(followed())
    use = [w.window.telemetry for w in windows]
    # Too short at first, then without a measured scale.
    assert use[0] is TelemetryUse.LATE
    first = use.index(TelemetryUse.USED)
    assert first < 12
    assert set(use[first:]) == {TelemetryUse.USED}
    found = [w for w in windows if w.window.in_map is not None]
    for w in found:
        assert w.window.in_map is not None
        assert len(w.window.stamp_ns) == len(w.joints3d) == len(w.window.covariance) == len(w.window.in_map.rotation)
        assert np.linalg.norm(w.window.in_map.correction[:3]) < 0.2
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
    found = [w for w in windows_of(followed()) if w.window.in_map is not None]
    steps, changes = [], []
    for before, after in itertools.pairwise(found):
        same, _, there = np.intersect1d(before.window.stamp_ns, after.window.stamp_ns, return_indices=True)
        here = np.searchsorted(before.window.stamp_ns, same)
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
    camera_at = hover.history(keep_s=60.0).along
    # The person is projected again, as the standing camera sees her.
    seen = (joints - hover.position[:, None]) @ np.swapaxes(hover.rotation, 1, 2)
    image = seen[..., :2] / seen[..., 2:] * np.diagonal(still.matrix)[:2] + still.matrix[:2, 2]
    noise = np.random.default_rng(0).normal(0.0, 1.5, image.shape)
    stream = [
        replace(o, keypoints=p.astype(np.float32)) for o, p in zip(still.observations, image + noise, strict=True)
    ]
    use = [w.window.telemetry for w in windows_of(run(stream, camera_at, SELDOM))]
    assert use[-1] is TelemetryUse.USED
    # Without the orbit before, the same last seconds measure no scale.
    alone = [w.window.telemetry for w in windows_of(run(stream[stop:], camera_at, SELDOM))]
    assert TelemetryUse.USED not in alone
    assert alone[-1] is TelemetryUse.UNSCALED


def test_windows_fall_back_to_the_camera_when_telemetry_stops() -> None:
    history = flown().history(slice(0, round(7.0 * FPS)), keep_s=60.0)
    windows = windows_of(run(flown().observations[: round(10.0 * FPS)], history.along))
    use = {round(float(w.window.stamp_ns[-1] / S), 1): w.window for w in windows}
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
    windows = windows_of(run(true.observations, history.along, SELDOM))
    last = windows[-1].window
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
    use = [w.window.telemetry for w in windows_of(run(true.observations, history.along))]
    assert TelemetryUse.USED in use[:7]
    assert set(use[8:]) == {TelemetryUse.REFUSED}


def test_fixed_points_measure_the_reports_and_correct_them_from_window_to_window() -> None:
    true = flown()
    # Pitch, yaw and roll of a cheap gimbal.
    wrong = exp_so3(np.deg2rad([1.0, -2.0, 0.8]))
    camera_at = replace(true, rotation=wrong @ true.rotation).history(keep_s=60.0).along
    begin_ns = true.stamp_ns[0]
    with_points = run(true.observations, camera_at, points_at=true.points_at)
    without = run(true.observations, camera_at, SELDOM)
    found, blind = (
        [w for w in windows_of(results) if w.window.in_map is not None] for results in (with_points, without)
    )
    assert (found[0].window.stamp_ns[-1] - begin_ns) * 1e-9 < 2.5
    assert all(w.window.calibration for w in found)
    assert not any(w.window.calibration for w in blind)
    last = found[-1].window
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

    after = [w.window for w in windows_of(run(true.observations, camera_at, SELDOM, until))]
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
    windows = [w.window for w in windows_of(run(stream, other.history(keep_s=60.0).along, points_at=true.points_at))]
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
    alone = windows_of(run(second.observations, history.along, SELDOM))
    first = flown().observations[: round(6.5 * FPS)]
    both = windows_of(run([*first, *second.observations], history.along, SELDOM))
    assert TelemetryUse.USED in [w.window.telemetry for w in both[: -len(alone)]]
    for a, b in zip(alone, both[-len(alone) :], strict=True):
        assert a.window.telemetry is b.window.telemetry
        np.testing.assert_array_equal(a.joints3d, b.joints3d)


def test_the_latest_pose_is_in_its_place_in_map() -> None:
    true = flown()
    history = true.history(keep_s=60.0)
    lengths, latest = LatestPose(0.5), LatestPlace(0.5)
    poses: dict[int, np.ndarray] = {}
    for result in followed():
        if isinstance(result, LiveWindow):
            # Half a second later in the graph; at once here.
            now = int(result.window.stamp_ns[-1])
            lengths.set_solution(median_bone_lengths(result.window.joints3d), now)
            latest.set_solution(result.window, now)
            continue
        o = result.observation
        rigid = lengths.pose(o.stamp_ns, result.joints3d.astype(float))
        camera = history.along(np.array([o.stamp_ns], np.int64))
        placed = latest.place(o.stamp_ns, (rigid, result.pose.covariance), o.keypoints.astype(float), camera)
        if placed is not None:
            poses[o.stamp_ns] = placed.joints
            assert placed.covariance.shape == (17, 6)
    found = errors(poses, true)
    assert len(poses) > 30
    assert found.absolute_mm < 250.0
    # Without the camera's pose there is no place.
    assert latest.place(o.stamp_ns, (rigid, result.pose.covariance), o.keypoints.astype(float), None) is None
    unsolved = next(r.window for r in followed() if isinstance(r, LiveWindow) and r.window.in_map is None)
    latest.set_solution(unsolved, o.stamp_ns)
    assert latest.place(o.stamp_ns, (rigid, result.pose.covariance), o.keypoints.astype(float), camera) is None
