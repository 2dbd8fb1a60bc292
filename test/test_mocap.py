"""MoCap files: reading and resampling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from walking import write_mocap

from drocap_ros.errors import InputError
from drocap_ros.mocap import load_mocap
from drocap_ros.skeleton import BODY_17
from lab.studies.protocol import resample


def test_resampling_keeps_the_motion() -> None:
    t = np.arange(91) / 30.0
    x = np.sin(t)[:, None, None] * np.ones((1, 15, 3))
    out = resample(x, 30.0, 24.0)
    assert len(out) == 73
    np.testing.assert_allclose(out[:, 0, 0], np.sin(np.arange(73) / 24.0), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"X": np.zeros((4, 3, 3))}, r"X: expected \(T, 15, 3\)"),
        ({"fps": np.array(0.0)}, "fps: expected a number from 1 to 1000"),
        ({"fps": np.array("abc")}, "fps: expected a number from 1 to 1000"),
        ({"fps": np.array([30.0, 30.0])}, "fps: expected a number from 1 to 1000"),
        ({"joints": np.array(["a"] * 15)}, "bad.npz: .*missing pelvis"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, changes: dict[str, np.ndarray], match: str) -> None:
    write_mocap(tmp_path, "bad", frames=200, **changes)
    with pytest.raises(InputError, match=match):
        load_mocap(tmp_path / "bad.npz")


@pytest.mark.parametrize("kind", ["tip", "ball"])
def test_toes_are_read_where_they_are_tips(tmp_path: Path, kind: str) -> None:
    left, right = np.full((90, 3), 1.0), np.full((90, 3), 2.0)
    further = {"toes": np.stack([left, right], axis=1), "toe_joints": np.array(["ltoe", "rtoe"])}
    write_mocap(tmp_path, "toes", frames=90, toe_kind=np.array(kind), **further)
    x, fps = load_mocap(tmp_path / "toes.npz", joints=BODY_17)
    expected = np.stack([right, left], axis=1) if kind == "tip" else np.full((90, 2, 3), np.nan)
    np.testing.assert_array_equal(x[:, 15:], expected)
    np.testing.assert_array_equal(load_mocap(tmp_path / "toes.npz")[0], x[:, :15])
    resampled = resample(x, fps, 0.5 * fps)
    assert np.isfinite(resampled[:, :15]).all()
    assert np.isfinite(resampled[:, 15:]).all() == (kind == "tip")
