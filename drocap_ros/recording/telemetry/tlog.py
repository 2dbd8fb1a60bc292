"""States of the vehicle from a MAVLink ``.tlog``, through the estimator of the live link."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import Lack, LogFormat, LogLack, TelemetryLog, choose, make_log

if TYPE_CHECKING:
    from pymavlink.dialects.v20.ardupilotmega import MAVLink_message

#: UTC in ns from which a time is one of a clock that was set (2001); a ground station without one starts at 1970.
_MIN_UTC_NS = 1_000_000_000 * 10**9
#: First bytes of a packet of MAVLink 1 and 2, https://mavlink.io/en/guide/serialization.html.
_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD  # of MAVLink 2
#: Bytes of a packet and its time.
_LARGEST = 300
#: Bytes read at once.
_CHUNK = 1 << 20


#: MAVLink's numbers of messages with an attitude, of the body and of a mount.
_ATTITUDES = (30, 31)
_GIMBAL = 285  # GIMBAL_DEVICE_ATTITUDE_STATUS: each gimbal sends its own


def read_tlog(path: Path, *, vehicle: str = "", mount: str = "") -> TelemetryLog:
    """Attitude, position and gimbal of one autopilot in the log, by the ground station's clock.

    vehicle, mount : MAVLink's system, and component of its gimbal; empty: those with most messages
    """
    from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator

    system, component, lacks = _chosen(path, vehicle, mount)
    estimator, rows = VehicleStateEstimator(system), []
    for message, received_ns in tlog_messages(path):
        if message.get_type() == "GIMBAL_DEVICE_ATTITUDE_STATUS" and _gimbal_of(message) != component:
            continue
        try:
            state = estimator.update(message, received_ns)
        except (ArithmeticError, ValueError):  # a damaged message that decodes nevertheless
            continue
        if state is not None:
            rows.append((state.stamp_ns, state.position_enu_m, state.orientation_xyzw, state.gimbal_orientation_xyzw))
    if not rows:
        raise InputError(f"{path}: expected the attitude of an autopilot, found none; was ATTITUDE streamed?")
    stamps, position, body, gimbal = map(np.array, zip(*rows, strict=True))
    log = make_log(path, "MAVLink tlog", stamps, lacks, orientation=body, position=position, gimbal=gimbal)
    return log._replace(utc_minus_stamp_ns=0 if stamps[0] > _MIN_UTC_NS else None)


def _chosen(path: Path, vehicle: str, mount: str) -> tuple[int, int, list[LogLack]]:
    """System of the vehicle, 0 where none is known, component of its gimbal, and words on others."""
    from drocap_ros.flight.mavlink.parser import MavlinkParser

    attitudes, gimbals, parser = Counter[int](), Counter[tuple[int, int]](), MavlinkParser()
    used = 0
    with path.open("rb") as file:
        for _, packet in _packets(file):
            used += 8 + len(packet)
            newer = packet[0] == _MAGIC_V2
            kind = int.from_bytes(packet[7:10] if newer else packet[5:6], "little")
            if kind in _ATTITUDES:  # without the time that decoding takes
                attitudes[packet[5 if newer else 3]] += 1
            elif kind == _GIMBAL:
                gimbals.update((message.get_srcSystem(), _gimbal_of(message)) for message in parser.feed(packet))
    if not attitudes:
        return 0, 0, []
    # The last packet of a log may be cut off.
    lost = max(path.stat().st_size - used - _LARGEST, 0)
    damage = [LogLack(Lack.DAMAGED, f"{lost} bytes and more are no messages, left out")] * (lost > 0)
    system, lacks = choose(path, "vehicle", {str(s): n for s, n in sorted(attitudes.items())}, vehicle)
    own = {str(gimbal): n for (of, gimbal), n in sorted(gimbals.items()) if str(of) == system}
    component, more = choose(path, "mount", own, mount) if own or mount else ("0", [])
    return int(system), int(component), damage + lacks + more


def _gimbal_of(message: MAVLink_message) -> int:
    """Component of a gimbal, or the number under which an autopilot passes its messages on."""
    return getattr(message, "gimbal_device_id", 0) or message.get_srcComponent()


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
    # Latest time of a packet, us: the year 2100; a later one is damage.
    if not 0 < stamp_us < 4_102_444_800_000_000 or magic not in (_MAGIC_V1, _MAGIC_V2):
        return 0
    length = payload + (8 if magic == _MAGIC_V1 else 12 + (13 if flags & 1 else 0))
    return length if len(data) >= place + 8 + length else None


FORMAT = LogFormat(".tlog", read_tlog, chooses=("vehicle", "mount"))
