"""Windows of a long recording."""

from __future__ import annotations

import itertools

import pytest

from drocap_ros.reconstruction.common.windows import windows


@pytest.mark.parametrize(
    ("frames", "length", "overlap"), [(1, 480, 60), (480, 480, 60), (481, 480, 60), (5000, 480, 60), (97, 16, 400)]
)
def test_windows_cover_every_frame_and_overlap(frames: int, length: int, overlap: int) -> None:
    found = windows(frames, length, overlap)
    assert found[0].start == 0
    assert found[-1].stop == frames
    assert all(w.stop - w.start <= length for w in found)
    for a, b in itertools.pairwise(found):
        assert b.start > a.start
        assert a.stop - b.start >= min(overlap, length // 2) - 1
    assert sum(w.stop - w.start for w in found) <= frames + (len(found) - 1) * (overlap + 2)
