import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from drocap_ros.flight.mavlink.parser import CurrentMode, MavlinkParser, sign_with

NUMBERS = st.integers(0, 2**32 - 1)
OFFBOARD = 6 << 16


def encoder():
    return mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def test_checksum_byte_follows_from_the_definition():
    text = "CURRENT_MODE uint32_t custom_mode uint32_t intended_custom_mode uint8_t standard_mode "
    crc = x25crc(text.encode("ascii")).crc
    assert (crc & 0xFF) ^ (crc >> 8) == CurrentMode.crc_extra == 193


def test_bytes_of_a_real_packet_decode():
    # Header, then custom mode OFFBOARD, intention OFFBOARD, standard mode 0 (its zeros are cut off), checksum.
    body = bytes([7, 0, 0, 0, 1, 1, 436 & 0xFF, 436 >> 8, 0]) + bytes([0, 0, 6, 0, 0, 0, 6])
    packet = b"\xfd" + body + x25crc(body + bytes([193])).crc.to_bytes(2, "little")
    (got,) = MavlinkParser().feed(packet)
    assert (got.get_type(), got.get_msgId()) == ("CURRENT_MODE", CurrentMode.id)
    assert (got.custom_mode, got.intended_custom_mode, got.standard_mode) == (OFFBOARD, OFFBOARD, 0)
    assert (got.get_srcSystem(), got.get_srcComponent()) == (1, 1)


@given(st.integers(0, 255), NUMBERS, NUMBERS)
def test_values_survive_the_wire(standard, custom, intended):
    (got,) = MavlinkParser().feed(CurrentMode(standard, custom, intended).pack(encoder()))
    assert (got.standard_mode, got.custom_mode, got.intended_custom_mode) == (standard, custom, intended)


def test_signed_packets_are_checked():
    key, now = bytes(range(32)), 1_700_000_000_000_000_000
    signer, forger = encoder(), encoder()
    sign_with(signer, key, now)
    sign_with(forger, bytes(32), now)
    parser = MavlinkParser(key, now)
    assert parser.feed(CurrentMode(0, OFFBOARD, OFFBOARD).pack(forger)) == []
    assert parser.feed(CurrentMode(0, OFFBOARD, OFFBOARD).pack(encoder())) == []
    assert parser.refused_count == 2
    assert len(parser.feed(CurrentMode(0, OFFBOARD, OFFBOARD).pack(signer))) == 1


@pytest.mark.parametrize("seed", range(20))
def test_damaged_packets_are_dropped_and_the_next_one_is_read(seed):
    chance = random.Random(seed)
    parser, mav = MavlinkParser(), encoder()
    for _ in range(50):
        packet = bytearray(CurrentMode(chance.randrange(256), chance.randrange(2**32), OFFBOARD).pack(mav))
        if chance.random() < 0.5:
            damaged = bytes(packet[: chance.randrange(1, len(packet))])
        else:
            place = chance.randrange(7, len(packet))  # the header stays that of this message
            packet[place] ^= chance.randrange(1, 256)
            damaged = bytes(packet)
        assert [m for m in parser.feed(damaged) if m.get_type() == "CURRENT_MODE"] == []
        parser.feed(b"\0" * 300)  # ends a torn packet
    (got,) = parser.feed(CurrentMode(0, OFFBOARD, 0).pack(mav))
    assert got.custom_mode == OFFBOARD
