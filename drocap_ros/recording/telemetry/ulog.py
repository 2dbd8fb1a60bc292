"""States of the vehicle from a PX4 ULog, through ``pyulog``."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.flight.vehicle import ned_to_enu, orientation_to_ros, yaw_of
from drocap_ros.geometry.rotations import quaternion_multiply
from drocap_ros.recording.telemetry.log import (
    FIX_3D,
    Lack,
    LogFormat,
    LogLack,
    TelemetryLog,
    at_stamps,
    choose,
    from_first_fix,
    make_log,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from pyulog import ULog

#: Fields of a topic by name, each (N,).
_Data = dict[str, np.ndarray]

#: Bytes before the first message; kinds of messages (https://docs.px4.io/main/en/dev_log/ulog_file_format.html).
_HEAD_BYTES = 16
_KINDS, _DATA = frozenset(bytes([kind]) for kind in b"FBIMPQARDLCSO"), ord("D")
_GPS = ("vehicle_gps_position", "sensor_gps")
_GIMBAL = "gimbal_device_attitude_status"
_TOPICS = ("vehicle_attitude", "vehicle_local_position", "vehicle_global_position", _GIMBAL, *_GPS)
#: MAVLink's GIMBAL_DEVICE_FLAGS_YAW_LOCK, _YAW_IN_VEHICLE_FRAME and _YAW_IN_EARTH_FRAME.
_YAW_LOCK = 16
_YAW_IN_VEHICLE = 32  # bit of the flags, as the next
_YAW_IN_EARTH = 64  # bit


def read_ulog(path: Path, *, mount: str = "") -> TelemetryLog:
    """Attitude (``vehicle_attitude``), position and gimbal by time since power-up; UTC from the GPS.

    mount : number of the gimbal's topic, from 0 on; empty: that with most states
    """
    from pyulog import ULog

    whole, damaged = _whole_messages(path.read_bytes())
    try:
        # pyulog prints remarks on damaged files.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            log = ULog(io.BytesIO(whole), list(_TOPICS), disable_str_exceptions=True)
    except Exception as error:  # noqa: BLE001  # pyulog passes on any error of its parser
        raise InputError(f"{path}: expected a PX4 ULog that can be read; {first_line(error)}") from None
    try:
        found = _to_log(path, log, mount)
    except (KeyError, IndexError, ValueError) as error:  # a damaged definition: fields are missing or of other types
        raise InputError(f"{path}: expected the fields of PX4's topics, found a damaged log ({error})") from None
    if damaged or log.file_corruption:
        found = found._replace(lacks=(*found.lacks, LogLack(Lack.DAMAGED, "states about the damage are missing")))
    return found


def _whole_messages(data: bytes) -> tuple[bytes, bool]:
    """A log without what lies between its whole messages, and whether there was any: pyulog ends at a wrong length.

    Behind damage the next place counts from which some messages follow each other.
    """
    kept, lengths, damaged = [data[:_HEAD_BYTES]], dict[bytes, int](), False

    def end_of(place: int) -> int:
        """End of the message at a place, 0 where none stands there."""
        size, end = int.from_bytes(data[place : place + 2], "little"), 0
        if data[place + 2 : place + 3] in _KINDS and place + 3 + size <= len(data):
            of_topic = lengths.get(data[place + 3 : place + 5], size) if data[place + 2] == _DATA else size
            end = place + 3 + size if size == of_topic else 0
        return end

    place = _HEAD_BYTES
    while place + 3 <= len(data):
        end = end_of(place)
        if not end:
            damaged = True
            place = next((p for p in range(place + 1, len(data)) if _follow(end_of, p, len(data))), len(data))
            continue
        if data[place + 2] == _DATA:
            lengths.setdefault(data[place + 3 : place + 5], end - place - 3)
        kept.append(data[place:end])
        place = end
    return b"".join(kept), damaged or place != len(data)


def _follow(end_of: Callable[[int], int], place: int, end: int) -> bool:
    """Whether messages follow each other from a place on, or to the end."""
    for _ in range(4):  # behind damage
        if place == end:
            break
        place = end_of(place)
        if not place:
            return False
    return True


def _to_log(path: Path, ulog: ULog, mount: str) -> TelemetryLog:
    topics: dict[str, dict[str, _Data]] = {}
    for data in sorted(ulog.data_list, key=lambda data: int(data.multi_id)):
        if "timestamp" in data.data:
            topics.setdefault(data.name, {})[str(data.multi_id)] = data.data
    series: dict[str, _Data] = {}
    lacks = [LogLack(Lack.DROPOUTS, str(len(ulog.dropouts)))] if ulog.dropouts else []
    for name, instances in topics.items():
        states = {number: len(data["timestamp"]) for number, data in instances.items()}
        what, wanted = ("mount", mount) if name == _GIMBAL else (name, "")
        number, more = choose(path, what, states, wanted)
        series[name] = instances[number]
        lacks += more if name == _GIMBAL else []
    if mount and _GIMBAL not in topics:
        raise InputError(f"{path}#{mount}: expected a log with mounts, found none; leave the choice out")
    attitude = series.get("vehicle_attitude")
    if attitude is None or not len(attitude["timestamp"]):
        raise InputError(f"{path}: expected vehicle_attitude in the ULog, found none; log it")
    stamp_ns = _stamps(attitude)
    frd_to_ned = _quaternion(attitude, "q")
    position, position_lacks = _position(series, stamp_ns)
    lacks += position_lacks
    body, gimbal = orientation_to_ros(frd_to_ned), _gimbal(series, stamp_ns, frd_to_ned)
    log = make_log(path, "PX4 ULog", stamp_ns, lacks, orientation=body, position=position, gimbal=gimbal)
    return log._replace(utc_minus_stamp_ns=_utc(series))


def _position(series: dict[str, _Data], stamp_ns: np.ndarray) -> tuple[np.ndarray | None, list[LogLack]]:
    """(N, 3) m ENU: the estimator's local position where valid, else its global one, else the GPS's."""
    local = series.get("vehicle_local_position")
    ned = _local(local) if local else np.zeros((0, 3))
    if local and np.isfinite(ned).all(axis=1).any():
        return at_stamps(_stamps(local), ned_to_enu(ned), stamp_ns, spherical=False), []
    for name, read in (("vehicle_global_position", _global), *((name, _gps) for name in _GPS)):
        geodetic = read(series[name]) if name in series else None
        enu = None if geodetic is None else from_first_fix(geodetic)
        if enu is not None:
            position = at_stamps(_stamps(series[name]), enu, stamp_ns, spherical=False)
            return position, [LogLack(Lack.LOCAL_POSITION, name)]
    return None, []


def _local(data: _Data) -> np.ndarray:
    ned = np.stack([data[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for flag, columns in (("xy_valid", [0, 1]), ("z_valid", [2])):
        if flag in data:
            ned[np.ix_(data[flag] == 0, columns)] = np.nan
    return ned


def _global(data: _Data) -> np.ndarray | None:
    return np.stack([data[name] for name in ("lat", "lon", "alt")], axis=1).astype(np.float64)


def _gps(data: _Data) -> np.ndarray | None:
    if "lat" in data:
        geodetic = np.stack([data["lat"] * 1e-7, data["lon"] * 1e-7, data["alt"] * 1e-3], axis=1).astype(np.float64)
    elif "latitude_deg" in data:
        columns = ("latitude_deg", "longitude_deg", "altitude_msl_m")
        geodetic = np.stack([data[name] for name in columns], axis=1).astype(np.float64)
    else:
        return None
    geodetic[np.asarray(data["fix_type"]) < FIX_3D] = np.nan
    return geodetic


def _gimbal(series: dict[str, _Data], stamp_ns: np.ndarray, frd_to_ned: np.ndarray) -> np.ndarray | None:
    """(N, 4) camera FLU -> ENU; the yaw of a gimbal that follows the vehicle is relative to its nose."""
    status = series.get(_GIMBAL)
    if status is None or not len(status["timestamp"]):
        return None
    camera = at_stamps(_stamps(status), _quaternion(status, "q"), stamp_ns, spherical=True)
    flags = np.asarray(status.get("device_flags", np.zeros(len(status["timestamp"]), int))).astype(int)
    nearest = flags[np.clip(np.searchsorted(_stamps(status), stamp_ns), 0, len(flags) - 1)]
    earth = (nearest & _YAW_IN_EARTH > 0) | (
        (nearest & (_YAW_IN_EARTH | _YAW_IN_VEHICLE) == 0) & (nearest & _YAW_LOCK > 0)
    )
    turn, half = np.zeros((len(stamp_ns), 4)), 0.5 * yaw_of(frd_to_ned)
    turn[:, 2], turn[:, 3] = np.sin(half), np.cos(half)
    return orientation_to_ros(np.where(earth[:, None], camera, quaternion_multiply(turn, camera)))


def _utc(series: dict[str, _Data]) -> int | None:
    for name in _GPS:
        gps = series.get(name)
        if gps is None or "time_utc_usec" not in gps:
            continue
        utc_us = np.asarray(gps["time_utc_usec"], dtype=np.int64)
        # UTC in us from which a time is one of a GPS (2001).
        known = utc_us > 1_000_000_000_000_000
        if known.any():
            return int(np.median((utc_us - np.asarray(gps["timestamp"], np.int64))[known])) * 1000
    return None


def _stamps(data: _Data) -> np.ndarray:
    return np.asarray(data["timestamp"], dtype=np.int64) * 1000


def _quaternion(data: _Data, name: str) -> np.ndarray:
    """(N, 4) x y z w of PX4's w x y z."""
    return np.stack([np.asarray(data[f"{name}[{i}]"], np.float64) for i in (1, 2, 3, 0)], axis=1)


FORMAT = LogFormat(".ulg", read_ulog, magic=b"ULog\x01\x12\x35", chooses=("mount",))
