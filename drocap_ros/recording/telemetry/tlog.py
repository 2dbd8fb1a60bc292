"""States of the vehicle from a MAVLink ``.tlog``, through the estimator of the live link."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import LogFormat, TelemetryLog, make_log

if TYPE_CHECKING:
    from pymavlink.dialects.v20.ardupilotmega import MAVLink_message

#: UTC in ns from which a time is one of a clock that was set (2001); a ground station without one starts at 1970.
_MIN_UTC_NS = 1_000_000_000 * 10**9
#: Latest time of a packet, us: the year 2100; a later one is damage.
_LATEST_US = 4_102_444_800_000_000
#: First bytes of a packet of MAVLink 1 and 2, https://mavlink.io/en/guide/serialization.html.
_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD  # of MAVLink 2
#: Bytes read at once.
_CHUNK = 1 << 20


def read_tlog(path: Path) -> TelemetryLog:
    """Attitude, position and gimbal of the first autopilot in the log, by the ground station's clock."""
    from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator

    estimator, rows = VehicleStateEstimator(), []
    for message, received_ns in tlog_messages(path):
        try:
            state = estimator.update(message, received_ns)
        except (ArithmeticError, ValueError):  # a damaged message that decodes nevertheless
            continue
        if state is not None:
            rows.append((state.stamp_ns, state.position_enu_m, state.orientation_xyzw, state.gimbal_orientation_xyzw))
    if not rows:
        raise InputError(f"{path}: expected the attitude of an autopilot, found none; was ATTITUDE streamed?")
    stamps, position, body, gimbal = map(np.array, zip(*rows, strict=True))
    log = make_log(path, "MAVLink tlog", stamps, [], orientation=body, position=position, gimbal=gimbal)
    return log._replace(utc_minus_stamp_ns=0 if stamps[0] > _MIN_UTC_NS else None)


def tlog_messages(path: Path) -> Iterator[tuple[MAVLink_message, int]]:
    """Messages of a log with their times of reception, ns; damaged parts are skipped."""
    from drocap_ros.flight.mavlink.parser import MavlinkParser

    parser, found = MavlinkParser(), False
    with path.open("rb") as file:
        for stamp_us, packet in _packets(file):
            for message in parser.feed(packet):
                found = True
                yield message, stamp_us * 1000
    if not found:
        raise InputError(f"{path}: expected a MAVLink telemetry log, found no message in it; is it a .tlog?")


def _packets(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """(time us, packet); in the file each packet follows its time, a big-endian 64-bit number."""
    data, place = b"", 0
    while True:
        length = _packet_length(data, place)
        if length is None:
            more = file.read(_CHUNK)
            if not more:
                return
            data, place = data[place:] + more, 0
        elif length == 0:
            place += 1
        else:
            yield struct.unpack_from(">Q", data, place)[0], data[place + 8 : place + 8 + length]
            place += 8 + length


def _packet_length(data: bytes, place: int) -> int | None:
    """Length of the packet whose time is at ``place``; 0 when there is none, None when more data is needed."""
    if len(data) < place + 8 + 3:
        return None
    stamp_us = struct.unpack_from(">Q", data, place)[0]
    magic, payload, flags = data[place + 8], data[place + 9], data[place + 10]
    if not 0 < stamp_us < _LATEST_US or magic not in (_MAGIC_V1, _MAGIC_V2):
        return 0
    length = payload + (8 if magic == _MAGIC_V1 else 12 + (13 if flags & 1 else 0))
    return length if len(data) >= place + 8 + length else None


FORMAT = LogFormat(".tlog", read_tlog)
