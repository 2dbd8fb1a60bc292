"""Clips with cuts: where they are, the shots between them, and the motion that goes on over them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, Scene, looking, orbit, points_of, seen
from walking import make_walk

from drocap_ros.background import Background
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.ellipsoids import pack_covariance, unpack_covariance
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.camera.cuts import cuts
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.shots import joined, shots_of
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.skeleton import BODY_15, BODY_17
from drocap_ros.tracks import Tracks

FPS = 24.0
FRAMES = 144
HALF = FRAMES // 2
TIME_S = np.arange(FRAMES) / FPS
LEFT, RIGHT = BODY_15.index("lhip"), BODY_15.index("rhip")


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


def world_motion(frames: int, begin_ns: int, seed: int) -> Motion:
    """A person who walks in a world of its own, with covariances."""
    rng = np.random.default_rng(seed)
    simulated = make_walk(frames)
    spread = rng.normal(0.0, 0.02, (frames, 15, 3, 3))
    matrix = spread @ np.swapaxes(spread, -1, -2)
    return Motion(
        joints3d=simulated.in_camera @ simulated.camera + [*rng.uniform(-5.0, 5.0, 2), 0.9],
        joints=BODY_15.joints,
        parents=BODY_15.parents,
        stamp_ns=begin_ns + np.round(np.arange(frames) * 1e9 / FPS).astype(np.int64),
        frame="world",
        metric=False,
        scale_source="assumed_height",
        camera_rotation=simulated.camera,
        confidence=np.ones((frames, 15)),
        keypoints=np.zeros((frames, 15, 2)),
        reprojection_px=np.zeros((frames, 15)),
        meta={"seconds": {"total": 1.0}, "frames": frames, "calibration": [{"place_covariance_m2": [1e-4] * 6}]},
        camera_position=rng.uniform(-5.0, 5.0, (frames, 3)),
        covariance=pack_covariance(matrix),
    )


def turned(motion: Motion, angle: float) -> Motion:
    """The same motion in a world with other axes, z up."""
    turn = exp_so3(np.array([0.0, 0.0, angle]))
    return replace(
        motion,
        joints3d=motion.joints3d @ turn.T,
        camera_rotation=motion.camera_rotation @ turn.T,
        camera_position=motion.camera_position @ turn.T,
        covariance=pack_covariance(turn @ unpack_covariance(motion.covariance) @ turn.T),
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


def test_shots_have_the_images_of_the_clip_and_their_own_points() -> None:
    tracks = clip(*two_cameras())
    shots = shots_of(tracks)
    assert shots.cuts == [HALF]
    np.testing.assert_array_equal(np.concatenate([shot.stamp_ns for shot in shots.tracks]), tracks.stamp_ns)
    assert [len(shot) for shot in shots.tracks] == [HALF, HALF]
    assert sum(len(shot.background) for shot in shots.tracks) == len(tracks.background)


def test_short_shots_belong_to_that_before_without_their_points() -> None:
    tracks = clip(*two_cameras())
    points = tracks.background
    brief = (points.frame >= HALF - 12) & (points.frame < HALF)
    tracks = replace(tracks, background=replace(points, track=points.track + 2 * 10**9 * brief))
    shots = shots_of(tracks)
    assert shots.cuts == [HALF - 12, HALF]
    assert [len(shot) for shot in shots.tracks] == [HALF, HALF]
    assert shots.tracks[0].background.frame.max() == HALF - 13
    assert shots.tracks[1].background.frame.min() == 0


def test_shots_without_the_person_or_with_telemetry_are_none() -> None:
    tracks = clip(*two_cameras())
    away = np.where(np.arange(FRAMES)[:, None, None] < HALF, np.nan, tracks.keypoints)
    assert [len(shot) for shot in shots_of(replace(tracks, keypoints=away)).tracks] == [FRAMES]
    rotation, _ = two_cameras()
    assert shots_of(replace(tracks, camera_rotation=rotation)).cuts == []
    assert shots_of(replace(tracks, background=None)).cuts == []


@pytest.mark.parametrize("angle", [0.0, 2.0, -3.0])
def test_person_goes_on_from_the_place_and_heading_before_the_cut(angle: float) -> None:
    whole = world_motion(80, 10**12, 1)
    first, second = (
        replace(whole, **{name: getattr(whole, name)[part] for name in
                          ("joints3d", "stamp_ns", "camera_rotation", "confidence", "keypoints", "reprojection_px",
                           "camera_position", "covariance")})
        for part in (slice(0, 40), slice(40, 80))
    )  # fmt: skip
    motion = joined([first, turned(second, angle)])
    np.testing.assert_array_equal(motion.stamp_ns, whole.stamp_ns)
    np.testing.assert_array_equal(motion.joints3d[:40], first.joints3d)
    np.testing.assert_allclose(motion.joints3d[40, 0, :2], motion.joints3d[39, 0, :2], atol=1e-12)
    # A place more exact than a step: the body's own motion from image to image, and its turn within 0.4 s.
    assert np.linalg.norm(motion.joints3d - whole.joints3d, axis=-1).max() < 0.1
    assert np.isfinite(motion.covariance).all()
    assert motion.meta["frames"] == 80
    assert [window["place_covariance_m2"] for window in motion.meta["calibration"]] == [None, None]


def test_camera_and_covariance_turn_with_the_body() -> None:
    first, second = world_motion(40, 10**12, 1), world_motion(50, 10**12 + 2 * 10**9, 2)
    motion = joined([first, turned(second, 1.0)])
    after = slice(40, 90)
    in_camera = (motion.joints3d - motion.camera_position[:, None]) @ np.swapaxes(motion.camera_rotation, 1, 2)
    expected = (second.joints3d - second.camera_position[:, None]) @ np.swapaxes(second.camera_rotation, 1, 2)
    np.testing.assert_allclose(in_camera[after], expected, atol=1e-9)
    np.testing.assert_allclose(motion.joints3d[after, :, 2], second.joints3d[..., 2], atol=1e-9)
    of_camera = [
        rotation[:, None] @ unpack_covariance(covariance) @ np.swapaxes(rotation, 1, 2)[:, None]
        for rotation, covariance in (
            (motion.camera_rotation[after], motion.covariance[after]),
            (second.camera_rotation, second.covariance),
        )
    ]
    np.testing.assert_allclose(*of_camera, atol=1e-12)


def test_joints_and_reference_that_one_shot_lacks_all_lack() -> None:
    first, second = world_motion(40, 10**12, 1), world_motion(50, 10**12 + 2 * 10**9, 2)
    by_joint = ("joints3d", "confidence", "keypoints", "reprojection_px", "covariance")
    longer = {name: np.repeat(getattr(first, name), 2, axis=1)[:, :17] for name in by_joint}
    longer["joints3d"][:, :15] = first.joints3d
    first = replace(first, joints=BODY_17.joints, parents=BODY_17.parents, **longer)
    first.meta["covariance_about"], second.meta["covariance_about"] = "pelvis", "origin"
    motion = joined([first, second])
    assert motion.joints == BODY_15.joints
    assert motion.parents == BODY_15.parents
    assert {getattr(motion, name).shape[1] for name in by_joint} == {15}
    assert motion.meta["covariance_about"] == "pelvis"
    assert motion.meta["seconds"] == {"total": 2.0}
    assert joined([first, replace(second, covariance=None)]).covariance is None


def test_clip_of_two_cameras_is_in_one_world_and_the_body_no_worse_than_without_points() -> None:
    tracks = clip(*two_cameras())
    told: list[float] = []
    motion = reconstruct(tracks, progress=lambda _stage, done: told.append(done))
    assert motion.frame == "world"
    np.testing.assert_array_equal(motion.stamp_ns, tracks.stamp_ns)
    without = reconstruct(replace(tracks, background=None))
    assert pa_mpjpe(motion.joints3d, walk()).mean() < 1.1 * pa_mpjpe(without.joints3d, walk()).mean()
    # Within each shot the person is where it was; over the cut it goes on, with its heading.
    assert np.linalg.norm(np.ptp(motion.joints3d[:, 0], axis=0)) < 1.0
    across = motion.joints3d[:, LEFT, :2] - motion.joints3d[:, RIGHT, :2]
    heading = np.unwrap(np.arctan2(across[:, 1], across[:, 0]))
    assert np.abs(np.diff(heading)).max() < np.deg2rad(20.0)
    assert np.isfinite(motion.covariance).all()
    assert min(told) == 0.5
    assert max(told) == 1.0
    words = telemetry_words(motion.meta)
    assert words.startswith(
        "Cut at 3.0 s; nothing relates the shots: each goes on where the person stood. 0.0 to 3.0 s:"
    )
    assert words.count("Camera from the picture: a camera that moves") == 2
    assert words.count("px off, enough of them in 100 % of the images") == 2


def test_shot_whose_camera_is_unknown_leaves_all_in_camera_axes_and_is_named() -> None:
    tracks = clip(*two_cameras())
    points = tracks.background
    kept = (points.frame < HALF) | (points.frame == HALF) | (points.track % 16000 < 1000)
    few = replace(tracks, background=Background(points.frame[kept], points.track[kept], points.point[kept]))
    motion = reconstruct(few)
    assert motion.frame == "camera"
    np.testing.assert_array_equal(motion.joints3d, reconstruct(replace(tracks, background=None)).joints3d)
    words = telemetry_words(motion.meta)
    assert "Cut at 3.0 s; a shot without a camera leaves all in the camera's frame" in words
    assert "too few fixed points" in words
