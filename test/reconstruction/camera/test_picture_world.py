"""Motions in the world without telemetry: reconstruct with fixed points of the scene."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, looking, orbit, points_of, seen, shape_error
from walking import make_walk

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath, Kind, PictureFacts, UpSource
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.camera.upright import set_upright
from drocap_ros.reconstruction.reconstruct import reconstruct, solve
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks
from lab.simulation.capture import SimulationConfig, simulate_capture

FPS = 24.0
FRAMES = 120


def person() -> np.ndarray:
    """(F, 15, 3) m, z up, on the ground z = 0, at one place."""
    walk = make_walk(FRAMES)
    joints = walk.in_camera @ walk.camera
    return joints - [0.0, 0.0, joints[..., 2].min() - 0.07]


def tracks(rotation: np.ndarray, position: np.ndarray, cut: bool = False) -> Tracks:
    """The person and fixed points, as a camera without telemetry sees them."""
    scene = seen(rotation, position, points_of(np.random.default_rng(5), 150), FPS)
    noise = np.random.default_rng(3).normal(0.0, 0.3, scene.point.shape)
    track = scene.track + 10**9 * (scene.frame >= FRAMES // 2) if cut else scene.track
    joints = (person() - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    pixels = joints[..., :2] / joints[..., 2:] * np.diagonal(MATRIX)[:2] + MATRIX[:2, 2]
    return Tracks(
        keypoints=pixels + np.random.default_rng(4).normal(0.0, 1.0, pixels.shape),
        joints=BODY_15.joints,
        stamp_ns=np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64),
        image_size=SIZE,
        camera_matrix=MATRIX,
        background=Background(
            scene.frame.astype(np.int32), track.astype(np.int64), (scene.point + noise).astype(np.float32)
        ),
    )


def tilt_deg(motion: Motion, rotation: np.ndarray) -> float:
    """Angle of the motion's vertical from the true one, both as the camera sees them."""
    return float(
        np.degrees(np.arccos(np.clip((motion.camera_rotation[:, :, 2] * rotation[:, :, 2]).sum(-1), -1, 1))).max()
    )


def test_moving_camera_gives_a_world_that_is_upright_and_has_the_person_at_one_place() -> None:
    rotation, position = orbit(FRAMES, FPS)
    motion = reconstruct(tracks(rotation, position))
    assert motion.frame == "world"
    assert not motion.metric
    assert motion.scale_source == "assumed_height"
    assert tilt_deg(motion, rotation) < 2.0
    assert shape_error(motion.camera_position, position) < 0.1
    pelvis = motion.joints3d[:, 0]
    assert np.linalg.norm(np.ptp(pelvis, axis=0)) < 0.5
    assert motion.meta["camera"]["kind"] == "moves"
    assert motion.meta["camera"]["up"] == "ground"
    json.dumps(motion.meta, allow_nan=False)
    assert "camera that moves" in telemetry_words(motion.meta)


def test_feet_and_body_correct_a_path_whose_scale_drifts_as_its_points_allow() -> None:
    rotation, position = orbit(FRAMES, FPS)
    shares = np.linspace(1.0, 0.85, FRAMES - 1)[:, None]
    drifted = np.concatenate([position[:1], position[0] + np.cumsum(shares * np.diff(position, axis=0), axis=0)])
    scene = seen(rotation, drifted, points_of(np.random.default_rng(5), 100), FPS)
    noisy = scene.point + np.random.default_rng(3).normal(0.0, 2.0, scene.point.shape)
    background = Background(scene.frame.astype(np.int32), scene.track.astype(np.int64), noisy.astype(np.float32))
    motion = reconstruct(replace(tracks(rotation, position), background=background))
    # Held to the path alone, the person who walks on the spot wanders by 1.3 m.
    assert np.linalg.norm(np.ptp(motion.joints3d[:, 0], axis=0)) < 0.9


def test_camera_that_stands_still_gives_a_world_at_its_place() -> None:
    rotation, position = (np.repeat(values, FRAMES, axis=0) for values in orbit(1, FPS))
    motion = reconstruct(tracks(rotation, position))
    assert motion.frame == "world"
    assert motion.meta["camera"]["kind"] == "stands"
    assert tilt_deg(motion, rotation) < 7.0
    assert np.ptp(motion.camera_position, axis=0).max() < 0.1


def test_feet_seen_from_high_above_stay_on_the_ground_that_is_seen() -> None:
    near = orbit(FRAMES, FPS)[1]
    position = 2.5 * near * [1.0, 1.0, 0.0] + [0.0, 0.0, 14.0]
    rotation = looking(position, np.tile([0.0, 0.0, 0.9], (FRAMES, 1)))
    motion = reconstruct(tracks(rotation, position))
    assert motion.meta["camera"]["up"] == "ground"
    ankles = motion.joints3d[:, [motion.joints.index("rankle"), motion.joints.index("lankle")], 2].min(axis=1)
    low, high = np.percentile(ankles, [5, 95])
    assert high - low < 0.15, (low, high)  # by the size of the body alone 0.16
    assert -0.15 < low < high < 0.3


def tripod(action: str, seed: int, telemetry: bool = False, points: bool = True) -> tuple[Tracks, np.ndarray]:
    """Somebody before a camera that stands from 1 to 2.5 m high, and the camera's true rotation (F, 3, 3)."""
    settings = SimulationConfig(action=action, angular_speed_deg_s=0.0, height_m=1.0 + 0.5 * seed)
    capture = simulate_capture(8.0, 15.0, seed, settings)
    rng, frames = np.random.default_rng(seed), len(capture.tracks)
    spots = rng.uniform(0.0, 1.0, (80, 2)) * capture.tracks.image_size
    seen_at = (spots + rng.normal(0.0, 0.3, (frames, 80, 2))).astype(np.float32).reshape(-1, 2)
    numbers = np.arange(frames, dtype=np.int32).repeat(80), np.tile(np.arange(80, dtype=np.int64), frames)
    rotation = np.repeat(capture.camera_rotation[:1], frames, axis=0)
    given = replace(
        capture.tracks,
        camera_rotation=rotation if telemetry else None,
        camera_position=None,
        background=Background(*numbers, seen_at) if points else None,
    )
    return given, rotation


def test_up_of_a_camera_that_stands_errs_by_what_is_said() -> None:
    sigmas = []
    for action in ("squats", "kicking", "stand", "boxing"):
        for seed in range(4):
            given, rotation = tripod(action, seed)
            motion = reconstruct(given)
            assert motion.meta["camera"]["kind"] == "stands"
            sigmas.append(tilt_deg(motion, rotation) / motion.meta["camera"]["up_std_deg"])
    within = np.mean(np.array(sigmas) < 2.15)  # 90 % of a plane's two errors
    assert within >= 0.75, sigmas
    assert np.mean(sigmas) > 0.25, sigmas  # not by saying too much either


@pytest.mark.parametrize("points", [True, False])
def test_an_attitude_that_is_told_is_up_and_the_person_keeps_his_way(points: bool) -> None:
    given, rotation = tripod("squats", 1, telemetry=True, points=points)
    motion = reconstruct(given)
    assert motion.frame == "world"
    assert motion.meta["camera"]["up"] == "told"
    assert tilt_deg(motion, rotation) < 2.0
    unknown = reconstruct(tripod("squats", 1)[0])
    for each in (motion, unknown):
        feet = each.joints3d[:, [each.joints.index("rankle"), each.joints.index("lankle")], 2]
        assert np.ptp(feet) < 0.3  # they stand while the pelvis sinks
        assert np.ptp(each.joints3d[:, 0, 2]) > 0.2


def test_cut_within_one_camera_leaves_the_motion_in_camera_axes_and_is_named() -> None:
    given = tracks(*orbit(FRAMES, FPS), cut=True)
    motion = solve(given).motion
    assert motion.frame == "camera"
    assert motion.meta["camera"]["kind"] == "cut"
    assert "cut" in telemetry_words(motion.meta)
    without = reconstruct(replace(given, background=None))
    np.testing.assert_array_equal(motion.joints3d, without.joints3d)


def upright(
    rotation: np.ndarray, position: np.ndarray, points: np.ndarray, joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray, PictureFacts]:
    stamps = np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
    given = CameraPath(stamps, rotation, position, picture=PictureFacts(Kind.MOVES, points=points))
    found = set_upright(given, joints)
    assert found.picture is not None
    return *found.pose, found.picture


@pytest.mark.parametrize("unit", [0.05, 30.0])
def test_unit_and_axes_of_a_path_do_not_matter_for_up_and_metres(unit: float) -> None:
    rotation, position = orbit(FRAMES, FPS)
    rng = np.random.default_rng(2)
    turn, points = exp_so3(np.array([1.0, -0.5, 2.0])), points_of(rng, 300)
    seen_joints = (person() - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    lying = np.column_stack([unit * points @ turn.T, np.ones(len(points))])
    turned, moved, facts = upright(rotation @ turn.T, unit * position @ turn.T, lying, seen_joints)
    assert facts.up is UpSource.GROUND
    assert np.degrees(np.arccos((turned[:, :, 2] * rotation[:, :, 2]).sum(-1))).max() < 1.0
    assert np.median(moved[:, 2] / position[:, 2]) == pytest.approx(1.0, abs=0.1)
    assert np.ptp(moved[:, 0]) > 0.0


def test_level_view_has_an_up() -> None:
    position = np.stack([np.linspace(-2.0, 2.0, FRAMES), np.full(FRAMES, -6.0), np.full(FRAMES, 1.0)], axis=1)
    rotation = looking(position, position + np.array([0.0, 1.0, 0.0]))
    joints = (person() - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    turned, _, facts = upright(rotation, position, np.zeros((0, 4)), joints)
    assert facts.up is not UpSource.GROUND
    assert turned[0, 1, 2] == pytest.approx(-1.0, abs=0.03)


def test_scale_is_a_guess_where_neither_ground_nor_feet_tell_it() -> None:
    rotation, position = orbit(FRAMES, FPS)
    joints = (person() - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    far = np.column_stack([np.random.default_rng(2).normal(0.0, 0.3, (15, 3)), np.ones(15)])
    _, _, facts = upright(rotation, 0.1 * position, far, joints)
    assert facts.scale_std > 0.5
    assert not facts.feet_tell
