"""The time between a motion and its truth, found by the poses."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.evaluation.compare import compare
from drocap_ros.evaluation.time_offset import find_offset
from drocap_ros.motion import Motion, save_motion
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17


def taken(start_s, seconds, rate_hz, action="mixed", seed=0):
    """Joints (F, 17, 3) of a take and their times from its start, s."""
    t = start_s + np.arange(0, seconds, 1 / rate_hz)
    return simulate_person(t, action, seed, joint_set=BODY_17), t - start_s


def as_motion(joints, time_s, begin_ns=0):
    frames = len(joints)
    turned = joints @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]).T * 0.93 + [3, 4, 0]
    return Motion(
        turned, BODY_17.joints, BODY_17.parents, begin_ns + np.round(time_s * 1e9).astype(np.int64), "world", False,
        "assumed_height", np.tile(np.eye(3), (frames, 1, 1)), np.ones((frames, 17)), np.zeros((frames, 17, 2)),
        np.zeros((frames, 17)), {},
    )  # fmt: skip


@pytest.mark.parametrize("offset_s", [-1.7, 0.0, 0.42, 3.13, 9.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [30, 120])
def test_the_offset_is_found(offset_s, seed, rate_hz):
    truth, truth_s = taken(4.0, 14.0, rate_hz, seed=seed)
    joints, time_s = taken(4.0 + offset_s, 5.0, 24, seed=seed)
    noisy = joints + np.random.default_rng(0).normal(0, 0.03, joints.shape)
    found = find_offset(noisy, time_s, truth, truth_s)
    assert found is not None
    assert found[0] == pytest.approx(offset_s, abs=0.04)


@pytest.mark.parametrize("action", ["walk", "squats", "boxing", "kicking"])
def test_a_motion_that_repeats_itself_has_the_right_offset_or_none(action):
    found = find_offset(*taken(5.1, 5.0, 24, action), *taken(4.0, 14.0, 60, action))
    assert found is None or found[0] == pytest.approx(1.1, abs=0.03)


def test_takes_of_others_have_no_offset():
    clear = [find_offset(*taken(0, 5, 24, "walk", seed), *taken(0, 14, 60, "boxing", 9)) for seed in range(4)]
    assert clear == [None] * 4


def test_clocks_that_have_nothing_in_common_are_joined_by_the_poses(tmp_path, caplog, capsys):
    truth, truth_s = taken(0.0, 12.0, 60)
    joints, time_s = taken(3.4, 5.0, 30)
    motion = as_motion(joints, time_s, 1_700_000_000 * 10**9)
    found = compare(motion, truth, truth_s, "world")
    assert found.error_mm < 2
    assert "by the poses the motion begins 3.40 s after the truth" in caplog.text
    with_clock = dataclasses.replace(motion, stamp_ns=motion.stamp_ns - motion.stamp_ns[0])
    assert compare(with_clock, truth, truth_s, "world").error_mm > 50
    for offset in (float("nan"), 3.4):
        assert compare(with_clock, truth, truth_s, "world", offset).error_mm < 2
    save_motion(tmp_path / "motion.npz", with_clock)
    np.savez(tmp_path / "truth.npz", X=1000 * truth, fps=60.0, joints=BODY_17.joints)
    words = ["evaluate", "compare", str(tmp_path / "motion.npz"), str(tmp_path / "truth.npz")]
    printed = []
    for offset in ([], ["--time-offset", "find"], ["--time-offset", "3.4"]):
        assert main([*words, *offset]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] != printed[1] == printed[2]
    assert main([*words, "--time-offset", "soon"]) == 2
