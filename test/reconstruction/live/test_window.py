"""The windowed core of the live nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walking import Walk, make_walk, stamps

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.live.initializer import (
    InitialPose,
    SlidingWindowInitializer,
    adjust_window,
    fill_frames,
)
from drocap_ros.reconstruction.live.stream_order import Arrival
from drocap_ros.reconstruction.metrics import is_mirrored, limb_lengths, pa_mpjpe
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig, InitializerConfig

ONES = np.ones(15)
ROUND = np.tile(np.array([9.0, 0.0, 9.0]), (15, 1))


DICTIONARY = InitializerConfig(live_start="dictionary")
STARTS = {"lifter": InitializerConfig(), "dictionary": DICTIONARY}


def push(initializer: SlidingWindowInitializer, stamp_ns: int, *arrays: np.ndarray | None) -> InitialPose:
    pose = initializer.push(stamp_ns, *arrays)
    assert pose is not None, initializer.arrival
    return pose


def push_all(initializer: SlidingWindowInitializer, walk: Walk) -> list[InitialPose]:
    return [
        push(initializer, int(t), k, ONES, ROUND) for t, k in zip(stamps(len(walk.shape)), walk.keypoints, strict=True)
    ]


@pytest.fixture(scope="module", params=STARTS)
def either(request: pytest.FixtureRequest, dictionary: Dictionary) -> tuple[Walk, list[InitialPose], InitializerConfig]:
    """A walk as the live start sees it, by the lifter and by the dictionary."""
    walk, config = make_walk(72), STARTS[request.param]
    return walk, push_all(SlidingWindowInitializer(config, dictionary), walk), config


@pytest.fixture(scope="module")
def live(dictionary: Dictionary) -> tuple[Walk, list[InitialPose]]:
    walk = make_walk(72)
    return walk, push_all(SlidingWindowInitializer(DICTIONARY, dictionary), walk)


def joints(poses: list[InitialPose]) -> np.ndarray:
    return np.stack([p.joints3d for p in poses])


def test_every_image_gets_a_pose(either: tuple[Walk, list[InitialPose], InitializerConfig]) -> None:
    walk, poses, _ = either
    truth = 1000.0 * walk.in_camera
    assert pa_mpjpe(joints(poses), truth).mean() < 80.0
    assert not is_mirrored(joints(poses), truth)
    assert limb_lengths(joints(poses)).sum(1).mean() == pytest.approx(1.70 * 1.78, rel=0.06)
    for pose in poses:
        np.testing.assert_allclose(pose.joints3d[0], 0.0, atol=1e-12)
        assert pose.reprojection_rms_px < 40.0
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_covariance_is_larger_along_the_ray(either: tuple[Walk, list[InitialPose], InitializerConfig]) -> None:
    covariance = np.mean([p.covariance[1:] for p in either[1]], axis=0)
    assert np.all(covariance[:, [0, 3, 5]] > 0.0)
    assert covariance[:, 5].mean() > 3.0 * covariance[:, 0].mean()


def test_it_is_deterministic_and_causal(
    either: tuple[Walk, list[InitialPose], InitializerConfig], dictionary: Dictionary
) -> None:
    walk, poses, config = either
    again = push_all(SlidingWindowInitializer(config, dictionary), Walk(*(a[:20] for a in vars(walk).values())))
    np.testing.assert_array_equal(joints(again), joints(poses[:20]))


def test_a_jump_back_in_time_starts_anew(
    either: tuple[Walk, list[InitialPose], InitializerConfig], dictionary: Dictionary
) -> None:
    walk, poses, config = either
    initializer = SlidingWindowInitializer(config, dictionary)
    push_all(initializer, walk)
    # One image of the next round, far back in time, may be a stray; the one after it proves the jump.
    assert initializer.push(-10, walk.keypoints[0], ONES, ROUND) is None
    assert initializer.arrival is Arrival.STRAY
    head = Walk(*(a[:10] for a in vars(walk).values()))
    again = push_all(initializer, head)
    assert initializer.arrival is Arrival.CONTINUED
    np.testing.assert_array_equal(joints(again), joints(poses[:10]))


def test_memory_does_not_grow(dictionary: Dictionary) -> None:
    initializer = SlidingWindowInitializer(replace(DICTIONARY, start_iterations=2, sparse_rounds=1), dictionary)
    walk = make_walk(30)
    for k in range(200):
        initializer.push(k + 1, walk.keypoints[k % 30], ONES)
    assert len(initializer._spread) <= 120
    assert len(initializer._metre_px) <= 120
    assert initializer._alive is not None
    assert len(initializer._alive.cost) <= 2 * InitializerConfig().azimuth_starts


def test_an_image_without_the_person_is_unknown_not_zero(dictionary: Dictionary) -> None:
    initializer = SlidingWindowInitializer(InitializerConfig(), dictionary)
    for stamp_ns, keypoints in enumerate((np.full((15, 2), np.nan), np.full((15, 2), 40.0))):
        pose = push(initializer, stamp_ns, keypoints, ONES)
        assert np.isnan(pose.joints3d).all()
        assert np.isnan(pose.rotation).all()
        assert np.all(pose.confidence == 0.0)


@pytest.mark.parametrize("config", STARTS.values(), ids=STARTS)
def test_missing_joints_are_filled_in_and_marked(config: InitializerConfig, dictionary: Dictionary) -> None:
    walk = make_walk(1)
    keypoints = walk.keypoints[0].copy()
    keypoints[[2, 11]] = np.nan
    covariance = np.where(np.isnan(keypoints[:, :1]), np.nan, ROUND)
    pose = push(SlidingWindowInitializer(config, dictionary), 5, keypoints, None, covariance)
    assert np.isfinite(pose.joints3d).all()
    np.testing.assert_array_equal(pose.confidence == 0.0, np.isnan(keypoints[:, 0]))


@pytest.mark.parametrize("config", STARTS.values(), ids=STARTS)
def test_wrong_arrays_are_refused(config: InitializerConfig, dictionary: Dictionary) -> None:
    initializer = SlidingWindowInitializer(config, dictionary)
    with pytest.raises(InputError, match=r"keypoints: expected \(15, 2\)"):
        initializer.push(1, np.zeros((14, 2)), ONES)
    with pytest.raises(InputError, match="confidence: expected shape"):
        initializer.push(1, np.zeros((15, 2)), np.ones(3))
    with pytest.raises(InputError, match="covariance: expected shape"):
        initializer.push(1, np.zeros((15, 2)), ONES, np.ones((15, 2)))
    with pytest.raises(InputError, match="positive definite"):
        initializer.push(1, make_walk(1).keypoints[0], ONES, np.full((15, 3), np.inf))


def test_adjusting_a_window_improves_it(live: tuple[Walk, list[InitialPose]]) -> None:
    walk, poses = live
    truth = 1000.0 * walk.in_camera
    start = joints(poses)
    start[30:33] = np.nan
    window = adjust_window(stamps(72), walk.keypoints, np.ones((72, 15)), None, start, BundleAdjusterConfig())
    assert pa_mpjpe(window.joints3d, truth).mean() < 0.8 * pa_mpjpe(joints(poses), truth).mean()
    assert limb_lengths(window.joints3d).mean() == pytest.approx(limb_lengths(joints(poses)).mean(), rel=0.02)
    assert window.joints3d.shape == (72, 15, 3)
    assert window.covariance.shape == (72, 15, 6)
    assert window.reprojection_rms_px.max() < 30.0
    assert window.cost == pytest.approx(sum(window.cost_terms.values()))
    assert window.stop_reason in ("converged", "iterations")
    np.testing.assert_array_equal(window.stamp_ns, stamps(72))


@pytest.mark.parametrize("frames", [1, 3])
def test_a_short_window_keeps_its_start(walk: Walk, frames: int) -> None:
    start = walk.in_camera[:frames] - walk.in_camera[:frames, :1]
    window = adjust_window(stamps(frames), walk.keypoints[:frames], None, None, start)
    np.testing.assert_allclose(window.joints3d, start, atol=1e-9)
    assert window.stop_reason == "too short"


def test_windows_without_a_start_are_refused(walk: Walk) -> None:
    with pytest.raises(InputError, match="a pose in at least one frame"):
        adjust_window(stamps(9), walk.keypoints[:9], None, None, np.full((9, 15, 3), np.nan))
    with pytest.raises(InputError, match="one pose and stamp per image"):
        adjust_window(stamps(9), walk.keypoints[:9], None, None, np.zeros((8, 15, 3)))


def test_gaps_turn_with_the_body() -> None:
    """Interpolated poses keep their size while the body turns."""
    walk = make_walk(60, speed_deg_s=60.0)
    broken = walk.in_camera.copy()
    broken[20:40] = np.nan
    filled = fill_frames(stamps(60), broken)
    np.testing.assert_array_equal(filled[:20], walk.in_camera[:20])
    torso = limb_lengths(filled)[:, 4]  # the line of the hips
    np.testing.assert_allclose(torso, 0.18, atol=0.005)
    assert pa_mpjpe(filled, 1000.0 * walk.in_camera)[20:40].mean() < 140.0


def test_gross_outliers_hardly_move_the_window(live: tuple[Walk, list[InitialPose]]) -> None:
    walk, poses = live
    rng = np.random.default_rng(0)
    keypoints = walk.keypoints.copy()
    gross = rng.random(keypoints.shape[:2]) < 0.04
    keypoints[gross] += rng.choice([-1.0, 1.0], (int(gross.sum()), 2)) * 150.0
    truth = 1000.0 * walk.in_camera
    clean = adjust_window(stamps(72), walk.keypoints, None, None, joints(poses))
    hit = adjust_window(stamps(72), keypoints, None, None, joints(poses))
    assert pa_mpjpe(hit.joints3d, truth).mean() < pa_mpjpe(clean.joints3d, truth).mean() + 10.0
