"""Which messages are requested from which autopilot, and which requests end."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.parser import CurrentMode, MavlinkParser
from drocap_ros.flight.mavlink.telemetry_request import TelemetryRequests
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

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
    assert parser.bad_count > 0


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
