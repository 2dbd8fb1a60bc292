"""``drocap orbit plan``: the picture of a recorded flight, and what it refuses."""

import cv2
import numpy as np
import pytest
from recorded import record

from drocap_ros.cli import main
from drocap_ros.geometry.rotations import quaternion_from_matrix
from drocap_ros.simulation.orbit_camera import orbit_camera
from drocap_ros.simulation.simulated_person import simulate_person

EPOCH_NS = 10**18


def session(folder, messages, frame="map", seconds=9.0):
    """Windows of three seconds, one a second, of a person who does squats, seen from the orbit."""
    time = np.arange(0.0, seconds, 1 / 12)
    joints = simulate_person(time, "squats", 1)
    joints = np.concatenate([joints, joints[:, [3, 6]] + [0.0, 0.15, -0.05]], axis=1)
    rotation, _ = orbit_camera(time, joints[:, 0], 6.0, 2.5, 17.0)
    poses = [
        messages(
            "drocap_ros/msg/Pose3D", header=messages.header(EPOCH_NS + round(1e9 * t), frame), track_id=1,
            skeleton="body17", joints=pose.ravel().astype(np.float32),
            camera_orientation=messages.quaternion(quaternion_from_matrix(turn)),
        )
        for t, pose, turn in zip(time, joints, rotation, strict=True)
    ]  # fmt: skip
    windows = [
        messages("drocap_ros/msg/Pose3DWindow", header=poses[end - 1].header, poses=poses[max(end - 36, 0) : end])
        for end in range(36, len(poses), 12)
    ]
    topic, times = "/drocap/pose3d/refined", range(EPOCH_NS, EPOCH_NS + 10**12, 10**9)
    record(folder, [(topic, w, at_ns, messages.cdr(w)) for w, at_ns in zip(windows, times, strict=False)])
    return folder


def test_the_plan_of_a_session_is_drawn_and_said_in_a_line(tmp_path, messages, capsys):
    out = tmp_path / "plan.png"
    assert main(["orbit", "plan", "--session", str(session(tmp_path / "s", messages)), "--out", str(out)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{out}: 8 s, joints within ")
    assert cv2.imread(str(out)).std() > 10.0


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({"frame": "camera_optical"}, "s: expected 5 s of refined poses in map (/drocap/pose3d/refined), found none"),
        ({"seconds": 5.0}, "found 3.9 s; record a flight with telemetry"),
    ],
)
def test_a_session_without_enough_poses_in_map_is_refused(tmp_path, messages, capsys, values, found):
    path = session(tmp_path / "s", messages, **values)
    assert main(["orbit", "plan", "--session", str(path), "--out", str(tmp_path / "p.png")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert found in line
    assert not (tmp_path / "p.png").exists()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["plan"], "orbit plan: expected a recorded flight, got none; name it: --session S"),
        (["plan", "--session", "nowhere"], "nowhere: expected"),
        (["plan", "--session", "nowhere", "--radius", "2"], "radius_m: expected at least 3.5 m"),
        (["start", "--session", "nowhere"], "--session: start takes none"),
        (["stop", "--plan", "accuracy"], "--plan: stop takes none"),
        (["start", "--plan", "fast"], "invalid choice: 'fast'"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_a_line(words, found, capsys):
    assert main(["orbit", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert found in line
