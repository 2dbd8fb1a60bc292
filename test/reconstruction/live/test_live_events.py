"""The live core through gaps, late and stray images, loops and changes of subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from walking import make_walk, stamps

from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.live.frame_buffer import AdjustmentWindow
from drocap_ros.reconstruction.live.initializer import SlidingWindowInitializer
from drocap_ros.reconstruction.live.replay import LivePose, LiveWindow, live_poses
from drocap_ros.reconstruction.live.stream_order import Arrival
from drocap_ros.reconstruction.metrics import pa_mpjpe
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig, InitializerConfig

ADJUSTER = BundleAdjusterConfig(period_s=0.5, window_s=2.0)
S = 10**9


def observed(frames: int, begin_ns: int = 0, track_id: int = 1, size: float = 1.0) -> list[PoseObservation]:
    keypoints = make_walk(frames).keypoints.astype(np.float32) * size
    return [
        PoseObservation(
            begin_ns + int(stamp),
            track_id,
            (1280, 1024),
            keypoints=points,
            covariance=np.full((15, 3), np.nan, np.float32),
            confidence=np.ones(15, np.float32),
        )
        for stamp, points in zip(stamps(frames), keypoints, strict=True)
    ]


def run(observations: Sequence[PoseObservation]) -> tuple[list[LivePose], list[LiveWindow]]:
    results = list(live_poses(observations, InitializerConfig(), ADJUSTER))
    return [r for r in results if isinstance(r, LivePose)], [r for r in results if isinstance(r, LiveWindow)]


def same(a: Sequence[LivePose | LiveWindow], b: Sequence[LivePose | LiveWindow]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x.joints3d, y.joints3d) for x, y in zip(a, b, strict=True))


def test_dropped_images_leave_no_trace_in_poses_and_windows() -> None:
    clean = observed(40)
    disturbed = [*clean[:20], clean[19], clean[12], *observed(1, 4_102_444_800 * S), *clean[20:]]
    poses, windows = run(clean)
    assert len(windows) == 3
    again, again_windows = run(disturbed)
    assert same(poses, again)
    assert same(windows, again_windows)


def test_a_second_round_and_another_subject_are_as_the_first_to_the_bit() -> None:
    first = observed(40, 100 * S)
    poses, windows = run(first)
    # One image of the new round is spent on proving that time has jumped.
    for second in (observed(40, 100 * S), observed(40, 102 * S, track_id=2)):
        proof = observed(1, 99 * S) if second[0].track_id == 1 else []
        both, both_windows = run([*first, *proof, *second])
        assert same(both[:40], poses)
        assert same(both[40:], poses)
        assert [p.anew for p in both] == [i in (0, 40) for i in range(80)]
        assert same(both_windows[3:], windows)
        assert all((w.stamp_ns >= second[0].stamp_ns).all() for w in both_windows[3:])


def test_after_a_gap_the_motion_is_new_and_the_size_is_kept() -> None:
    # The person is seen smaller after the gap: the proportions are known, the size in the image is found anew.
    before, after = observed(40), observed(30, 10 * S, size=0.5)
    poses, windows = run([*before, *after])
    assert not poses[40].anew
    limbs = [np.linalg.norm(p.joints3d[3] - p.joints3d[2]) for p in poses]
    assert np.median(limbs[40:]) == pytest.approx(np.median(limbs[10:40]), rel=0.15)
    assert all(w.stamp_ns[0] >= 10 * S or w.stamp_ns[-1] < 10 * S for w in windows)


@pytest.mark.parametrize("start", ["lifter", "dictionary"])
def test_a_gap_forgets_the_hypotheses_but_not_the_size(start: str, dictionary: Dictionary) -> None:
    initializer = SlidingWindowInitializer(InitializerConfig(live_start=start), dictionary)
    for o in observed(30):
        initializer.push(o.stamp_ns, o.keypoints.astype(float))
    far = observed(1, 5 * S)[0]
    pose = initializer.push(far.stamp_ns, far.keypoints.astype(float))
    assert initializer.arrival is Arrival.GAP
    assert pose is not None
    if start == "dictionary":
        assert len(initializer._spread) == 31
        fresh = SlidingWindowInitializer(InitializerConfig(live_start=start), dictionary)
        first = fresh.push(far.stamp_ns, far.keypoints.astype(float))
        assert first is not None
        # As good as alone, but at the size that was known.
        np.testing.assert_allclose(pose.joints3d, first.joints3d, atol=0.15)
    else:
        assert initializer._lifted is not None
        assert len(initializer._lifted._past) == 1
        assert len(initializer._lifted._proportions) == 1


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
        place = np.searchsorted(stamps(72), windows[-1].stamp_ns)
        errors.append((initial.mean(), pa_mpjpe(windows[-1].joints3d.astype(float), truth[place]).mean()))
    assert errors[1][0] < errors[0][0] + 2.0
    assert errors[1][1] < errors[0][1] + 2.0


def test_the_window_drops_duplicates_and_late_frames() -> None:
    window = AdjustmentWindow(ADJUSTER)
    frames = observed(10)
    joints = np.zeros((15, 3))
    for o in frames:
        window.push(o, joints)
    for o in (frames[9], frames[3]):
        assert not window.push(o, joints)
    assert window.arrival is Arrival.LATE
    np.testing.assert_array_equal(window.snapshot().stamp_ns, stamps(10))


@pytest.mark.parametrize("again", ["somebody else", "a gap"])
def test_the_first_adjustment_is_due_after_a_third_of_a_period_and_then_one_every_period(again: str) -> None:
    window = AdjustmentWindow(ADJUSTER)
    start_s = 0.0
    for _ in range(2):
        due_s = [
            (o.stamp_ns - stamps(60)[0]) * 1e-9
            for o in observed(60)
            if window.push(
                replace(
                    o,
                    stamp_ns=o.stamp_ns + round(start_s * 1e9),
                    track_id=int(start_s) if again == "somebody else" else o.track_id,
                ),
                np.zeros((15, 3)),
            )
        ]
        # To the frame: 25 of them a second.
        np.testing.assert_allclose(due_s, [1 / 6, 2 / 3, 7 / 6, 5 / 3, 13 / 6], atol=0.041)
        start_s += 60.0 if again == "a gap" else 3.0


def test_every_nth_frame_is_counted_from_the_newest() -> None:
    window = AdjustmentWindow(ADJUSTER)
    for o in observed(10):
        window.push(o, np.zeros((15, 3)))
    part = window.snapshot().every(3)
    np.testing.assert_array_equal(part.stamp_ns, stamps(10)[[0, 3, 6, 9]])
    assert part.keypoints.shape == (4, 15, 2)


def test_an_endless_stream_keeps_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drocap_ros.reconstruction.live.lifted_initializer.MOST_IMAGES", 40)
    initializer = SlidingWindowInitializer(InitializerConfig(past_s=10.0))
    window = AdjustmentWindow(BundleAdjusterConfig(window_frames=50))
    # 1000 images per second: their age bounds nothing, the counts must.
    for i, o in enumerate(observed(60) * 2):
        moved = replace(o, stamp_ns=i * 10**6)
        initializer.push(moved.stamp_ns, moved.keypoints.astype(float))
        window.push(moved, np.zeros((15, 3)))
    assert len(window.snapshot().stamp_ns) == 50
    assert initializer._lifted is not None
    assert len(initializer._lifted._past) == 40
    assert len(initializer._lifted._limbs_px) == 30
