"""The live method through gaps, late and stray images, loops and changes of subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from live_stream import observed
from walking import make_walk, stamps

from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.live.replay import LivePose, LiveWindow, live_poses

ADJUSTER = BundleAdjusterConfig(period_s=0.5, window_s=2.0)
S = 10**9


def run(observations: Sequence[PoseObservation]) -> tuple[list[LivePose], list[LiveWindow]]:
    results = list(live_poses(observations, InitializerConfig(), ADJUSTER))
    return [r for r in results if isinstance(r, LivePose)], [r for r in results if isinstance(r, LiveWindow)]


def same(a: Sequence[LivePose | LiveWindow], b: Sequence[LivePose | LiveWindow]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x.joints3d, y.joints3d) for x, y in zip(a, b, strict=True))


def test_dropped_images_change_no_pose_and_no_window() -> None:
    clean = observed(40)
    disturbed = [*clean[:20], clean[19], clean[12], *observed(1, 4_102_444_800 * S), *clean[20:]]
    poses, windows = run(clean)
    assert len(windows) == 3
    again, again_windows = run(disturbed)
    assert same(poses, again)
    assert same(windows, again_windows)


def test_a_second_round_and_another_subject_repeat_the_first_bit_for_bit() -> None:
    first = observed(40, 100 * S)
    poses, windows = run(first)
    # One image of the new round confirms the time jump and is dropped.
    for second in (observed(40, 100 * S), observed(40, 102 * S, track_id=2)):
        proof = observed(1, 99 * S) if second[0].track_id == 1 else []
        both, both_windows = run([*first, *proof, *second])
        assert same(both[:40], poses)
        assert same(both[40:], poses)
        assert [p.restarted for p in both] == [i in (0, 40) for i in range(80)]
        assert same(both_windows[3:], windows)
        assert all((w.window.stamp_ns >= second[0].stamp_ns).all() for w in both_windows[3:])


def test_images_of_another_size_share_no_pose_and_no_window_with_those_before() -> None:
    small = [replace(o, image_size=(640, 512)) for o in observed(40, 2 * S, size=0.5)]
    poses, windows = run([*observed(40), *small])
    alone, alone_windows = run(small)
    assert [p.restarted for p in poses] == [i in (0, 40) for i in range(80)]
    assert same(poses[40:], alone)
    assert same(windows[3:], alone_windows)


def test_adjuster_takes_poses_of_another_day_when_its_node_does() -> None:
    day = 86_400 * S
    poses, windows = run([*observed(40), *observed(40, day)])
    assert len(poses) == 79  # one image confirms the jump
    # The node refuses four poses, until five agree.
    assert min(w.window.stamp_ns[0] for w in windows if w.window.stamp_ns[-1] > day) == poses[44].observation.stamp_ns


def test_a_gap_keeps_the_size_and_restarts_the_window() -> None:
    # The person is smaller in the image after the gap: the proportions stay, the size in the image is estimated again.
    before, after = observed(40), observed(30, 10 * S, size=0.5)
    poses, windows = run([*before, *after])
    assert not poses[40].restarted
    limbs = [np.linalg.norm(p.joints3d[3] - p.joints3d[2]) for p in poses]
    assert np.median(limbs[40:]) == pytest.approx(np.median(limbs[10:40]), rel=0.15)
    assert all(w.window.stamp_ns[0] >= 10 * S or w.window.stamp_ns[-1] < 10 * S for w in windows)


SWAP = np.array([0, 1, 5, 6, 4, 2, 3, *range(7, 15)])


def test_exchanged_legs_are_exchanged_back() -> None:
    clean = observed(72)
    wrong = {*range(20, 24), *range(45, 52)}
    swapped = [replace(o, keypoints=o.keypoints[SWAP]) if i in wrong else o for i, o in enumerate(clean)]
    truth = 1000.0 * make_walk(72).in_camera
    errors = []
    for stream in (clean, swapped):
        poses, windows = run(stream)
        initial = pa_mpjpe(np.array([p.joints3d for p in poses], float), truth)
        place = np.searchsorted(stamps(72), windows[-1].window.stamp_ns)
        errors.append((initial.mean(), pa_mpjpe(windows[-1].joints3d.astype(float), truth[place]).mean()))
    assert errors[1][0] < errors[0][0] + 2.0
    assert errors[1][1] < errors[0][1] + 2.0
