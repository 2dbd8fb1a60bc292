import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import ParameterError
from drocap_ros.flight.autopilot import AUTOPILOTS
from drocap_ros.flight.autopilot.ardupilot import ARDUPILOT
from drocap_ros.flight.autopilot.coasting import Setpoint, hold_setpoint
from drocap_ros.flight.autopilot.px4 import PX4
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import CommandQueue, halt_message, setpoint_message
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.parser import MavlinkParser, Packer
from drocap_ros.flight.mavlink.transport import LinkError
from drocap_ros.flight.orbit.watchdog import FallbackCommands, Watchdog
from drocap_ros.flight.vehicle import ned_to_enu
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

MAV = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
NUMBERS = st.floats(-100, 100, width=32)


@given(st.lists(NUMBERS, min_size=9, max_size=9), st.floats(-math.pi, math.pi), st.floats(-1, 1))
def test_setpoint_survives_the_wire(values, yaw, rate):
    setpoint = Setpoint(*(np.array(values[i : i + 3]) for i in (0, 3, 6)), yaw, rate)
    (got,) = MavlinkParser().feed(setpoint_message(MAV, (1, 1), setpoint).pack(MAV))
    assert got.type_mask == 0
    assert got.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    assert np.allclose(ned_to_enu(np.array([got.x, got.y, got.z])), setpoint.position)
    assert np.allclose(ned_to_enu(np.array([got.vx, got.vy, got.vz])), setpoint.velocity)
    assert np.allclose(ned_to_enu(np.array([got.afx, got.afy, got.afz])), setpoint.acceleration)
    nose = np.array([math.cos(got.yaw), math.sin(got.yaw), 0.0])  # north, east, down
    assert np.allclose(ned_to_enu(nose), [math.cos(yaw), math.sin(yaw), 0], atol=1e-6)
    assert got.yaw_rate == pytest.approx(-rate, abs=1e-6)


@pytest.mark.parametrize("field", range(5))
def test_setpoint_that_is_not_finite_is_never_sent(field):
    good = hold_setpoint(np.zeros(3), 0.0)
    values = list(good)
    values[field] = np.array([0, math.nan, 0]) if field < 3 else math.inf
    with pytest.raises(ValueError, match="finite"):
        setpoint_message(MAV, (1, 1), Setpoint(*values))


def test_halt_is_velocity_zero_alone():
    message = halt_message(MAV, (1, 1))
    assert message.type_mask & (8 | 16 | 32 | 2048) == 0  # velocity and yaw rate count
    assert message.type_mask & (1 | 2 | 4 | 64 | 128 | 256 | 1024) == 1479
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == (0, 0, 0, 0)


def test_command_is_sent_until_answered_and_a_failure_is_reported():
    queue = CommandQueue()
    queue.request(SET_MODE, ARDUPILOT.mode_parameters("GUIDED"), "mode GUIDED", 0.0)
    assert queue.due(0.0) == [(SET_MODE, 0, (1.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0))]
    assert queue.due(0.1) == []
    assert queue.due(0.5)[0][1] == 1
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_DENIED, 0.6)
    assert queue.due(5.0) == []
    assert queue.failure(SET_MODE) == "mode GUIDED: denied"
    queue.request(SET_MODE, ARDUPILOT.mode_parameters("GUIDED"), "mode GUIDED", 1.0)  # too soon
    assert queue.due(5.0) == []
    queue.request(SET_MODE, ARDUPILOT.mode_parameters("GUIDED"), "mode GUIDED", 6.0)
    assert len(queue.due(6.0)) == 1
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 6.1)
    assert queue.failure(SET_MODE) == ""


def test_command_without_an_answer_is_given_up():
    queue = CommandQueue()
    queue.request(SET_MODE, PX4.mode_parameters("LOITER"), "mode LOITER", 0.0)
    sent = sum(len(queue.due(0.5 * i)) for i in range(40))
    assert sent == 5
    assert "not answered after 5 tries" in queue.failure(SET_MODE)


def test_temporary_rejection_is_retried_and_progress_awaited():
    queue = CommandQueue()
    queue.request(SET_MODE, PX4.mode_parameters("OFFBOARD"), "mode OFFBOARD", 0.0)
    queue.due(0.0)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, 0.1)
    assert len(queue.due(0.6)) == 1
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_IN_PROGRESS, 0.7)
    assert queue.due(2.0) == []
    assert len(queue.due(4.0)) == 1
    queue.cancel_all()
    assert queue.due(9.0) == []


def link(**values):
    config = MavlinkBridgeConfig(commands_enabled=True, **values)
    up = Channel(lambda: 10.0)
    return MavlinkLink(config, lambda: 10**10, monotonic_s=lambda: 0.0, transport=LoopbackTransport(up, up))


def test_link_sends_only_setpoints_and_the_modes_of_the_autopilots():
    sender = link()
    sender.send_motion(halt_message(sender.mav, (1, 1)))
    for autopilot in AUTOPILOTS.values():
        for mode in (autopilot.control_mode, autopilot.hold_mode):
            message = sender.mav.command_long_encode(1, 1, SET_MODE, 0, *autopilot.mode_parameters(mode))
            sender.send_motion(message)
    for command, values in (
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1, 0, 0, 0, 0, 0, 0)),
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, 5)),
        (mavlink.MAV_CMD_NAV_LAND, (0,) * 7),
        (mavlink.MAV_CMD_DO_REPOSITION, (0,) * 7),
        (SET_MODE, (1, 9, 0, 0, 0, 0, 0)),  # LAND
        (SET_MODE, (1, 0, 0, 0, 0, 0, 0)),  # STABILIZE
        (SET_MODE, (1, 4, 6, 0, 0, 0, 0)),  # PX4's AUTO.LAND
    ):
        with pytest.raises(AssertionError, match="sends no"):
            sender.send_motion(sender.mav.command_long_encode(1, 1, command, 0, *values))
    for name in ("manual_control_encode", "param_set_encode"):
        values = (1, 0, 0, 0, 0, 0) if name.startswith("manual") else (1, 1, b"GUID_TIMEOUT", 3.0, 9)
        with pytest.raises(AssertionError, match="sends no"):
            sender.send_motion(getattr(sender.mav, name)(*values))


def test_link_sends_no_motion_without_permission():
    up = Channel(lambda: 0.0)
    sender = MavlinkLink(MavlinkBridgeConfig(), transport=LoopbackTransport(up, up))
    with pytest.raises(AssertionError, match="sends no"):
        sender.send_motion(halt_message(sender.mav, (1, 1)))
    with pytest.raises(AssertionError, match="sends no"):
        sender.check_motion(halt_message(sender.mav, (1, 1)))


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"height_m": 1.2}, "height_m"),
        ({"fence_radius_m": 6.0}, "fence_radius_m"),
        ({"commands_enabled": True, "status_hz": 0.5}, "status_hz"),
        ({"commands_enabled": True, "attitude_hz": 2.0}, "attitude_hz"),
        ({"commands_enabled": True, "time_sync_hz": 3.0}, "time_sync_hz.* max_round_trip_s"),
    ],
)
def test_contradicting_parameters_of_the_bridge_are_refused(values, word):
    with pytest.raises(ParameterError, match=word):
        MavlinkBridgeConfig(**values)


def test_watchdog_sends_the_fallback_commands_only_when_the_loop_hangs():
    sent, visible = [], False
    dog = Watchdog(sent.append, 0.2)
    assert dog.take_fired() == (False, False)
    commands = FallbackCommands("hold", "mode", lambda: visible, lambda: False)
    for i in range(20):
        dog.kick(0.05 * i, commands)
        dog.step(0.05 * i + 0.02)
    assert sent == []
    for i in range(200):
        visible = i > 100
        dog.step(0.95 + 0.05 * i)
        assert visible or "mode" not in sent
    assert sent[0] == "hold"
    assert sent.count("mode") == 1
    assert 50 < sent.count("hold") < 110  # ten times a second, for ten seconds
    assert dog.take_fired() == (True, True)
    assert dog.take_fired() == (False, False)
    sent.clear()
    dog.kick(30.0, None)
    dog.step(40.0)
    assert sent == []


def test_watchdog_sends_nothing_into_the_pilots_mode():
    sent, handed, left = [], [], False
    dog = Watchdog(sent.append, 0.2, handed.append)
    dog.kick(1.0, FallbackCommands("hold", "mode", lambda: False, lambda: left))
    for i in range(100):
        left = 50 <= i < 60  # and later the pilot's mode is the bridge's again: it was his to end this
        before = len(sent)
        dog.step(1.02 + 0.02 * i)
        assert i < 50 or len(sent) == before
    assert sent == ["hold"] * len(sent)
    assert sent
    assert handed == ["hold", None]  # the guardian is told


def test_watchdog_that_stood_still_with_its_loop_sends_no_outdated_position():
    sent = []
    dog = Watchdog(sent.append, 0.2)
    commands = FallbackCommands("hold", "mode", lambda: True, lambda: False)
    dog.kick(1.0, commands)
    dog.step(1.02)
    for i in range(100):  # stopped for three seconds, and the loop is not back yet
        dog.step(4.02 + 0.02 * i)
    assert sent == []
    dog.kick(6.1, commands)
    dog.step(6.12)
    for i in range(20):
        dog.step(6.14 + 0.02 * i)
    assert sent[0] == "hold"  # and watches again afterwards


def test_both_acknowledgements_of_a_mode_count():
    queue = CommandQueue()
    queue.request(SET_MODE, PX4.mode_parameters("OFFBOARD"), "mode OFFBOARD", 0.0)
    queue.due(0.0)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 0.05)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_DENIED, 0.07)
    assert queue.failure(SET_MODE) == "mode OFFBOARD: denied"
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 0.1)  # a refusal stays
    assert queue.failure(SET_MODE) == "mode OFFBOARD: denied"
    queue.cancel_all()
    queue.request(SET_MODE, PX4.mode_parameters("OFFBOARD"), "mode OFFBOARD", 3.0)
    queue.due(3.0)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 3.05)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, 3.07)
    assert queue.failure(SET_MODE) == "mode OFFBOARD: rejected for now"
    assert len(queue.due(3.6)) == 1  # asked again
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 3.65)
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 3.67)
    assert (queue.failure(SET_MODE), queue.due(4.5)) == ("", [])
    queue.acknowledge(SET_MODE, mavlink.MAV_RESULT_FAILED, 9.0)  # too late for this request
    assert queue.failure(SET_MODE) == ""


def test_a_setpoint_that_does_not_leave_is_no_part_of_the_stream(monkeypatch):
    """A stream that was interrupted does not resume by itself: the first setpoint would restore OFFBOARD."""

    def unplugged(data):
        raise LinkError("unplugged")

    sender = link()
    monkeypatch.setattr(sender._transport, "write", unplugged)
    for _ in range(3):
        sender.send_motion(halt_message(sender.mav, (1, 1)))
    assert len(sender.sent_setpoints()) == 1  # the one at which the link broke


def test_the_settings_are_those_of_the_autopilot_that_is_heard_now():
    channel, receiver = Channel(lambda: 10.0), link()
    receiver._transport = LoopbackTransport(channel, Channel(lambda: 10.0))
    channel.delay_s = 0.0
    vehicle = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for autopilot, name in ((3, "GUID_TIMEOUT"), (12, "COM_OF_LOSS_T")):
        for packet in (
            vehicle.heartbeat_encode(2, autopilot, 129, 4, 4),
            vehicle.param_value_encode(name.encode(), 0.5, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0),
        ):
            channel.write(packet.pack(vehicle))
        receiver.spin_once()
        assert receiver.settings.loss_settings()[:2] == (name, 0.5)


def test_the_packets_of_each_stream_are_numbered_one_by_one():
    """An autopilot and a router count what is lost by these numbers."""
    packer, message = Packer(1, 191, None, 0, 0), mavlink.MAVLink(None).ping_encode(0, 0, 1, 1)
    numbers = [packer.pack(message, 10**18 + i, 0)[4] for i in range(600)]
    assert numbers == [i % 256 for i in range(600)]
