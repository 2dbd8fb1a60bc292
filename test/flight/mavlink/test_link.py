import contextlib
import fcntl
import itertools
import math
import os
import random
import socket
import threading
import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError, ParameterError
from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import TELEMETRY
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.parser import MavlinkParser
from drocap_ros.flight.mavlink.telemetry_request import TelemetryRequests
from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.simulation.vehicle.mavlink_vehicle import HOME
from lab.simulation.path_vehicle import PathVehicle, orbit_path

S = 1_000_000_000
_TIOCGEXCL = 0x80045440  # ioctl of Linux: whether a terminal is used exclusively


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def spin_until(link, predicate, timeout_s=20.0):
    states, end = [], time.monotonic() + timeout_s
    while not predicate(states):
        assert time.monotonic() < end, f"not reached in {timeout_s} s: {link.status()}"
        states += link.spin_once(0.05)
    return states


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_state_of_a_simulated_vehicle(port, autopilot):
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", rate_window_s=1.0)
    path = orbit_path(60)
    with MavlinkLink(config) as link, PathVehicle(f"udpout:127.0.0.1:{port}", path, autopilot) as vehicle:
        start_ns = time.time_ns()
        vehicle.start()
        states = spin_until(
            link, lambda s: len(s) > 30 and np.isfinite(s[-1].gimbal_orientation_xyzw).all() and s[-1].position_ok
        )
        state = states[-1]
        t = (state.stamp_ns - start_ns) * 1e-9
        truth = path.at(t)
        # The vehicle's time 0 lies a little after start_ns.
        assert np.linalg.norm(state.position_enu_m - truth.position_enu_m) < 0.5
        assert np.linalg.norm(np.linalg.norm(state.position_enu_m[:2]) - 6.0) < 0.02
        assert abs(state.orientation_xyzw @ truth.orientation_xyzw) > 0.995
        turned = camera_rotation(state.gimbal_orientation_xyzw) @ camera_rotation(truth.gimbal_orientation_xyzw).T
        assert np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1))) < 5
        assert np.allclose(state.angular_velocity_flu_rad_s, [0, 0, np.deg2rad(25)], atol=1e-6)
        assert (state.autopilot, state.armed, state.landed_state) == (autopilot, True, 2)
        assert state.mode == {"ardupilot": "GUIDED", "px4": "OFFBOARD"}[autopilot]
        assert abs(state.latitude_deg - HOME[0]) < 1e-4
        assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(states))
        assert set(vehicle.received) <= TELEMETRY
        status = link.status()
        assert status.connected
        assert status.round_trip_s < 0.5
        assert status.refused == {}


def test_wanted_rates_arrive(port):
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", attitude_hz=40.0, position_hz=10.0, rate_window_s=1.0)
    with MavlinkLink(config) as link, PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60)) as vehicle:
        vehicle.start()
        end = time.monotonic() + 2.5
        spin_until(link, lambda _: time.monotonic() > end)
        rates = link.status().rates_hz
    assert math.isclose(rates["ATTITUDE_QUATERNION"][0], 40, rel_tol=0.2)
    assert math.isclose(rates["LOCAL_POSITION_NED"][0], 10, rel_tol=0.3)


def test_acknowledged_rate_that_does_not_arrive_is_requested_again(port):
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", rate_window_s=1.0, request_retry_s=0.2)
    with (
        MavlinkLink(config) as link,
        PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), max_rate_hz=3) as slow,
    ):
        slow.start()
        end = time.monotonic() + 3.0
        spin_until(link, lambda _: time.monotonic() > end)
        real, wanted = link.status().rates_hz["ATTITUDE_QUATERNION"]
        assert real < 5 < wanted
        assert slow.received.count("COMMAND_LONG") > 8


def test_state_without_a_gimbal_has_unknown_orientation(port):
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}")
    with MavlinkLink(config) as link, PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), gimbal=False) as v:
        v.start()
        states = spin_until(link, lambda s: s and link.status().refused)
        assert link.status().refused == {"GIMBAL_DEVICE_ATTITUDE_STATUS": mavlink.MAV_RESULT_DENIED}
        assert np.isnan(states[-1].gimbal_orientation_xyzw).all()


def test_link_recovers_after_a_loss(port):
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", link_timeout_s=0.5)
    with MavlinkLink(config) as link:
        assert not link.status().connected
        with PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60)) as vehicle:
            vehicle.start()
            spin_until(link, lambda s: len(s) > 3)
        spin_until(link, lambda _: not link.status().connected)
        assert link.estimator.snapshot(time.time_ns()).link_age_s > 0.4
        with PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), boot_s=2.0) as vehicle:  # restarted
            vehicle.start()
            states = spin_until(link, lambda s: len(s) > 20)
        assert abs(states[-1].stamp_ns - time.time_ns()) < S


def test_link_thread_delivers_states_and_stops(port):
    states, stop = [], threading.Event()
    with MavlinkLink(MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}")) as link:
        thread = threading.Thread(target=link.run, args=(states.append, stop))
        thread.start()
        with PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60)) as vehicle:
            vehicle.start()
            end = time.monotonic() + 20
            while len(states) < 5 and time.monotonic() < end:
                time.sleep(0.02)
        stop.set()
        thread.join(2)
        assert not thread.is_alive()
    assert len(states) >= 5


def test_link_over_tcp(port):
    server = socket.create_server(("127.0.0.1", 0))
    url = f"tcp:127.0.0.1:{server.getsockname()[1]}"
    with MavlinkLink(MavlinkBridgeConfig(url=url)) as link:
        peer, _ = server.accept()
        mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        peer.sendall(
            mav.heartbeat_encode(2, 3, 129, 5, 4).pack(mav) + mav.attitude_encode(500, 0, 0, 0, 0, 0, 0).pack(mav)
        )
        assert spin_until(link, lambda s: s)[0].mode == "LOITER"
        parser, heard = MavlinkParser(), []
        peer.settimeout(2)
        while "COMMAND_LONG" not in heard:
            heard += [m.get_type() for m in parser.feed(peer.recv(4096))]
            link.spin_once(0.01)
        peer.close()  # the link breaks: it reports and tries again, it does not raise
        for _ in range(20):
            assert link.spin_once(0.01) == []
        peer, _ = server.accept() if _accepts(server, link) else (None, None)
        assert peer is not None
        peer.close()
    server.close()


def _accepts(server, link):
    import select

    end = time.monotonic() + 10
    while time.monotonic() < end:
        link.spin_once(0.05)
        if select.select([server], [], [], 0)[0]:
            return True
    return False


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp",
        "udp:localhost",
        "udpin:localhost:0",
        "udpin:localhost:99999",
        "udpin:localhost:x",
        "http://localhost:1",
        "serial:",
        "tcp:localhost:-5",
    ],
)
def test_malformed_url_is_refused(url):
    with pytest.raises(InputError, match=r"^url: expected") as error:
        open_transport(url)
    assert "\n" not in str(error.value)


def test_address_that_cannot_be_opened_is_refused(port):
    with open_transport_guard(f"udpin:127.0.0.1:{port}"), pytest.raises(InputError, match="can be opened"):
        open_transport(f"udpin:127.0.0.1:{port}")
    with pytest.raises(InputError, match="can be opened"):
        open_transport(f"tcp:127.0.0.1:{port}")
    with pytest.raises(InputError, match="serial"):
        open_transport("serial:/dev/does-not-exist:57600")


def test_a_serial_port_has_one_owner_and_a_dead_bridges_guardian_is_waited_for():
    autopilot, device = os.openpty()
    url = f"serial:{os.ttyname(device)}:57600"
    first = open_transport(url)
    with pytest.raises(InputError, match=r"can be opened.*(lock|busy)"):
        open_transport(url)
    assert fcntl.ioctl(device, _TIOCGEXCL, bytes(4)) == b"\1\0\0\0"  # programs that heed no lock are refused too
    shared = os.dup(first.port()[0])
    first.close()
    ends = threading.Timer(0.5, os.close, [shared])
    ends.start()
    second = open_transport(url)
    ends.join()
    assert second.write(b"heartbeat")
    assert os.read(autopilot, 100) == b"heartbeat"
    second.close()
    os.close(autopilot)
    os.close(device)


class open_transport_guard:  # noqa: N801
    def __init__(self, url):
        self.transport = open_transport(url)

    def __enter__(self):
        return self.transport

    def __exit__(self, *_):
        self.transport.close()


@pytest.mark.parametrize(
    "change", [{"system_id": 255}, {"system_id": 0}, {"component_id": 0}, {"attitude_hz": -1.0}, {"control_hz": 5.0}]
)
def test_bridge_parameters_out_of_range_are_refused(change):
    with pytest.raises(ParameterError):
        MavlinkBridgeConfig(**change)


_NAMES = (
    "heartbeat", "attitude", "attitude_quaternion", "local_position_ned", "global_position_int", "gps_raw_int",
    "sys_status", "ekf_status_report", "gimbal_device_attitude_status", "mount_orientation", "timesync", "command_ack",
)  # fmt: skip


def packets(rng):
    """Valid packets with senseless values."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for name in rng.choices(_NAMES, k=60):
        kind = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name.upper()}")]
        values = {}
        for field, form in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            number = rng.randrange(0, 127)
            if form == "float":
                number = rng.choice([math.nan, math.inf, 0.0, rng.uniform(-1e3, 1e3), rng.uniform(-1, 1)])
            values[field] = [number, 0, 0, 0] if field in ("q", "repr_offset_q") else number
        values.pop("mavlink_version", None)
        yield getattr(mav, name + "_encode")(**values).pack(mav)


def test_mutated_and_random_bytes_raise_nothing(port):
    rng = random.Random(5)
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with MavlinkLink(MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}")) as link:
        for _ in range(40):
            for packet in packets(rng):
                data = bytearray(packet)
                kind = rng.randrange(4)
                if kind == 1:
                    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
                elif kind == 2:
                    data = data[: rng.randrange(1, len(data))]
                elif kind == 3:
                    data = bytearray(rng.randbytes(rng.randrange(1, 300)))
                out.sendto(data, ("127.0.0.1", port))
            for state in link.spin_once(0.0):
                assert np.isfinite(state.orientation_xyzw).all()
            while link.spin_once(0.0):
                pass
        # And the link still works.
        mav = mavlink.MAVLink(
            None, srcSystem=link.estimator.system_id or 1, srcComponent=link.estimator.component_id or 1
        )
        for i in range(400):
            out.sendto(mav.heartbeat_encode(2, 3, 129, 5, 4).pack(mav), ("127.0.0.1", port))
            out.sendto(
                mav.attitude_quaternion_encode(10**6 + 20 * i, 1, 0, 0, 0, 0, 0, 0).pack(mav), ("127.0.0.1", port)
            )
            if link.spin_once(0.01):
                break
        else:
            pytest.fail("the link no longer works")
    out.close()


@pytest.mark.parametrize("component", [100, 154, 191, 25, 1])
def test_setpoints_go_to_the_autopilot_whoever_else_of_its_system_talks_from_another_port(port, component):
    """A camera, a gimbal, a companion, a servo, a program with its own ids: each sends between its messages."""
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", commands_enabled=True)
    theirs = mavlink.MAVLink(None, srcSystem=1, srcComponent=component)
    autopilots = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
        MavlinkLink(config) as link,
    ):
        for sender in (other, autopilot):
            sender.setblocking(False)

        def send(sender, mav, message):
            sender.sendto(message.pack(mav), ("127.0.0.1", port))
            link.spin_once(0.05)

        for i in range(50):
            send(other, theirs, theirs.heartbeat_encode(30, 8, 0, 0, 4))
            if i % 10 == 0:
                send(autopilot, autopilots, autopilots.heartbeat_encode(2, 3, 129, 4, 4))
            send(autopilot, autopilots, autopilots.attitude_quaternion_encode(10**6 + 20 * i, 1, 0, 0, 0, 0, 0, 0))
            send(other, theirs, theirs.gimbal_device_attitude_status_encode(1, 0, 20 * i, 0, [1, 0, 0, 0], 0, 0, 0, 0))
            link.send_motion(
                link.mav.set_position_target_local_ned_encode(0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
            )
        received = dict.fromkeys((other, autopilot), 0)
        for sender in received:
            with contextlib.suppress(BlockingIOError):
                while data := sender.recv(2048):
                    received[sender] += sum(
                        m.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for m in MavlinkParser(None, 0).feed(data)
                    )
        assert received == {other: 0, autopilot: 50}


def test_link_refuses_to_send_motion(port):
    with MavlinkLink(MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}")) as link:
        mav = mavlink.MAVLink(None)
        with pytest.raises(AssertionError, match="sends no"):
            link._send(mav.set_position_target_local_ned_encode(0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
        with pytest.raises(AssertionError, match="sends no"):
            link._send(mav.command_long_encode(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0))


def test_requests_are_sent_one_at_a_time_until_the_rate_is_measured():
    config = MavlinkBridgeConfig(rate_window_s=1.0, request_retry_s=0.5)
    requests = TelemetryRequests(config)
    requests.set_autopilot(autopilot_of("px4"))
    asked = []
    for i in range(20):
        asked += [number for number, _ in requests.due(i * S // 100)]
        requests.acknowledge(0, i * S // 100)
    assert len(asked) == len(set(asked)) == 8
    assert mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS in asked
    q = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
    for i in range(100):
        requests.count(q, S + i * S // 50)
    later = [number for i in range(20) for number, _ in requests.due(3 * S + i)]
    assert q not in later
    assert len(later) == 7  # all others never came
    assert requests.rate_hz(q, 3 * S) == pytest.approx(50, rel=0.05)


def test_heartbeats_go_on_where_the_simulated_time_goes_back(port):
    """A looped recording, a simulator that is reset."""
    now_s, sent = [600.0], []
    with MavlinkLink(MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}"), monotonic_s=lambda: now_s[0]) as link:
        link._transmit = sent.append
        for now_s[0] in (600.0, 600.5, 10.0, 10.5, 11.1):
            link.spin_once()
    assert len(sent) == 3
