"""Which messages are requested from which autopilot, and which requests end."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.parser import CurrentMode, MavlinkParser
from drocap_ros.flight.mavlink.telemetry_request import AutopilotSettings, TelemetryRequests
from drocap_ros.flight.orbit.motion_checks import loss_condition
from drocap_ros.flight.orbit.states import Action, State
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

S = 1_000_000_000
GIMBAL, BEAT = mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS, mavlink.MAVLINK_MSG_ID_HEARTBEAT


def asked(requests, seconds, results=None, arriving=frozenset(), start_s=0):
    """(time in s, number, interval us) of the requests; all are answered, with 0 unless another result is given."""
    found = []
    for i in range(start_s * 50, (start_s + seconds) * 50):
        now = i * S // 50
        for number in arriving:
            requests.count(number, now)
        for number, interval in requests.due(now):
            found.append((i / 50, number, interval))
            requests.acknowledge((results or {}).get(number, 0), now)
    return found


def test_px4_is_asked_for_current_mode_and_not_for_a_faster_heartbeat(caplog):
    requests = TelemetryRequests(MavlinkBridgeConfig(commands_enabled=True))
    requests.set_autopilot(autopilot_of("px4"))
    first = {number: interval for _, number, interval in asked(requests, 1)}
    assert BEAT not in first
    assert first[CurrentMode.id] == 50_000
    twice_a_second = [number for _, number, _ in asked(requests, 10, start_s=1)]
    assert CurrentMode.id in twice_a_second  # nothing arrived
    for i in range(40):
        requests.count(CurrentMode.id, (20 * 50 + i * 25) * S // 50)
    assert requests.rate_hz(CurrentMode.id, 40 * S) == pytest.approx(2.0, rel=0.2)
    assert CurrentMode.id not in [number for number, _ in requests.due(40 * S)]
    assert caplog.records == []


def test_an_autopilot_that_refuses_current_mode_is_named_once(caplog):
    requests = TelemetryRequests(MavlinkBridgeConfig(commands_enabled=True))
    requests.set_autopilot(autopilot_of("px4"))
    times = asked(requests, 60, {CurrentMode.id: mavlink.MAV_RESULT_DENIED})
    assert [number for _, number, _ in times].count(CurrentMode.id) == 1
    assert requests.refused() == {}
    assert ["CURRENT_MODE" in record.message for record in caplog.records] == [True]


def test_ardupilot_is_asked_for_a_fast_heartbeat():
    requests = TelemetryRequests(MavlinkBridgeConfig(commands_enabled=True))
    requests.set_autopilot(autopilot_of("ardupilot"))
    assert {n: i for _, n, i in asked(requests, 1)}[BEAT] == 200_000
    assert CurrentMode.id not in {n for _, n, _ in asked(requests, 5, start_s=1)}


@pytest.mark.parametrize(("result", "count"), [(0, 10), (mavlink.MAV_RESULT_DENIED, 2)])
def test_a_vehicle_without_a_mount_is_not_asked_for_ever(result, count):
    requests = TelemetryRequests(MavlinkBridgeConfig())
    times = [t for t, number, _ in asked(requests, 120, {GIMBAL: result}) if number == GIMBAL]
    assert len(times) == count
    assert requests.refused() == {}


def test_a_mount_that_has_sent_its_attitude_is_asked_again():
    requests = TelemetryRequests(MavlinkBridgeConfig())
    asked(requests, 10, arriving={GIMBAL})
    assert [n for _, n, _ in asked(requests, 60, start_s=20)].count(GIMBAL) > 10


def test_a_message_that_we_do_not_know_is_no_bad_data():
    parser = MavlinkParser()
    unknown = bytes([0xFD, 2, 0, 0, 0, 1, 1, 0x9A, 0x01, 0, 7, 8, 1, 2])  # EVENT, 410
    assert parser.feed(unknown) == []
    assert (parser.bad_count, parser.unknown_count) == (0, 1)
    mav = mavlink.MAVLink(None)
    damaged = bytearray(mav.heartbeat_encode(2, 3, 0, 0, 4).pack(mav))
    damaged[-1] ^= 1
    assert parser.feed(bytes(damaged) + bytes(300)) == []
    noise = MavlinkParser()
    for pieces in (1, 2, 3):
        assert parser.bad_count > 0
        assert noise.feed(b"noise") == []
        assert noise.bad_count == pieces


def test_another_autopilot_on_the_same_link_is_asked_for_its_own_messages():
    down, up = Channel(lambda: 0.0), Channel(lambda: 0.0)
    down.delay_s = 0.0
    config = MavlinkBridgeConfig(commands_enabled=True)
    link = MavlinkLink(config, monotonic_s=lambda: 0.0, transport=LoopbackTransport(down, up))
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    link.estimator.mount.servos = True
    for autopilot in (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA):
        down.write(mav.heartbeat_encode(2, autopilot, 129, 4, 4).pack(mav))
        link.spin_once()
    wanted = link.status().rates_hz
    assert {"HEARTBEAT", "EKF_STATUS_REPORT"} <= set(wanted)
    assert not {"CURRENT_MODE", "ESTIMATOR_STATUS"} & set(wanted)
    assert link.estimator.mount.servos is None


def test_requests_continue_where_the_clock_goes_back():
    """As a clock that NTP sets, or a simulation that starts again."""
    requests = TelemetryRequests(MavlinkBridgeConfig())
    asked(requests, 20, start_s=1000)
    assert {number for _, number, _ in asked(requests, 20)} == set(requests._wanted)
    streams = set(requests._wanted)
    asked(requests, 20, arriving=streams, start_s=1000)
    asked(requests, 1, arriving=streams)
    assert max(real for real, _ in requests.rates_hz(S).values()) == pytest.approx(50, rel=0.1)


MAV = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
REAL, INTEGER = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32


def settings(autopilot, **values):
    known = AutopilotSettings()
    known.set_autopilot(autopilot_of(autopilot))
    for name, value in values.items():
        kind = INTEGER if isinstance(value, int) else REAL
        raw = value * 2.0**-149 if isinstance(value, int) else value  # the integer's bytes, read as a float
        (message,) = mavlink.MAVLink(None).parse_buffer(
            MAV.param_value_encode(name.encode(), raw, kind, 9, 0).pack(MAV)
        )
        known.take(message)
    return known


@pytest.mark.parametrize(
    ("autopilot", "values", "code"),
    [
        ("ardupilot", {}, ConditionCode.TIMEOUT_UNKNOWN),
        ("ardupilot", {"GUID_TIMEOUT": math.nan}, ConditionCode.TIMEOUT_UNKNOWN),
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, ConditionCode.TIMEOUT_TOO_LONG),
        ("ardupilot", {"GUID_TIMEOUT": 0.5}, None),
        ("px4", {"COM_OBL_RC_ACT": 5}, ConditionCode.TIMEOUT_UNKNOWN),
        ("px4", {"COM_OF_LOSS_T": 1.0}, ConditionCode.TIMEOUT_TOO_LONG),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 7}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 6}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 0}, ConditionCode.LOSS_ACTION_FATAL),  # as it ships
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 1}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 2}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 3}, None),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 4}, None),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5}, None),
        ("other", {}, None),
    ],
)
def test_settings_that_forbid_motion(autopilot, values, code):
    known = settings(autopilot, **values).loss_settings()
    meaning = autopilot_of(autopilot).loss_action
    found = loss_condition(known, meaning, 0.5)
    assert (found and found.code) == code
    assert loss_condition(known, meaning, 0.0) is None
    if code == ConditionCode.LOSS_ACTION_FATAL:
        assert "set COM_OBL_RC_ACT to 5, hold" in str(found)
    if code == ConditionCode.TIMEOUT_TOO_LONG:
        assert f"set {known.timeout_name} to 0.5" in str(found)


def test_leaving_without_setpoints_is_a_warning():
    assert "lands" in settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=4).warning()
    assert "home" in settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=3).warning()
    assert settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=5).warning() == ""
    assert settings("ardupilot", GUID_TIMEOUT=0.5).warning() == ""


def test_settings_are_requested_until_reported_and_then_rarely():
    known = settings("ardupilot")
    asked = [t for t in range(0, 60_000, 10) if known.due(t / 1000)]
    assert len([t for t in asked if t < 7000]) == 10
    assert len(asked) < 20
    reported = settings("ardupilot", GUID_TIMEOUT=0.5)
    assert len([t for t in range(0, 60_000, 10) if reported.due(t / 1000)]) == 6


@pytest.mark.parametrize(("autopilot", "name"), [("ardupilot", "GUID_TIMEOUT"), ("px4", "COM_OF_LOSS_T")])
def test_orbit_is_refused_when_the_autopilot_flies_on_without_setpoints(autopilot, name):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seconds=10, timeout_s=autopilot_of(autopilot).shipped_timeout_s))
    loop.start()
    loop.run(7.0)
    answer = loop.answers[0][1]
    assert not answer.accepted
    assert answer.condition.values["name"] == name
    assert all(row.action == Action.NOTHING for row in loop.rows)
    allowed = OrbitLoop(with_config(loop.settings, max_control_timeout_s=3.0))
    allowed.start()
    allowed.run(7.0)
    assert allowed.controller.safety.state == State.ORBITING


def test_settings_are_read_again_where_the_clock_goes_back():
    known = settings("ardupilot", GUID_TIMEOUT=0.5)
    assert known.due(1000.0) == ["GUID_TIMEOUT"]
    assert known.due(1000.1) == []
    assert known.due(5.0) == ["GUID_TIMEOUT"]
