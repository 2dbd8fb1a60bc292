import math
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator
from drocap_ros.flight.vehicle import quaternion_from_euler, yaw_of
from drocap_ros.recording.telemetry.log import Lack
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.tlog import tlog_messages

SHARED = Path(__file__).parents[3].parent / "shared"
TLOG = SHARED / "media" / "arduplane_vtol_sitl.tlog"


@pytest.fixture(scope="module")
def messages():
    if not TLOG.exists():
        pytest.skip(f"{TLOG.name} is missing (../shared)")
    return list(tlog_messages(TLOG))


def test_messages_equal_what_pymavlink_reads(messages):
    from pymavlink import mavutil

    log, theirs = mavutil.mavlink_connection(str(TLOG)), []
    while (message := log.recv_match()) is not None:
        theirs.append((message.get_type(), message._timestamp))
    assert [m.get_type() for m, _ in messages] == [name for name, _ in theirs]
    assert np.allclose([t * 1e-9 for _, t in messages], [t for _, t in theirs], rtol=0, atol=1e-6)


def test_states_of_a_real_log_agree_with_its_attitude_and_velocity(messages):
    estimator, states, attitudes = VehicleStateEstimator(), [], []
    for message, received_ns in messages:
        state = estimator.update(message, received_ns)
        if state is not None:
            states.append(state)
            attitudes.append((message.roll, message.pitch, message.yaw))
    names = [m.get_type() for m, _ in messages]
    received = names[names.index("HEARTBEAT") :].count("ATTITUDE")
    assert received - 3 <= len(states) <= received  # stamps that do not increase are left out
    assert (states[-1].autopilot, states[0].armed) == ("ardupilot", True)
    stamps = np.array([s.stamp_ns for s in states])
    assert (np.diff(stamps) > 0).all()
    assert 205 < (stamps[-1] - stamps[0]) * 1e-9 < 210
    # The log's own figures: attitude, heading, height, speed.
    for state, angles in zip(states, attitudes, strict=True):
        q = quaternion_from_euler(*angles)
        ours = state.orientation_xyzw
        forward_up = 2 * (ours[0] * ours[2] - ours[3] * ours[1])  # z of the nose
        assert math.isclose(forward_up, math.sin(angles[1]), abs_tol=1e-6)
        assert math.isclose(float(yaw_of(q)), angles[2], abs_tol=1e-6)
    assert not any(s.position_ok for s in states)  # this simulator's estimator reports flags 0 throughout
    flying = [s for s in states if np.isfinite(s.position_enu_m).all()]
    assert len(flying) > 800
    speed = np.array([np.linalg.norm(s.velocity_enu_m_s) for s in flying])
    assert 10 < speed.max() < 40
    # Velocity is the derivative of position.
    p, v, t = (np.array([getattr(s, n) for s in flying]) for n in ("position_enu_m", "velocity_enu_m_s", "stamp_ns"))
    dt = np.diff(t)[:, None] * 1e-9
    moved = np.diff(p, axis=0)
    steady = dt[:, 0] < 0.5
    error = moved - 0.5 * (v[1:] + v[:-1]) * dt
    assert np.median(np.linalg.norm(error[steady], axis=1)) < 0.3


@pytest.mark.parametrize("content", [b"", b"not a log at all " * 100, bytes(5000)])
def test_files_without_messages_are_refused(tmp_path, content):
    path = tmp_path / "x.tlog"
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected a MAVLink telemetry log") as error:
        list(tlog_messages(path))
    assert "\n" not in str(error.value)


def test_missing_log_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_telemetry(tmp_path / "x.tlog")


def test_damaged_log_loses_only_damaged_messages(messages, tmp_path):
    data = bytearray(TLOG.read_bytes()[:300_000])
    whole = len(list(tlog_messages(_write(tmp_path, data))))
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(data), 20):
        data[place] ^= 0xFF
    damaged = len(list(tlog_messages(_write(tmp_path, data))))
    assert whole - 60 < damaged <= whole
    cut = len(list(tlog_messages(_write(tmp_path, data[:150_003]))))
    assert 0.4 * whole < cut < 0.6 * whole


def _write(folder, data):
    path = folder / "cut.tlog"
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("damage", ["bits", "hole", "noise", "none", "cut"])
def test_damage_of_a_tlog_is_told(messages, tmp_path, damage):
    data = TLOG.read_bytes()[:300_000]
    middle = len(data) // 2
    data = {
        "bits": data[:middle] + bytes(b ^ 90 for b in data[middle : middle + 900]) + data[middle + 900 :],
        "hole": data[:middle] + bytes(2000) + data[middle:], "none": data, "cut": data[: middle + 3],
        "noise": data[:middle] + np.random.default_rng(0).bytes(5000) + data[middle:],
    }[damage]  # fmt: skip
    log = read_telemetry(_write(tmp_path, data))
    assert any(lack.kind is Lack.DAMAGED for lack in log.lacks) == (damage not in ("none", "cut"))
