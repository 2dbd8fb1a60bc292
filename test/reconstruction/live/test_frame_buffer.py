"""The frames of the live window and when an adjustment is due."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from live_stream import observed
from walking import stamps

from drocap_ros.background import Background
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.frame_buffer import FrameBuffer, StreamEvent

ADJUSTER = BundleAdjusterConfig(period_s=0.5, window_s=2.0)
JOINTS = np.zeros((15, 3))


def test_duplicate_and_late_frames_are_dropped() -> None:
    buffer = FrameBuffer(ADJUSTER)
    frames = observed(10)
    for o in frames:
        buffer.push(o, JOINTS)
    for o in (frames[9], frames[3]):
        assert not buffer.push(o, JOINTS)
    assert buffer.event is StreamEvent.LATE
    np.testing.assert_array_equal(buffer.window().stamp_ns, stamps(10))


@pytest.mark.parametrize("again", ["another subject", "a gap"])
def test_the_first_adjustment_is_due_after_a_third_of_a_period_then_every_period(again: str) -> None:
    buffer = FrameBuffer(ADJUSTER)
    start_s = 0.0
    for _ in range(2):
        due_s = [
            (o.stamp_ns - stamps(60)[0]) * 1e-9
            for o in observed(60)
            if buffer.push(
                replace(
                    o,
                    stamp_ns=o.stamp_ns + round(start_s * 1e9),
                    track_id=int(start_s) if again == "another subject" else o.track_id,
                ),
                JOINTS,
            )
        ]
        # To the frame: 25 of them a second.
        np.testing.assert_allclose(due_s, [1 / 6, 2 / 3, 7 / 6, 5 / 3, 13 / 6], atol=0.041)
        start_s += 60.0 if again == "a gap" else 3.0


def test_every_nth_frame_is_counted_from_the_newest() -> None:
    buffer = FrameBuffer(ADJUSTER)
    for o in observed(10):
        buffer.push(o, JOINTS)
    part = buffer.window().every(3)
    np.testing.assert_array_equal(part.stamp_ns, stamps(10)[[0, 3, 6, 9]])
    assert part.keypoints.xy.shape == (4, 17, 2)


def test_frames_near_those_with_fixed_points_are_left_out() -> None:
    buffer = FrameBuffer(ADJUSTER)
    for o in observed(10):
        buffer.push(o, JOINTS)
    seldom, always = (
        Background(frames, np.arange(len(frames)), np.zeros((len(frames), 2), np.float32))
        for frames in (np.array([1, 4, 7], np.int32), np.arange(10, dtype=np.int32))
    )
    part = buffer.window()._replace(background=seldom).every(2)
    np.testing.assert_array_equal(part.stamp_ns, stamps(10)[[1, 4, 7, 9]])
    assert part.background is not None
    np.testing.assert_array_equal(part.background.frame, [0, 1, 2])
    part = buffer.window()._replace(background=always).every(3)
    np.testing.assert_array_equal(part.stamp_ns, stamps(10)[[0, 3, 6, 9]])


def test_memory_is_bounded_at_any_frame_rate() -> None:
    buffer = FrameBuffer(BundleAdjusterConfig(window_frames=50))
    for i, o in enumerate(observed(60) * 2):
        buffer.push(replace(o, stamp_ns=i * 10**6), JOINTS)
    assert len(buffer.window().stamp_ns) == 50
