"""Bytes to MAVLink messages and back: the parser, whose input never raises, signatures, and CURRENT_MODE."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError
from drocap_ros.flight.mavlink.commands import Message


class CurrentMode(mavlink.MAVLink_message):
    """CURRENT_MODE (message 436), which pymavlink 2.4.50 does not have, as its generator would write it.

    An autopilot that refuses an interval for HEARTBEAT may grant one for this message, which it sends twice a second
    and after every change: a mode of the pilot is seen after one interval, not after the second between two heartbeats.
    Source: MAVLink's common.xml, https://mavlink.io/en/messages/common.html#CURRENT_MODE.

    standard_mode : MAV_STANDARD_MODE, 0 = none of them
    custom_mode : as in HEARTBEAT
    intended_custom_mode : the mode that was chosen last, and that the vehicle may enter as soon as it can; 0 = unknown
    """

    id = 436  # as the next ones, by MAVLink's definition
    msgname = "CURRENT_MODE"
    fieldnames = ("standard_mode", "custom_mode", "intended_custom_mode")
    orders = (2, 0, 1)  # of the fields in the payload, which has the longest first
    lengths = (1, 1, 1)
    crc_extra = 193
    unpacker = struct.Struct("<IIB")

    def __init__(self, standard_mode: int, custom_mode: int, intended_custom_mode: int) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self.standard_mode = standard_mode
        self.custom_mode = custom_mode
        self.intended_custom_mode = intended_custom_mode

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The packet's bytes by this encoder; its sequence number is not advanced."""
        payload = self.unpacker.pack(self.custom_mode, self.intended_custom_mode, self.standard_mode)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


mavlink.mavlink_map.setdefault(CurrentMode.id, CurrentMode)  # a later pymavlink has its own


def read_signing_key(path: str) -> bytes:
    """32 bytes from a file of 64 hexadecimal digits.  Error messages never contain the content of the file."""
    file = Path(path).expanduser()
    remedy = "write one by `openssl rand -hex 32`, and give the autopilot the same"
    try:
        with file.open("rb") as opened:
            # A key's file has 64 digits.
            text = opened.read(1025)
    except OSError as error:
        raise InputError(
            f"signing_key_file: expected a file that can be read, got {path!r}: {error.strerror}; {remedy}"
        ) from None
    digits = text.strip()
    if not re.fullmatch(rb"[0-9a-fA-F]{64}", digits):
        raise InputError(
            f"signing_key_file: expected 64 hexadecimal digits (32 bytes) and nothing else in {path!r}, "
            f"found {len(digits)} bytes of something else; {remedy}"
        )
    return bytes.fromhex(digits.decode("ascii"))


def signing_time(now_ns: int) -> int:
    """Time of a signature: 10 us since 2015; 0 from a clock that was never set."""
    # Signing counts from 2015-01-01, in units of 10 us.
    return max((now_ns - 1_420_070_400_000_000_000) // 10_000, 0)


def sign_with(mav: mavlink.MAVLink, key: bytes, now_ns: int, link_id: int = 0) -> None:
    """Make an encoder or parser sign its packets, and refuse packets that are not signed with this key."""
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = True
    mav.signing.link_id = link_id
    mav.signing.timestamp = signing_time(now_ns)


class Packer:
    """Our messages as packets of one stream; with a key it signs them.

    Signed packets of one stream must not go back in time, so whoever shares no lock with the others has its own.

    system, component : our ids
    key : of 32 bytes
    now_ns : our clock
    link_id : of the stream
    """

    def __init__(self, system: int, component: int, key: bytes | None, now_ns: int, link_id: int) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            sign_with(self.mav, key, now_ns, link_id)

    def pack(self, message: Message, now_ns: int, heard: int) -> bytes:
        """The packet; its signature is never earlier than the last one, nor than ``heard``, when others signed."""
        signing = self.mav.signing
        signing.timestamp = max(signing.timestamp, signing_time(now_ns), heard)
        packet = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return packet


class SigningMavlink(mavlink.MAVLink):
    """pymavlink's protocol object, except that a forged signature does not advance the time of its stream.

    Otherwise one forged packet with a time far ahead would make every later genuine packet outdated.
    """

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Whether the packet was signed with our key, later than the previous one."""
        stream = (msgbuf[-13], srcSystem, srcComponent)
        before = self.signing.stream_timestamps.get(stream)
        good = bool(super().check_signature(msgbuf, srcSystem, srcComponent))
        if not good:
            if before is None:
                self.signing.stream_timestamps.pop(stream, None)
            else:
                self.signing.stream_timestamps[stream] = before
        return good


class MavlinkParser:
    """Decodes a stream of bytes; counts what cannot be decoded.

    Pymavlink's largest dialect holds the common one of its time.  Messages that it does not have are no damage: a
    healthy autopilot sends two a second.

    key : 32 bytes; then messages without its signature count as bad
    now_ns : our clock at the beginning; a stream that is a minute behind it is a replayed recording

    Attributes
    ----------
    bad_count, refused_count : pieces of data that are no message; of these, whole messages without our signature
    unknown_count : messages whose number the dialect does not have; their checksum cannot be verified
    """

    def __init__(self, key: bytes | None = None, now_ns: int = 0) -> None:
        self._mav = self._fresh()
        if key is not None:
            sign_with(self._mav, key, now_ns)
        self.bad_count = self.refused_count = self.unknown_count = 0

    @property
    def signing(self) -> mavlink.MAVLinkSigning:
        """Pymavlink's state of the signatures: counts and times."""
        return self._mav.signing

    def feed(self, data: bytes) -> list[Message]:
        """Messages that these bytes complete; damaged ones are counted and left out."""
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # noqa: BLE001  the parser raises many kinds on damaged packets; none may reach the flight loop
            signing = self._mav.signing
            self._mav = self._fresh()
            self._mav.signing = signing
            self.bad_count += 1
            return []
        good = []
        for message in found:
            name = message.get_type()
            if name.startswith("UNKNOWN"):
                self.unknown_count += 1
            elif name == "BAD_DATA":
                self.bad_count += 1
                self.refused_count += message.reason == "Invalid signature"
            else:
                good.append(message)
        return good

    @staticmethod
    def _fresh() -> SigningMavlink:
        mav = SigningMavlink(None)
        mav.robust_parsing = True
        return mav
