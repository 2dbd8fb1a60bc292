"""Signed MAVLink both ways, and what a forger can do."""

import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import halt_message
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.parser import MavlinkParser, read_signing_key, sign_with, signing_time
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from lab.simulation.path_vehicle import PathVehicle, orbit_path

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
NOW_NS = 1_800_000_000_000_000_000


@pytest.fixture
def key_file(tmp_path):
    file = tmp_path / "key"
    file.write_text(KEY.hex() + "\n")
    return str(file)


def states_within(link, vehicle, seconds):
    vehicle.start()
    end, states = time.monotonic() + seconds, []
    while not states and time.monotonic() < end:
        states += link.spin_once(0.02)
    return states


def test_signed_link_works_with_the_same_key(key_file):
    port = free_udp_port()
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", signing_key_file=key_file, commands_enabled=True)
    with (
        MavlinkLink(config) as link,
        PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), signing_key=KEY) as vehicle,
    ):
        assert states_within(link, vehicle, 20)
        # The watchdog's words go to the vehicle too, again and again, though they are another stream.
        link.send_motion(halt_message(link.mav, link.target))
        for _ in range(3):
            link.send_unlocked(halt_message(link.mav, link.target))
        end = time.monotonic() + 5
        while vehicle.received.count("SET_POSITION_TARGET_LOCAL_NED") < 4 and time.monotonic() < end:
            link.spin_once(0.02)
        assert vehicle.received.count("SET_POSITION_TARGET_LOCAL_NED") == 4
        assert link.status().refused_count == 0


@pytest.mark.parametrize("key", [OTHER, None], ids=["another key", "no key"])
def test_packets_without_our_key_are_refused_in_both_directions(key_file, key):
    port = free_udp_port()
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}", signing_key_file=key_file)
    with (
        MavlinkLink(config) as link,
        PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), "px4", signing_key=key) as vehicle,
    ):
        assert states_within(link, vehicle, 1.5) == []
        assert not link.status().connected
        assert link.status().refused_count > 3
        assert vehicle.received == []  # we answer only whom we believe


def test_signing_vehicle_refuses_an_unsigned_link():
    port = free_udp_port()
    config = MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{port}")
    with (
        MavlinkLink(config) as link,
        PathVehicle(f"udpout:127.0.0.1:{port}", orbit_path(60), "px4", signing_key=KEY) as vehicle,
    ):
        assert states_within(link, vehicle, 20)  # its own stream of attitude comes, and is not checked
        for _ in range(20):
            link.spin_once(0.02)
        assert vehicle.received == []


def signed(key, now_ns, link_id=0, count=1):
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    sign_with(mav, key, now_ns, link_id)
    return [bytes(mav.attitude_encode(i, 0, 0, 0, 0, 0, 0).pack(mav)) for i in range(count)]


def test_replayed_and_old_packets_are_refused():
    parser = MavlinkParser(KEY, NOW_NS)
    first, second = signed(KEY, NOW_NS, count=2)
    assert len(parser.feed(first)) == len(parser.feed(second)) == 1
    assert parser.feed(first) == parser.feed(second) == []
    (old,) = signed(KEY, NOW_NS - 120 * 10**9, link_id=5)  # a stream that was recorded two minutes ago
    assert parser.feed(old) == []
    assert parser.refused_count == parser.bad_count == 3


def test_forged_packet_does_not_lock_the_vehicle_out():
    parser = MavlinkParser(KEY, NOW_NS)
    good = signed(KEY, NOW_NS, count=3)
    assert parser.feed(good[0])
    for stamp_ns in (NOW_NS + 10**18, NOW_NS + 10**9):
        assert parser.feed(*signed(OTHER, stamp_ns)) == []
    assert parser.feed(good[1])
    assert parser.feed(b"\xfd\xff\x01" + bytes(200)) == []
    assert parser.feed(bytes(100)) == []
    assert parser.feed(good[2])


def test_signatures_survive_a_clock_that_is_unset_or_goes_back(key_file):
    times = iter([0, 0, 0, NOW_NS, NOW_NS - 10**12, *[NOW_NS] * 50])
    sent = []

    class Wire:
        def write(self, data):
            sent.append(data)

    config = MavlinkBridgeConfig(signing_key_file=key_file, commands_enabled=True)
    link = MavlinkLink(config, lambda: next(times), monotonic_s=lambda: 0.0, transport=Wire())
    for _ in range(3):
        link.send_motion(halt_message(link.mav, (1, 1)))
    stamps = [int.from_bytes(packet[-12:-6], "little") for packet in sent]
    assert stamps[0] < stamps[1] < stamps[2]
    assert stamps[1] >= signing_time(NOW_NS)


@pytest.mark.parametrize(
    "text", ["", "abc", "00" * 31, "00" * 33, "zz" * 32, "00" * 32 + "\n" + "11" * 32], ids=range(6)
)
def test_file_without_a_key_is_refused(tmp_path, text):
    file = tmp_path / "key"
    file.write_text(text)
    with pytest.raises(InputError, match="64 hexadecimal digits") as error:
        read_signing_key(str(file))
    assert "\n" not in str(error.value)
    assert not text or text.strip() not in str(error.value)  # what may be a secret is never told


def test_unreadable_key_file_is_refused(tmp_path):
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(InputError, match="signing_key_file: expected a file"):
            MavlinkLink(MavlinkBridgeConfig(signing_key_file=str(path)))
