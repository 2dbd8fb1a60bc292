"""Clips with cuts: where they are, and the motion over them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, Scene, looking, orbit, points_of, seen
from walking import make_walk

from drocap_ros.background import Background
from drocap_ros.reconstruction.camera.kinds import cut_times, cuts
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

FPS = 24.0
FRAMES = 144
HALF = FRAMES // 2
TIME_S = np.arange(FRAMES) / FPS


def background(scene: Scene, noise_px: float = 0.3) -> Background:
    noise = np.random.default_rng(3).normal(0.0, noise_px, scene.point.shape)
    return Background(
        scene.frame.astype(np.int32), scene.track.astype(np.int64), (scene.point + noise).astype(np.float32)
    )


def standing() -> Scene:
    rotation, position = (np.repeat(values, FRAMES, axis=0) for values in orbit(1, FPS))
    return seen(rotation, position, points_of(np.random.default_rng(5), 300), FPS)


def two_cameras() -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions of an orbit, and from the middle on of another one at the other side of the person."""
    position = orbit(FRAMES, FPS)[1]
    position[HALF:, :2] *= -0.8
    return looking(position, np.tile([0.0, 0.0, 0.9], (FRAMES, 1))), position


def walk() -> np.ndarray:
    """(F, 15, 3) m of a person who walks on the spot, on the ground z = 0."""
    simulated = make_walk(FRAMES)
    joints = simulated.in_camera @ simulated.camera
    return joints - [0.0, 0.0, joints[..., 2].min() - 0.07]


def clip(rotation: np.ndarray, position: np.ndarray) -> Tracks:
    """The person and fixed points, as these cameras see them; no point goes on over the middle."""
    scene = seen(rotation, position, points_of(np.random.default_rng(5), 150), FPS)
    joints = (walk() - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    pixels = joints[..., :2] / joints[..., 2:] * np.diagonal(MATRIX)[:2] + MATRIX[:2, 2]
    return Tracks(
        keypoints=pixels + np.random.default_rng(4).normal(0.0, 1.0, pixels.shape),
        joints=BODY_15.joints,
        stamp_ns=10**12 + np.round(TIME_S * 1e9).astype(np.int64),
        image_size=SIZE,
        camera_matrix=MATRIX,
        background=background(scene._replace(track=scene.track + 10**9 * (scene.frame >= HALF))),
    )


def test_cut_to_another_scene_is_found_at_its_image() -> None:
    assert cuts(clip(*two_cameras()).background, TIME_S) == [HALF]


def test_cut_whose_first_images_have_no_points_is_found_at_the_first_of_them() -> None:
    points = clip(*two_cameras()).background
    dark = (points.frame >= HALF) & (points.frame < HALF + 5)
    assert cuts(Background(points.frame[~dark], points.track[~dark], points.point[~dark]), TIME_S) == [HALF]


@pytest.mark.parametrize("factor", [0.7, 1.15])
def test_cut_to_a_nearer_or_farther_view_is_found_though_points_go_on(factor: float) -> None:
    scene = standing()
    nearer = np.where(
        (scene.frame >= HALF)[:, None], MATRIX[:2, 2] + factor * (scene.point - MATRIX[:2, 2]), scene.point
    )
    assert cuts(background(scene._replace(point=nearer)), TIME_S) == [HALF]


def test_neither_a_still_camera_nor_a_fast_flight_nor_a_zoom_has_cuts() -> None:
    assert cuts(background(standing()), TIME_S) == []
    fast = seen(*orbit(FRAMES, FPS, turn_deg_s=70.0), points_of(np.random.default_rng(5), 400), FPS, longest_s=0.5)
    assert cuts(background(fast), TIME_S) == []
    few = seen(*orbit(FRAMES, FPS), points_of(np.random.default_rng(5), 150), FPS)
    assert cuts(background(few), TIME_S) == []
    position = np.stack([np.linspace(-24.0, -3.0, FRAMES), np.zeros(FRAMES), np.full(FRAMES, 2.0)], axis=1)
    ahead = seen(
        looking(position, np.tile([5.0, 0.0, 1.0], (FRAMES, 1))),
        position,
        points_of(np.random.default_rng(5), 400),
        FPS,
    )
    assert cuts(background(ahead), TIME_S) == []
    scene = standing()
    zoom = np.exp(0.3 * scene.frame / FPS)[:, None]
    assert cuts(background(scene._replace(point=MATRIX[:2, 2] + zoom * (scene.point - MATRIX[:2, 2]))), TIME_S) == []


def test_few_points_of_which_some_slide_are_no_cut() -> None:
    scene = standing()
    number = scene.track // 1000
    few = np.isin(number, np.unique(number)[:16])
    slide = np.isin(number, np.unique(number)[:3]) & (scene.frame >= HALF)
    point = scene.point + 300.0 * slide[:, None]
    assert np.bincount(scene.frame[few]).min() >= 12
    kept = scene._replace(frame=scene.frame[few], track=scene.track[few], point=point[few])
    assert cuts(background(kept), TIME_S) == []


def test_clip_of_two_cameras_is_that_without_points_and_its_cut_is_named() -> None:
    tracks = clip(*two_cameras())
    motion, without = reconstruct(tracks), reconstruct(replace(tracks, background=None))
    assert motion.frame == "camera"
    np.testing.assert_array_equal(motion.joints3d, without.joints3d)
    assert motion.meta["cuts_s"] == [3.0]
    assert telemetry_words(motion.meta).startswith("Cut at 3.0 s")
    assert "cuts_s" not in without.meta


def test_telemetry_is_one_camera_over_its_cuts() -> None:
    tracks = clip(*two_cameras())
    assert cut_times(tracks) == [3.0]
    assert cut_times(replace(tracks, camera_rotation=two_cameras()[0])) == []
