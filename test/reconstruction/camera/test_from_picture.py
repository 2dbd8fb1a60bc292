"""The camera of a recording without telemetry, by simulated fixed points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, Scene, looking, orbit, points_of, seen, shape_error, turn_errors_deg

from drocap_ros.camera_path import Kind, PictureFacts
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.camera.from_picture import camera_from_points
from drocap_ros.reconstruction.common.engine import blas_threads

FPS = 12.0
FRAMES = 72


def orbiting(flat: bool = False, points: int = 400) -> Scene:
    rng = np.random.default_rng(5)
    return seen(*orbit(FRAMES, FPS), points_of(rng, points, flat), FPS)


class Found(NamedTuple):
    """A camera, all of it known."""

    rotation: np.ndarray
    position: np.ndarray
    matrix: np.ndarray
    kind: Kind
    facts: PictureFacts


def camera_of(scene: Scene, matrix: np.ndarray | None = MATRIX, noise_px: float = 0.0) -> Found:
    point = scene.point + noise_px * np.random.default_rng(1).standard_normal(scene.point.shape)
    with blas_threads(1):
        camera = camera_from_points(scene.frame, scene.track, point, FPS, len(scene.rotation), SIZE, matrix)
    assert camera.picture is not None
    assert camera.matrix is not None
    return Found(*camera.pose, camera.matrix, camera.picture.kind, camera.picture)


@pytest.mark.parametrize("flat", [False, True])
def test_path_without_noise_is_found_exactly(flat: bool) -> None:
    scene = orbiting(flat)
    found = camera_of(scene)
    assert found.kind is Kind.MOVES
    assert found.facts.covered == 1.0
    assert turn_errors_deg(found.rotation, scene.rotation, FPS).max() < 0.05
    assert shape_error(found.position, scene.position) < 0.02


def test_path_and_lens_are_found_together() -> None:
    scene = orbiting()
    found = camera_of(scene, None, 0.4)
    assert found.kind is Kind.MOVES
    assert found.matrix[0, 0] == pytest.approx(MATRIX[0, 0], rel=0.02)
    assert abs(np.log(found.matrix[0, 0] / MATRIX[0, 0])) < 4.0 * found.facts.focal_std
    assert shape_error(found.position, scene.position) < 0.1


def test_start_that_a_wrong_lens_turns_inside_out_is_not_followed() -> None:
    rng, frames, count = np.random.default_rng(12), 96, 700
    bearing = 2 * np.pi * rng.random() + np.deg2rad(19.0) * np.arange(frames) / FPS
    position = np.stack([6.0 * np.cos(bearing), 6.0 * np.sin(bearing), np.full(frames, 2.5)], axis=1)
    away, angle = 60.0 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    height = np.where(rng.random(count) < 0.3, rng.uniform(0.0, 6.0, count), 0.0)
    points = np.stack([away * np.cos(angle), away * np.sin(angle), height], axis=1)
    scene = seen(looking(position, np.tile([0.0, 0.0, 0.95], (frames, 1))), position, points, FPS)
    found = camera_of(scene._replace(point=scene.point + 0.4 * rng.standard_normal(scene.point.shape)), None)
    assert found.kind is Kind.MOVES
    assert found.matrix[0, 0] == pytest.approx(MATRIX[0, 0], rel=0.02)
    assert shape_error(found.position, scene.position) < 0.05


def test_camera_that_follows_slowly_is_found_without_parallax_to_begin_with() -> None:
    time = np.arange(FRAMES) / FPS
    position = np.stack([0.5 * np.sin(0.6 * time), -8.0 + 0.3 * np.sin(0.4 * time), np.full(FRAMES, 2.5)], axis=1)
    rotation = looking(position, position + np.array([0.0, 8.0, -1.8]))
    scene = seen(rotation, position, points_of(np.random.default_rng(6), 500), FPS)
    found = camera_of(scene, noise_px=0.3)
    assert found.kind is Kind.MOVES
    assert shape_error(found.position, scene.position) < 0.05


def climbing_and_hovering(points: np.ndarray, sway_m: float) -> Scene:
    position = np.concatenate([np.zeros((54, 3)), orbit(FRAMES, FPS)[1]])
    sway = 2 * np.pi * np.arange(30) / 30
    position[:, 2] = 2.5
    position[:54, :2] = position[54, :2]
    position[:24, 2] = np.linspace(0.8, 2.5, 24)
    position[24:54, :2] += sway_m * np.stack([np.sin(2 * sway), np.sin(sway)], axis=1)
    rotation = looking(position, np.tile([0.0, 0.0, 0.9], (len(position), 1)))
    # None of the points is seen before and after the pause.
    return seen(rotation, position, points, FPS, longest_s=1.5)


@pytest.mark.parametrize("seed", [6, 15])
def test_path_goes_on_over_the_ground_where_a_camera_hovers(seed: int) -> None:
    scene = climbing_and_hovering(points_of(np.random.default_rng(seed), 400, flat=True), 0.05)
    found = camera_of(scene, noise_px=0.3)
    assert found.kind is Kind.MOVES
    assert found.facts.covered > 0.95
    assert shape_error(found.position, scene.position) < 0.05


@pytest.mark.parametrize("seed", range(1))
def test_far_things_do_not_hold_a_hovering_camera_fast(seed: int) -> None:
    rng = np.random.default_rng(seed)
    away, angle = rng.uniform(40.0, 200.0, 100), rng.uniform(0.0, 2 * np.pi, 100)
    far = away[:, None] * np.stack([np.cos(angle), np.sin(angle), rng.uniform(0.0, 0.15, 100)], axis=1)
    scene = climbing_and_hovering(np.concatenate([points_of(rng, 400, flat=True), far]), 0.01)
    assert shape_error(camera_of(scene, noise_px=0.3).position, scene.position) < 0.1


def test_deviations_of_a_path_are_as_its_errors_and_tell_a_weak_place() -> None:
    scene, weak = orbiting(), (18, 26)
    within = (scene.frame >= weak[0]) & (scene.frame < weak[1])
    # Most tracks end there: few points carry the path over it.
    few = ~within | (scene.track // 1000 % 4 == 0)
    thin = scene._replace(frame=scene.frame[few], track=scene.track[few], point=scene.point[few])
    thin = thin._replace(track=thin.track + 1_000_000 * ((thin.track // 1000 % 4 > 0) & (thin.frame >= weak[1])))
    claimed_m = []
    for camera in [camera_of(each, noise_px=0.4) for each in (scene, thin)]:
        assert camera.facts.drift is not None
        way = np.linalg.norm(np.ptp(scene.position, axis=0)) / np.linalg.norm(np.ptp(camera.position, axis=0))
        claimed_m.append(way * np.sqrt(3.0 * np.square(camera.facts.drift[:, 0]).mean()))
        assert 0.2 < shape_error(camera.position, scene.position) / claimed_m[-1] < 1.5
    assert claimed_m[1] > 1.2 * claimed_m[0]


@pytest.mark.parametrize("noise_px", [0.3, 0.62])
def test_camera_that_stands_still_is_named(noise_px: float) -> None:
    rotation, position = orbit(1, FPS)
    points = points_of(np.random.default_rng(6), 300)
    scene = seen(np.repeat(rotation, FRAMES, axis=0), np.repeat(position, FRAMES, axis=0), points, FPS)
    found = camera_of(scene, noise_px=noise_px)
    assert found.kind is Kind.STANDS
    assert not found.position.any()


@pytest.mark.parametrize("lens_known", [True, False])
def test_camera_that_turns_in_its_place_keeps_it_and_its_turns_are_found(lens_known: bool) -> None:
    rotation, position = orbit(1, FPS)
    time = np.arange(FRAMES) / FPS
    turns = exp_so3(np.stack([0.1 * np.sin(0.8 * time), 0.25 * np.sin(0.5 * time), 0.0 * time], axis=1))
    points = points_of(np.random.default_rng(6), 600)
    scene = seen(turns @ rotation, np.repeat(position, FRAMES, axis=0), points, FPS)
    found = camera_of(scene, MATRIX if lens_known else None, 0.3)
    assert found.kind is Kind.TURNS
    assert not found.position.any()
    assert turn_errors_deg(found.rotation, scene.rotation, FPS).max() < (0.1 if lens_known else 1.0)


def test_zoom_is_named() -> None:
    rotation, position = orbit(1, FPS)
    scene = seen(
        np.repeat(rotation, FRAMES, axis=0),
        np.repeat(position, FRAMES, axis=0),
        points_of(np.random.default_rng(6), 300),
        FPS,
    )
    zoom = np.exp(0.04 * scene.frame / FPS)[:, None]
    point = (scene.point - MATRIX[:2, 2]) * zoom + MATRIX[:2, 2]
    assert camera_of(scene._replace(point=point)).kind is Kind.ZOOMS


def test_cut_is_named() -> None:
    scene = orbiting()
    after = scene.frame >= 50
    assert camera_of(scene._replace(track=scene.track + after * 10**9)).kind is Kind.CUT


def test_few_points_are_named() -> None:
    scene = orbiting(points=400)
    few = scene.track % 1000003 < 6000
    kept = scene._replace(frame=scene.frame[few], track=scene.track[few], point=scene.point[few])
    assert camera_of(kept).kind is Kind.FEW_POINTS


def test_points_that_all_move_on_their_own_give_no_camera() -> None:
    scene = orbiting()
    rng = np.random.default_rng(7)
    tracks, number = np.unique(scene.track, return_inverse=True)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(tracks))[number] + 0.3 * scene.frame
    point = scene.point + 40.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sin(0.2 * scene.frame)[:, None]
    assert not camera_of(scene._replace(point=point)).kind.known


def test_crowd_before_the_scene_does_not_bend_the_path() -> None:
    scene = orbiting(points=500)
    rng = np.random.default_rng(8)
    tracks, number = np.unique(scene.track, return_inverse=True)
    walks = (rng.random(len(tracks)) < 0.3)[number]
    step = rng.normal(0.0, 2.0, (len(tracks), 2))[number]
    point = scene.point + 0.3 * rng.standard_normal(scene.point.shape)
    point[walks] += ((scene.frame % 36)[:, None] * step)[walks]
    found = camera_of(scene._replace(point=point))
    assert found.kind is Kind.MOVES
    assert shape_error(found.position, scene.position) < 0.1


def test_same_points_give_the_same_bits() -> None:
    scene = orbiting(points=200)
    first, second = camera_of(scene, noise_px=0.4), camera_of(scene, noise_px=0.4)
    np.testing.assert_array_equal(first.rotation, second.rotation)
    np.testing.assert_array_equal(first.position, second.position)
