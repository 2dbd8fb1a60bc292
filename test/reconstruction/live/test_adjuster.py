"""The live adjuster: warm-started, cut short, coarser, failing; and the latest pose that follows from it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from walking import make_walk, stamps

from drocap_ros.camera_path import CameraPath
from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.rotations import exp_so3, unpack_covariance
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.latest_pose import LatestPose, median_bone_lengths
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, EffortControl, Window

FRAMES = 120
WALK = make_walk(FRAMES)
TRUTH = 1000.0 * WALK.in_camera
NOISE = np.random.default_rng(0).normal(0.0, 3.0, WALK.keypoints.shape)


def window(begin: int = 0, end: int = FRAMES, subject: int = 1) -> Window:
    part = slice(begin, end)
    count = end - begin
    initial = WALK.in_camera[part] - WALK.in_camera[part, :1]
    return Window(
        stamps(FRAMES)[part],
        Keypoints2D((WALK.keypoints + NOISE)[part], np.ones((count, 15))).with_joints(17),
        initial,
        subject,
    )


def seen_by(turn: np.ndarray, camera: bool = True) -> AdjustedWindow:
    """The walk, 4 m away, by a camera of 700 px turned by so much, without a pose."""
    there = (WALK.in_camera - WALK.in_camera[:, :1].mean(axis=0) + [0.0, 0.0, 4.0]) @ turn.T
    matrix = np.array([[700.0, 0.0, 640.0], [0.0, 700.0, 360.0], [0.0, 0.0, 1.0]])
    image = there[..., :2] / there[..., 2:] * 700.0 + matrix[:2, 2]
    w = window()._replace(keypoints=Keypoints2D(image, np.ones(image.shape[:2])).with_joints(17))
    unknown = np.full((FRAMES, 3, 3), np.nan)
    return LiveAdjuster(BundleAdjusterConfig()).adjust(
        w._replace(camera=CameraPath(w.stamp_ns, unknown, unknown[:, 0], matrix) if camera else None)
    )


def test_with_a_known_lens_alone_a_pose_does_not_depend_on_its_place_in_the_picture() -> None:
    middle = seen_by(np.eye(3))
    turn = exp_so3(np.deg2rad([0.0, 32.0, 0.0]))
    aside = seen_by(turn)
    assert np.abs(aside.joints3d - middle.joints3d @ turn.T).max() < 0.02
    np.testing.assert_allclose(
        unpack_covariance(aside.covariance), turn @ unpack_covariance(middle.covariance) @ turn.T, atol=2e-4
    )
    # A lens that is assumed does not know the place.
    assert np.abs(seen_by(turn, camera=False).joints3d - middle.joints3d @ turn.T).max() > 0.1


def adjust_twice(adjuster: LiveAdjuster, **second: int) -> tuple[AdjustedWindow, AdjustedWindow]:
    return adjuster.adjust(window(0, 96)), adjuster.adjust(window(24, 120, **second))


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_window_of_few_images_is_adjusted_too(frames: int) -> None:
    result = LiveAdjuster(BundleAdjusterConfig()).adjust(window(0, frames))
    assert result.joints3d.shape == (frames, 17, 3)
    assert pa_mpjpe(result.joints3d, TRUTH[:frames]).mean() < 100.0


def test_an_adjusted_window_is_near_the_truth() -> None:
    result = LiveAdjuster(BundleAdjusterConfig()).adjust(window())
    assert pa_mpjpe(result.joints3d, TRUTH).mean() < 25.0
    assert result.stop_reason in ("converged", "iterations", "no descent")
    assert result.cost == pytest.approx(sum(result.cost_terms.values()))
    # The scale is that of the initial poses, and each bone keeps its length.
    assert limb_lengths(result.joints3d).mean() == pytest.approx(limb_lengths(WALK.in_camera).mean(), rel=0.02)
    spread = limb_lengths(result.joints3d).std(axis=0) / limb_lengths(result.joints3d).mean(axis=0)
    assert spread.max() < 0.06
    about_pelvis = result.covariance[:, 1:]  # of which the pelvis has none
    assert (about_pelvis[..., 5] > about_pelvis[..., 0]).mean() > 0.9
    assert 1.0 < np.median(result.reprojection_rms_px) < 12.0


def test_the_second_window_starts_from_the_sizes_of_the_first() -> None:
    first, warm = adjust_twice(LiveAdjuster(BundleAdjusterConfig()))
    cold = LiveAdjuster(BundleAdjusterConfig()).adjust(window(24, 120))
    # The warm one has no first adjustment, and is as good.
    assert warm.iterations < cold.iterations
    assert not np.array_equal(warm.joints3d, cold.joints3d)
    assert pa_mpjpe(warm.joints3d, TRUTH[24:]).mean() < 1.1 * pa_mpjpe(cold.joints3d, TRUTH[24:]).mean()
    assert first.iterations > warm.iterations


def test_a_missing_lifter_is_refused_by_the_constructor() -> None:
    with pytest.raises(InputError, match="no such file"):
        LiveAdjuster(BundleAdjusterConfig(lifter="none.onnx"))


def test_another_subject_has_a_cold_start() -> None:
    _, other = adjust_twice(LiveAdjuster(BundleAdjusterConfig()), subject=2)
    cold = LiveAdjuster(BundleAdjusterConfig()).adjust(window(24, 120))
    np.testing.assert_array_equal(other.joints3d, cold.joints3d)


def test_a_failure_keeps_the_known_sizes() -> None:
    adjuster = LiveAdjuster(BundleAdjusterConfig())
    adjuster.adjust(window(0, 96))
    blind = window(24, 120)
    with pytest.raises(InputError, match="seen joints"):
        adjuster.adjust(blind._replace(keypoints=replace(blind.keypoints, confidence=np.zeros((96, 17)))))
    with pytest.raises(InputError, match="a pose in at least one frame"):
        adjuster.adjust(blind._replace(initial_joints=np.full((96, 15, 3), np.nan)))
    _, expected = adjust_twice(LiveAdjuster(BundleAdjusterConfig()))
    np.testing.assert_array_equal(adjuster.adjust(blind).joints3d, expected.joints3d)


@pytest.mark.parametrize("after", [0, 1, 2])
def test_the_effort_of_an_adjustment_cut_by_its_deadline_repeats_it(after: int) -> None:
    asked = itertools.count()
    cut = LiveAdjuster(BundleAdjusterConfig()).adjust(window(), cancelled=lambda: next(asked) >= after)
    whole = LiveAdjuster(BundleAdjusterConfig()).adjust(window())
    assert cut.stop_reason == "deadline"
    assert 2 <= cut.iterations < whole.iterations
    assert whole.effort == Effort()
    effort = cut.effort
    assert effort.steps is not None
    assert sum(effort.steps) == cut.iterations
    again = LiveAdjuster(BundleAdjusterConfig()).adjust(window(), effort)
    np.testing.assert_array_equal(again.joints3d, cut.joints3d)
    assert not np.array_equal(whole.joints3d, cut.joints3d)


def test_a_repeated_adjustment_hands_the_same_sizes_to_the_next_window() -> None:
    live, repeated = (LiveAdjuster(BundleAdjusterConfig()) for _ in range(2))
    cut = live.adjust(window(0, 96), cancelled=lambda: True)
    repeated.adjust(window(0, 96), cut.effort)
    both = [adjuster.adjust(window(24, 120)).joints3d for adjuster in (live, repeated)]
    np.testing.assert_array_equal(*both)


def test_stride_two_adjusts_every_second_image() -> None:
    adjuster = LiveAdjuster(BundleAdjusterConfig())
    result = adjuster.adjust(window(), Effort(stride=2))
    assert result.effort == Effort(stride=2)
    np.testing.assert_array_equal(result.stamp_ns, stamps(FRAMES)[1::2])
    assert pa_mpjpe(result.joints3d, TRUTH[1::2]).mean() < 40.0


def test_the_stride_grows_when_late_and_shrinks_when_early() -> None:
    control = EffortControl(0.5, max_stride=3)
    strides = []
    for seconds in (0.2, 0.6, 0.6, 0.6, 0.3, 0.1, 0.1, 0.1):
        control.record(seconds)
        strides.append(control.stride)
    assert strides == [1, 2, 3, 3, 3, 2, 1, 1]


def poses_of(latest: LatestPose, solutions: dict[int, np.ndarray], initial: np.ndarray = WALK.in_camera) -> np.ndarray:
    out = []
    for i, stamp in enumerate(stamps(FRAMES).tolist()):
        if i in solutions:
            latest.set_solution(solutions[i], stamp)
        out.append(latest.pose(stamp, initial[i] - initial[i, 0]))
    return np.array(out)


def test_blending_bounds_the_step_of_every_joint() -> None:
    blend_s, lengths = 0.5, median_bone_lengths(WALK.in_camera)
    first, second = 1.1 * lengths, 0.9 * lengths
    without = poses_of(LatestPose(blend_s), {10: first})
    # The third arrives while the second is being blended in.
    with_it = poses_of(LatestPose(blend_s), {10: first, 60: second, 66: first})
    np.testing.assert_array_equal(with_it[:61], without[:61])
    moved = np.linalg.norm(with_it - without, axis=-1)
    assert moved.max() > 0.05
    step = np.abs(np.diff(moved, axis=0)).max()
    chain = np.abs(first - second).max() * 5
    assert 0.0 < step <= chain / (24.0 * blend_s)
    # Without blending the step is far larger.
    jump = poses_of(LatestPose(0.0), {10: first, 60: second})
    assert np.linalg.norm(jump - without, axis=-1)[60].max() > 5.0 * step


def test_the_latest_pose_has_the_bone_lengths_of_the_solution_after_blending() -> None:
    lengths = 1.2 * median_bone_lengths(WALK.in_camera)
    latest = LatestPose(0.5)
    assert not latest.corrected
    poses = poses_of(latest, {48: lengths})
    assert latest.corrected
    raw = WALK.in_camera - WALK.in_camera[:, :1]
    np.testing.assert_array_equal(poses[:48], raw[:48])
    np.testing.assert_allclose(poses[48], raw[48], atol=1e-12)
    np.testing.assert_allclose(median_bone_lengths(poses[60:]), lengths, rtol=1e-9)
    assert np.isnan(latest.pose(10**12, np.full((15, 3), np.nan))).all()
    latest.reset()
    np.testing.assert_array_equal(latest.pose(10**12, raw[0]), raw[0])
