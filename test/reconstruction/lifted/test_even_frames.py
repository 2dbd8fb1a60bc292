"""Frames at any times on an even grid."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.windows import even_slots, spread_keypoints


def test_dropped_frames_leave_empty_slots():
    slot, fps = even_slots((np.array([0, 1, 2, 5, 6, 7]) * 40_000_000).astype(np.int64))
    np.testing.assert_array_equal(slot, [0, 1, 2, 5, 6, 7])
    assert fps == pytest.approx(25.0)
    # A long pause does not enlarge the grid.
    slot, _ = even_slots(np.array([0, 40_000_000, 80_000_000, 3_600_000_000_000], dtype=np.int64))
    assert slot[-1] < 40


def test_empty_slots_have_no_seen_joint():
    keypoints = Keypoints2D(np.ones((2, 15, 2)), np.ones((2, 15)), np.ones((2, 15, 3)))
    spread = spread_keypoints(keypoints, np.array([0, 2]))
    np.testing.assert_array_equal(spread.seen.all(axis=1), [True, False, True])
    np.testing.assert_array_equal(spread.weights[1], 0.0)
