"""The live method through gaps, late and stray images, loops and changes of subject."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from live_stream import observed
from walking import make_walk, stamps

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.initializer import LiveInitializer, LivePose
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, TelemetryUse

ADJUSTER = BundleAdjusterConfig(period_s=0.5, window_s=2.0)
S = 10**9


def run(
    observations: Iterable[PoseObservation], effort_at: Callable[[int], Effort | None] = lambda _: Effort()
) -> tuple[list[Step], list[AdjustedWindow]]:
    live = LiveInitializer(), LiveCore(ADJUSTER), LiveAdjuster(ADJUSTER)
    results = list(live_results(observations, *live, effort_at))
    return [r for r in results if isinstance(r, Step)], [r[1] for r in results if not isinstance(r, Step)]


def restarted(step: Step) -> bool:
    return step.event is not None and step.event.restarted


def joints_of(results: Sequence[Step | AdjustedWindow]) -> list[np.ndarray]:
    return [r.initial.joints3d if isinstance(r, Step) else r.joints3d for r in results]


def same(a: Sequence[Step | AdjustedWindow], b: Sequence[Step | AdjustedWindow]) -> bool:
    return len(a) == len(b) and all(map(np.array_equal, joints_of(a), joints_of(b)))


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
        assert [restarted(p) for p in both] == [i in (0, 40) for i in range(80)]
        assert same(both_windows[3:], windows)
        assert all((w.stamp_ns >= second[0].stamp_ns).all() for w in both_windows[3:])


def test_images_of_another_size_share_no_pose_and_no_window_with_those_before() -> None:
    small = [replace(o, image_size=(640, 512)) for o in observed(40, 2 * S, size=0.5)]
    poses, windows = run([*observed(40), *small])
    alone, alone_windows = run(small)
    assert [restarted(p) for p in poses] == [i in (0, 40) for i in range(80)]
    assert same(poses[40:], alone)
    assert same(windows[3:], alone_windows)


def test_adjuster_takes_poses_of_another_day_when_its_node_does() -> None:
    day = 86_400 * S
    poses, windows = run([*observed(40), *observed(40, day)])
    assert len(poses) == 79  # one image confirms the jump
    # The node refuses four poses, until five agree.
    assert min(w.stamp_ns[0] for w in windows if w.stamp_ns[-1] > day) == poses[44].observation.stamp_ns


def test_a_gap_keeps_the_size_and_restarts_the_window() -> None:
    # The person is smaller in the image after the gap: the proportions stay, the size in the image is estimated again.
    before, after = observed(40), observed(30, 10 * S, size=0.5)
    poses, windows = run([*before, *after])
    assert not restarted(poses[40])
    limbs = [np.linalg.norm(p.initial.joints3d[3] - p.initial.joints3d[2]) for p in poses]
    assert np.median(limbs[40:]) == pytest.approx(np.median(limbs[10:40]), rel=0.15)
    assert all(w.stamp_ns[0] >= 10 * S or w.stamp_ns[-1] < 10 * S for w in windows)


SWAP = np.array([0, 1, 5, 6, 4, 2, 3, *range(7, 15)])


def test_exchanged_legs_are_exchanged_back() -> None:
    clean = observed(72)
    wrong = {*range(20, 24), *range(45, 52)}
    swapped = [replace(o, keypoints=o.keypoints[SWAP]) if i in wrong else o for i, o in enumerate(clean)]
    truth = 1000.0 * make_walk(72).in_camera
    errors = []
    for stream in (clean, swapped):
        poses, windows = run(stream)
        initial = pa_mpjpe(np.array([p.initial.joints3d for p in poses], float), truth)
        place = np.searchsorted(stamps(72), windows[-1].stamp_ns)
        errors.append((initial.mean(), pa_mpjpe(windows[-1].joints3d.astype(float), truth[place]).mean()))
    assert errors[1][0] < errors[0][0] + 2.0
    assert errors[1][1] < errors[0][1] + 2.0


def eventful() -> list[PoseObservation]:
    """A stream with a duplicate, a late, a stray and a blind image, a gap, a second round, other subjects."""
    first = observed(60, 100 * S)
    unseen = {"keypoints": np.full((15, 2), np.nan, np.float32), "confidence": np.zeros(15, np.float32)}
    blind = replace(first[29], stamp_ns=first[29].stamp_ns + 1, **unseen)
    other = observed(50, 103 * S, track_id=2)
    hidden = [replace(o, track_id=3, stamp_ns=o.stamp_ns + 20 * S, **unseen) for o in first[:12]]
    beside = first[29], first[20], *observed(1, 700 * S), blind
    return [*first[:30], *beside, *first[30:], *observed(40, 106 * S), *first, *other, *hidden]


def test_every_event_is_told_and_every_initial_pose_has_a_latest_one_but_of_dropped_images() -> None:
    steps, windows = run(eventful())
    # Of 60 + 40 + 60 + 50 + 12 images and the blind one, the initializer drops the second round's first.
    assert len(steps) == 222
    assert all(step.latest is not None for step in steps)
    assert {step.latest.refined for step in steps if step.latest} == {False, True}
    events = Counter(step.event for step in steps if step.event is not StreamEvent.CONTINUED)
    assert events == {
        StreamEvent.FIRST: 1, StreamEvent.GAP: 1, StreamEvent.TIME_JUMP: 1, StreamEvent.NEW_SUBJECT: 2
    }  # fmt: skip
    for window in windows:
        assert (np.diff(window.stamp_ns) > 0).all()
        assert np.diff(window.stamp_ns).max() < S
    # A window without keypoints cannot be adjusted.
    assert sum(step.due for step in steps) == len(windows) + 1


def test_the_steps_of_a_window_that_was_cut_repeat_it_bit_for_bit() -> None:
    """Also those of coarser windows, and of a graph that skipped some."""
    seen, core, adjuster, initializer = observed(72), LiveCore(ADJUSTER), LiveAdjuster(ADJUSTER), LiveInitializer()
    windows: dict[int, AdjustedWindow] = {}
    due = 0
    for o in seen:
        core.add_observation(o)
        step = core.add_initial(pushed(initializer, o))
        assert step is not None
        due += step.due
        if step.due and due != 2:
            late = map(bool, [*[0] * 4, *[1] * 999])
            windows[o.stamp_ns] = adjuster.adjust(core.window(), Effort(1 + due % 2), late.__next__)
    assert any(w.effort.steps for w in windows.values())
    _, again = run(seen, lambda stamp: windows[stamp].effort if stamp in windows else None)
    assert same(list(windows.values()), again)


def pushed(initializer: LiveInitializer, observation: PoseObservation) -> LivePose:
    pose = initializer.push(observation)
    assert pose is not None
    return pose


def test_parts_are_joined_in_any_order_and_old_ones_are_dropped() -> None:
    core, initializer = LiveCore(replace(ADJUSTER, max_pending=2)), LiveInitializer()
    seen = observed(6)
    poses = [pushed(initializer, o) for o in seen]
    assert core.add_observation(seen[0]) is None
    first = core.add_initial(poses[0])
    assert first is not None
    assert first.observation is seen[0]
    assert core.add_initial(poses[1]) is None
    assert core.add_observation(seen[1]) is not None
    for o in seen[2:5]:
        core.add_observation(o)
    assert core.unpaired == [1, 0]
    assert core.add_initial(poses[2]) is None
    assert core.add_initial(poses[4]) is not None
    core.add_observation(seen[5])
    with pytest.raises(InputError, match="track_id: expected 1 in pose3d/initial"):
        core.add_initial(replace(poses[5], track_id=2))


def test_a_solution_counts_from_its_arrival_and_for_its_subject_alone() -> None:
    first, other = observed(24), observed(24, 2 * S, track_id=2)
    core, initializer, adjuster = LiveCore(ADJUSTER), LiveInitializer(), LiveAdjuster(ADJUSTER)
    steps = list[Step]()
    for o in [*first, *other]:
        core.add_initial(pushed(initializer, o))
        step = core.add_observation(o)
        assert step is not None
        steps.append(step)
        if step.due and o.track_id == 1:
            window = core.window()
            core.add_solution(window, adjuster.adjust(window), o.stamp_ns + S // 4)
    refined = [step.latest is not None and step.latest.refined for step in steps]
    due = next(i for i, step in enumerate(steps) if step.due)
    assert refined[:24] == [o.stamp_ns >= first[due].stamp_ns + S // 4 for o in first]
    assert not any(refined[24:])


def test_reports_that_end_are_told_as_a_fault_and_those_that_never_came_are_none() -> None:
    window = run(observed(24))[1][-1]
    core = LiveCore(ADJUSTER)
    assert core.told(window) == (TelemetryUse.NONE, "", "", False)
    assert core.told(replace(window, telemetry=TelemetryUse.USED))[2:] == ("poses in the world", False)
    use, _, words, doubtful = core.told(window)
    assert (use, doubtful) == (TelemetryUse.LATE, True)
    assert "no reported camera pose" in words
