"""Comparison and studies on motions whose errors are known."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import compare, load_truth
from drocap_ros.motion import Motion, save_motion
from drocap_ros.skeleton import BODY_15, BODY_17


def stick(frames: int) -> np.ndarray:
    """(F, 15, 3) m: a swaying figure."""
    rng = np.random.default_rng(0)
    body = np.zeros((15, 3))
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            body[joint] = body[parent] + rng.normal(0, 0.1, 3) + (0, 0, 0.25 if joint >= 7 else -0.25)
    time = np.arange(frames)[:, None, None]
    return body + 0.05 * np.sin(0.2 * time + rng.uniform(0, 6, (1, 15, 3)))


def motion(joints: np.ndarray, frame: str = "camera", fps: float = 24.0) -> Motion:
    count = len(joints)
    return Motion(
        joints3d=joints,
        joints=BODY_15.joints,
        parents=BODY_15.parents,
        stamp_ns=np.round(np.arange(count) * 1e9 / fps).astype(np.int64),
        frame=frame,
        metric=False,
        scale_source="assumed_height",
        camera_rotation=np.tile(np.eye(3), (count, 1, 1)),
        confidence=np.ones((count, 15)),
        keypoints=np.zeros((count, 15, 2)),
        reprojection_px=np.zeros((count, 15)),
    )


def save_mocap(path, joints: np.ndarray, fps: float = 24.0) -> None:
    np.savez(path, X=(1000 * joints).astype(np.float32), fps=fps, joints=np.array(BODY_15.joints))


def test_perfect_motion_has_no_error_in_any_frame_and_scale(tmp_path):
    x = stick(40)
    save_mocap(tmp_path / "truth.npz", x)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    errors = compare(motion(1.1 * x @ turn.T + 3.0), *load_truth(tmp_path / "truth.npz"))
    assert errors.error_mm < 0.01
    assert errors.scale_error == pytest.approx(0.1, abs=1e-4)
    assert not errors.mirrored
    assert errors.world is None
    assert max(errors.per_group_mm.values()) < 0.01


def test_toes_of_mocap_are_compared(tmp_path):
    x = np.concatenate([stick(40), stick(40)[:, [3, 6]] + (0.1, 0.0, 0.0)], axis=1)
    save_mocap(tmp_path / "truth.npz", x[:, :15])
    with np.load(tmp_path / "truth.npz") as file:
        np.savez(tmp_path / "toes.npz", **file, toes=1000 * x[:, 15:], toe_joints=np.array(BODY_17.joints[15:]))
    ours = replace(motion(x[:, :15]), joints3d=x, joints=BODY_17.joints, parents=BODY_17.parents)
    assert compare(ours, *load_truth(tmp_path / "toes.npz")).toe_mm < 0.01
    assert np.isnan(compare(ours, *load_truth(tmp_path / "truth.npz")).toe_mm)


def test_mirrored_motion_is_reported():
    x = stick(30)
    errors = compare(motion(x * [1, 1, -1]), x, np.arange(30) / 24.0, "camera")
    assert errors.mirrored
    assert errors.mirrored_share == 1.0
    assert errors.error_mm > 50.0


def test_world_frames_give_world_error_and_horizon_error():
    x = stick(30)
    tilt = np.radians(5.0)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    errors = compare(motion(x @ turn.T, "world"), x, np.arange(30) / 24.0, "world")
    assert errors.world.horizon_deg == pytest.approx(5.0, abs=1e-3)
    assert errors.world.w_mm < 1e-3


def test_images_left_out_change_neither_speed_nor_acceleration():
    time_s = np.arange(121) / 24.0
    truth, estimate = np.zeros((2, 121, 15, 3))
    truth[..., 0] = 0.08 * time_s[:, None]  # still, at 0.08 m/s: a step over a gap is longer, not faster
    estimate[..., 0] = 0.2 * time_s[:, None]
    head = BODY_15.index("head")
    truth[:, head, 2], estimate[:, head, 2] = 0.5 * time_s**2, 1.5 * time_s**2  # 1 and 3 m/s^2
    kept = np.sort(np.random.default_rng(0).choice(121, 60, replace=False))
    whole = motion(estimate, "world")
    errors = compare(replace(motion(estimate[kept], "world"), stamp_ns=whole.stamp_ns[kept]), truth, time_s, "world")
    assert errors.world.foot_m_s == pytest.approx(0.2)
    assert errors.world.acceleration_ratio == pytest.approx(3.0, rel=1e-3)
    assert errors.world.acceleration_error_m_s2 == pytest.approx(2.0 / 15.0, rel=1e-3)


def test_truth_at_another_rate_is_interpolated():
    x = stick(61)
    errors = compare(motion(x[::2], fps=12.0), x, np.arange(61) / 24.0, "camera")
    assert errors.frames == 31
    assert errors.error_mm < 1e-6


def test_compare_says_that_times_do_not_overlap(tmp_path, caplog):
    x = stick(30)
    save_mocap(tmp_path / "truth.npz", x)
    later = motion(x)
    words = ["evaluate", "compare", str(tmp_path / "motion.npz"), str(tmp_path / "truth.npz")]
    for shift_ns, said in ((0, 0), (10**18, 1)):
        save_motion(tmp_path / "motion.npz", replace(later, stamp_ns=later.stamp_ns + shift_ns))
        assert main(words) == 0
        assert caplog.text.count("do not overlap") == said


def test_compare_refuses_unusable_truth_or_motion(tmp_path):
    x = stick(10)
    with pytest.raises(InputError, match="finite"):
        compare(motion(x), np.full_like(x, np.nan), np.arange(10) / 24.0, "camera")
    with pytest.raises(InputError, match="found none"):
        compare(motion(np.full_like(x, np.nan)), x, np.arange(10) / 24.0, "camera")
    np.savez(tmp_path / "odd.npz", a=1)
    with pytest.raises(InputError, match="expected MoCap"):
        load_truth(tmp_path / "odd.npz")


@pytest.mark.parametrize("kind", ["compare", "pair"])
def test_compare_command_writes_files_and_refuses_missing_ones_with_status_2(tmp_path, capsys, kind):
    x = stick(30)
    save_motion(tmp_path / "motion.npz", motion(x))
    save_mocap(tmp_path / "truth.npz", x)
    out = tmp_path / "out"
    assert main(["evaluate", kind, str(tmp_path), str(tmp_path / "truth.npz"), "--out", str(out)]) == 0
    assert "| error mm |" in capsys.readouterr().out.replace("frames | error", "| error")
    with (out / "compare.csv").open(encoding="utf-8") as file:
        (line,) = csv.DictReader(file)
    assert float(line["error_mm"]) < 0.01
    assert line["mirrored"] == "False"
    assert (out / "compare.png").read_bytes().startswith(b"\x89PNG")
    assert main(["evaluate", kind, str(tmp_path / "none.npz"), str(tmp_path / "truth.npz")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no such file" in said
