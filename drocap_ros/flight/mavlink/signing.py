"""Signatures of MAVLink v2 packets: the file of the key, signing and checking by pymavlink."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError

_EPOCH_NS = 1_420_070_400_000_000_000  # 2015-01-01, from which signing counts in units of 10 us
_UNIT_NS = 10_000
_LONGEST_FILE = 1024


def read_signing_key(path: str) -> bytes:
    """32 bytes from a file of 64 hexadecimal digits.  Error messages never contain the content of the file.

    Raises
    ------
    InputError
    """
    file = Path(path).expanduser()
    remedy = "write one by `openssl rand -hex 32`, and give the autopilot the same"
    try:
        with file.open("rb") as opened:
            text = opened.read(_LONGEST_FILE + 1)
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
    return max((now_ns - _EPOCH_NS) // _UNIT_NS, 0)


def sign_with(mav: Any, key: bytes, now_ns: int, link_id: int = 0) -> None:
    """Make an encoder or parser sign its packets, and refuse packets that are not signed with this key."""
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = True
    mav.signing.link_id = link_id
    mav.signing.timestamp = signing_time(now_ns)


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
