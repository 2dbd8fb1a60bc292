"""Telemetry that cannot be true is noticed, and true telemetry that looks odd is not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_world_adjustment import FPS, MATRIX, followed, orbit, project, tracks, walker

from drocap_ros.contacts import RestingFeet
from drocap_ros.evaluation.metrics import scale_error
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.world import even_capture
from drocap_ros.reconstruction.world.telemetry_checks import frozen, jump_m, turned_at_once
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.report.checks import MotionCheck, Severity, run_checks
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks

RATE = np.deg2rad(19.0)


def view(joints: np.ndarray, bearing: np.ndarray) -> Tracks:
    """Person seen from a bearing (F,) rad, with exact telemetry."""
    rotation, position = orbit(bearing, followed(joints))
    return replace(
        tracks(joints), keypoints=project(joints, rotation, position), camera_rotation=rotation,
        camera_position=position,
    )  # fmt: skip


def hover_then_orbit(frames: int, hover_s: float) -> np.ndarray:
    """(F,) rad: at rest, then at 19 deg/s, with a second to get there."""
    past = np.maximum(np.arange(frames) / FPS - hover_s, 0.0)
    return RATE * np.where(past < 1.0, 0.5 * past**2, past - 0.5)


@pytest.mark.parametrize("hover_s", [1.1, 3.0])
def test_a_vehicle_that_rests_before_or_after_it_flies_is_not_a_frozen_log(hover_s: float) -> None:
    bearing = hover_then_orbit(240, hover_s)
    for at in (bearing, bearing[::-1], np.concatenate([bearing[::-1], bearing])):
        rotation, position = orbit(at, np.zeros((len(at), 2)))
        assert not frozen(rotation, position, FPS)


@pytest.mark.parametrize("part", [slice(120, 240), slice(0, 120), slice(100, 130)])
def test_a_log_that_stops_at_once_is_frozen(part: slice) -> None:
    rotation, position = orbit(RATE * np.arange(240) / FPS, np.zeros((240, 2)))
    at = np.arange(240)
    at[part] = part.start
    assert "stops at once" in str(frozen(rotation[at], position[at], FPS))


def test_a_camera_that_stands_still_for_some_time_is_mentioned() -> None:
    """A log that freezes while the vehicle stands, as when an orbit turns round, looks the same."""
    joints = walker(120)
    for seen, said in ((view(joints, hover_then_orbit(120, 0.0)), False), (still_then_orbit(joints), True)):
        motion = reconstruct(seen)
        assert motion.frame == "world"
        assert ("stands still for 2.0 s" in telemetry_words(motion.meta)) is said


def still_then_orbit(joints: np.ndarray) -> Tracks:
    rotation, position = orbit(hover_then_orbit(len(joints), 2.0), np.zeros((len(joints), 2)))
    keypoints = project(joints, rotation, position)
    return replace(tracks(joints), keypoints=keypoints, camera_rotation=rotation, camera_position=position)


@pytest.mark.parametrize("fps", [10.0, 24.0, 60.0])
def test_a_yaw_that_jumps_is_noticed_and_quick_turns_are_not(fps: float) -> None:
    frames = round(8 * fps)
    time = np.arange(frames) / fps
    rotation, _ = orbit(RATE * time, np.zeros((frames, 2)))
    yaw: dict[str, np.ndarray] = {
        "starts at once": np.maximum(time - 4.0, 0.0) * 60.0,
        "turns": 40.0 / (1.0 + np.exp(-(time - 4.0) / 0.15)),
        "shakes": 3.0 * np.sin(2 * np.pi * 1.5 * time),
        "corrects": np.where(np.arange(frames) == frames // 2, 5.5, 0.0),  # simulated orbits reach 5.3
    }
    for values in yaw.values():
        assert not turned_at_once(turned(rotation, values), fps)
    jump = np.where(time > 4.0, 15.0, 0.0)
    spike = np.where(np.arange(frames) == frames // 2, 15.0, 0.0)
    slower = np.interp(time, [4.0, 4.1], [0.0, 15.0])
    for values in (jump, spike, slower):
        assert "jumps by" in str(turned_at_once(turned(rotation, values), fps))


def turned(rotation: np.ndarray, yaw_deg: np.ndarray) -> np.ndarray:
    """Rotations (F, 3, 3) world -> camera of a reported yaw that is off."""
    return rotation @ exp_so3(np.deg2rad(yaw_deg)[:, None] * [0.0, 0.0, 1.0])


def test_one_good_window_does_not_excuse_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The yaw goes astray slowly in the last third: its feet alone tell."""
    monkeypatch.setattr(even_capture, "_WINDOW", 120)
    seen = tracks(walker(300))
    assert seen.camera_rotation is not None
    astray = np.interp(np.arange(300), [200, 224], [0.0, 60.0])
    assert reconstruct(seen).frame == "world"
    motion = reconstruct(replace(seen, camera_rotation=turned(seen.camera_rotation, astray)))
    assert motion.frame == "camera"
    assert "check" in motion.meta["telemetry_rejected"]


def glider() -> np.ndarray:
    """One who stands and moves at 2 m/s."""
    joints = np.repeat(walker(1), 144, axis=0)
    joints[..., 0] += 2.0 * np.arange(144)[:, None] / FPS
    return joints


def test_who_glides_is_refused_with_the_reason_and_accepted_without_feet() -> None:
    gliding = tracks(glider())
    assert "glides" in reconstruct(gliding).meta["telemetry_rejected"]
    assert reconstruct(gliding, adjuster=BundleAdjusterConfig(feet=False)).frame == "world"


def test_axes_north_east_down_are_refused() -> None:
    seen = tracks(walker(96))
    assert seen.camera_rotation is not None
    assert seen.camera_position is not None
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    for position in (seen.camera_position @ ned, None):
        motion = reconstruct(replace(seen, camera_rotation=seen.camera_rotation @ ned, camera_position=position))
        assert "upside down" in motion.meta["telemetry_rejected"]


def test_a_measured_stature_that_nobody_has_is_said() -> None:
    joints = walker(240)
    for lens, said in ((1.0, False), (0.75, True)):
        matrix = MATRIX * [[lens], [lens], [1.0]]
        matrix[:2, 2] = MATRIX[:2, 2]
        motion = reconstruct(replace(tracks(joints), camera_matrix=matrix))
        assert motion.metric
        assert ("check the lens" in telemetry_words(motion.meta)) is said


def window(**changed: Any) -> dict[str, Any]:
    good = {
        "scale": 1.0, "scale_std": 0.02, "stature_std": 0.05, "misalignment_deg": [0.1, 0.5, 0.0],
        "misalignment_std_deg": [0.3, 1.0, 0.3], "attitude_latency_s": 0.0, "attitude_latency_std_s": 0.1,
        "position_latency_s": 0.0, "position_latency_std_s": 0.1, "contact_share": 0.4,
    }  # fmt: skip
    return {**good, **changed}


def test_words_are_those_of_the_worst_window() -> None:
    bad = window(misalignment_deg=[0.1, 7.0, 0.0], contact_share=0.1, scale_std=0.025)
    words = telemetry_words({"calibration": [window(), bad, window()]})
    assert "yaw corrected by 7.0 +- 1.0 deg" in words
    assert "scale known to 2.5 %, feet in contact for 10 % of the time (worst of 3 windows)" in words
    assert telemetry_words({"calibration": [window()]}).startswith("No error")


def test_ankles_that_nobody_sees_hold_no_contact() -> None:
    joints, seen = np.repeat(walker(1), 48, axis=0), np.ones((48, 17), bool)
    right, left = BODY_17.index("rankle"), BODY_17.index("lankle")
    seen[:, right], seen[20:24, left] = False, False
    found = RestingFeet(seen, FPS).probability(joints, 0.0, 0.15)
    everywhere = RestingFeet(np.ones((48, 17), bool), FPS).probability(joints, 0.0, 0.15)
    assert not found[:, 0].any()
    np.testing.assert_array_equal(found[:, 1], everywhere[:, 1])  # hidden for a moment


def test_legs_that_are_never_seen_measure_no_scale() -> None:
    seen = tracks(walker(192))
    legs = [BODY_17.index(name) for name in ("rknee", "lknee", "rankle", "lankle", "rtoe", "ltoe")]
    seen.keypoints[:, legs] = np.nan
    motion = reconstruct(seen)
    assert motion.frame == "world"
    assert not motion.metric


def test_heights_in_steps_do_not_inflate_the_person() -> None:
    """A hover that drifts; the height has steps of 0.1 m."""
    joints = walker(240)
    time = np.arange(240)[:, None] / FPS
    rotation, position = orbit(np.zeros(240), followed(joints))
    position = position + 0.25 * np.sin(0.8 * time + np.array([0.0, 1.0, 2.0]))
    true = replace(
        tracks(joints), keypoints=project(joints, rotation, position), camera_rotation=rotation,
        camera_position=position,
    )  # fmt: skip
    rounded = replace(true, camera_position=np.column_stack([position[:, :2], np.round(position[:, 2], 1)]))
    sizes = [scale_error(reconstruct(seen).joints3d[:, :15], joints[:, :15]) for seen in (true, rounded)]
    assert abs(sizes[1] - sizes[0]) < 0.03


def test_a_height_that_is_set_anew_is_said_and_a_doubt() -> None:
    joints = walker(240)
    seen = view(joints, RATE * np.arange(240) / FPS)
    assert seen.camera_position is not None
    step = np.clip((np.arange(240) - 120) / 2.0, 0.0, 1.0)[:, None]  # over two images: the next state comes later
    jumped = replace(seen, camera_position=seen.camera_position + step * [0.0, 0.0, 1.0])
    for given, said in ((seen, False), (jumped, True)):
        motion = reconstruct(given)
        assert motion.frame == "world"
        assert ("reported position jumps by 1.0 m" in telemetry_words(motion.meta)) is said
        warned = [r.check for r in run_checks(motion, motion_statistics(motion)) if r.severity is Severity.WARNING]
        assert (MotionCheck.TELEMETRY_JUMPS in warned) is said


def test_a_hard_start_of_a_vehicle_is_no_jump() -> None:
    for fps in (5.0, 24.0, 120.0):
        time = np.arange(0.0, 10.0, 1.0 / fps)
        path = 0.5 * 5.0 * np.clip(time - 4.0, 0.0, 1.0) ** 2 + 5.0 * np.maximum(time - 5.0, 0.0)
        position = np.stack([path, 0.0 * path, 0.0 * path], axis=1)
        assert jump_m(position, fps) == 0.0
        assert jump_m(position + 1.0 * (time > 7.0)[:, None], fps) == pytest.approx(np.sqrt(3.0), abs=0.2)
