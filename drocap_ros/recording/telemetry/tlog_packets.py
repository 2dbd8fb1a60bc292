"""Telemetry logs beside a video: so far MAVLink ``.tlog``."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drocap_ros.errors import InputError

_EARLIEST_US, _LATEST_US = 0, 4_102_444_800_000_000  # to the year 2100
_MAGIC_V1, _MAGIC_V2 = 0xFE, 0xFD
_CHUNK = 1 << 20


def read_tlog(path: str | Path) -> Iterator[tuple[Any, int]]:
    """Messages of a telemetry log with the time of their reception, ns.

    The file is read in pieces; damaged parts are skipped.

    Raises
    ------
    InputError
        When the file cannot be read or holds no MAVLink message.
    """
    from drocap_ros.flight.mavlink.parser import MavlinkParser

    path = Path(path)
    parser, found = MavlinkParser(), False
    try:
        with path.open("rb") as file:
            for stamp_us, packet in _packets(file):
                for message in parser.feed(packet):
                    found = True
                    yield message, stamp_us * 1000
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror}") from None
    if not found:
        raise InputError(f"{path}: expected a MAVLink telemetry log, found no message in it; is it a .tlog?")


def _packets(file: Any) -> Iterator[tuple[int, bytes]]:
    """(time us, packet): each packet stands behind its time as a big-endian 64-bit number."""
    data = b""
    while True:
        more = file.read(_CHUNK)
        data += more
        place = 0
        while True:
            length = _packet_length(data, place)
            if length is None:  # not enough data to tell
                break
            if length == 0:
                place += 1
                continue
            yield struct.unpack_from(">Q", data, place)[0], data[place + 8 : place + 8 + length]
            place += 8 + length
        data = data[place:]
        if not more:
            return


def _packet_length(data: bytes, place: int) -> int | None:
    """Length of the packet whose time stands at ``place``; 0 when there is none, None when data is missing."""
    if len(data) < place + 8 + 3:
        return None
    stamp_us = struct.unpack_from(">Q", data, place)[0]
    magic, payload, flags = data[place + 8], data[place + 9], data[place + 10]
    if not _EARLIEST_US < stamp_us < _LATEST_US or magic not in (_MAGIC_V1, _MAGIC_V2):
        return 0
    length = payload + (8 if magic == _MAGIC_V1 else 12 + (13 if flags & 1 else 0))
    return length if len(data) >= place + 8 + length else None
