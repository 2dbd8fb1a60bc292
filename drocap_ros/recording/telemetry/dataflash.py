"""States of the vehicle from an ArduPilot DataFlash log, binary (``.bin``) or text, through pymavlink's reader."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.flight.vehicle import orientation_to_ros, quaternion_from_euler
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

    from pymavlink.DFReader import DFMessage

#: message -> fields used
_FIELDS = {
    "ATT": ("Roll", "Pitch", "Yaw"),
    "POS": ("Lat", "Lng", "Alt"),
    "GPS": ("Lat", "Lng", "Alt", "Status", "I"),
    "MNT": ("Roll", "Pitch", "YawE", "YawB", "I"),
}
_PARAMETER = "PARM"
#: ArduPilot's parameter for the kind of a mount, by its number from 1 on; of the first one also without a number.
_MOUNT_TYPE = re.compile(r"MNT(\d?)_TYPE")
#: ... for the mount of the first camera, from 1 on; 0 = the first.
_CAMERA_MOUNT = "CAM1_MNT_INST"


def read_dataflash(path: Path, *, mount: str = "") -> TelemetryLog:
    """Attitude (ATT), position (POS, else GPS) and mount (MNT) by time since power-up; UTC from the GPS.

    The angles of servos (``MNT1_TYPE`` is 1) are against the body, those of other mounts against horizon and north.

    mount : from 1 on; empty: the camera's by the autopilot's setting, else that with most states
    """
    content, lacks = _Content(), []
    try:
        # pymavlink prints remarks on damaged files.
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            for message in _messages(path):
                content.take(message)
    except Exception as error:  # noqa: BLE001  # pymavlink passes on any error of its parser
        if not content.rows["ATT"]:
            reason = first_line(error)
            raise InputError(f"{path}: expected an ArduPilot DataFlash log that can be read; {reason}") from None
        lacks.append(LogLack(Lack.DAMAGED, "read up to the damage"))
    if not content.rows["ATT"]:
        raise InputError(f"{path}: expected ATT messages of an ArduPilot log, found none; is it a DataFlash .bin?")
    stamp_ns, angles = content.series("ATT")
    body = quaternion_from_euler(*np.deg2rad(angles).T).T
    position, position_lacks = _position(content, stamp_ns)
    gimbal, gimbal_lacks = _gimbal(path, content, stamp_ns, body, mount)
    lacks += position_lacks + gimbal_lacks
    attitude, kind = orientation_to_ros(body), "ArduPilot DataFlash log"
    log = make_log(path, kind, stamp_ns, lacks, orientation=attitude, position=position, gimbal=gimbal)
    return log._replace(utc_minus_stamp_ns=int(np.median(content.utc_us)) * 1000 if content.utc_us else None)


class _Content:
    """Rows of the messages by name, each time us and the fields; differences of UTC and time since power-up, us."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in _FIELDS}
        self.utc_us: list[float] = []
        self.servos: set[int] = set()
        self.camera_mount = 0

    def take(self, message: DFMessage) -> None:
        name = message.get_type()
        if name == _PARAMETER:
            # The kind 1 is servos.
            if (mount := _MOUNT_TYPE.fullmatch(message.Name)) and message.Value == 1:
                self.servos.add(int(mount[1] or 1))
            elif message.Name == _CAMERA_MOUNT:
                self.camera_mount = int(message.Value)
            return
        values = (float(getattr(message, field, np.nan)) for field in _FIELDS[name])
        self.rows[name].append((float(message.TimeUS), *values))
        # UTC in s from which a time is one of a GPS (2001); before its first fix the reader counts from 1970.
        if name == "ATT" and message._timestamp > 1e9:
            self.utc_us.append(message._timestamp * 1e6 - message.TimeUS)

    def series(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (N,) ns and fields (N, C) of a message."""
        table = np.array(self.rows[name], dtype=np.float64)
        table = table[(table[:, 0] >= 0) & (table[:, 0] < 2**52)]
        return np.round(table[:, 0] * 1000).astype(np.int64), table[:, 1:]


def _position(content: _Content, stamp_ns: np.ndarray) -> tuple[np.ndarray | None, list[LogLack]]:
    for name in ("POS", "GPS"):
        if not content.rows[name]:
            continue
        known_ns, geodetic = content.series(name)
        lost = (geodetic[:, :2] == 0).all(axis=1) | (geodetic[:, 3:4] < FIX_3D).any(axis=1)
        geodetic[lost] = np.nan
        receivers = np.nan_to_num(geodetic[:, 4:]).ravel()  # whose places differ by metres
        if name == "GPS" and len(np.unique(receivers)) > 1:
            number = max(np.unique(receivers), key=lambda each: (receivers == each).sum())
            known_ns, geodetic = known_ns[receivers == number], geodetic[receivers == number]
        if (enu := from_first_fix(geodetic[:, :3])) is not None:
            return at_stamps(known_ns, enu, stamp_ns, spherical=False), [LogLack(Lack.LOCAL_POSITION, name)]
    return None, []


def _gimbal(
    path: Path, content: _Content, stamp_ns: np.ndarray, body: np.ndarray, wanted: str
) -> tuple[np.ndarray | None, list[LogLack]]:
    if not content.rows["MNT"]:
        return None, []
    known_ns, mount = content.series("MNT")
    numbers = np.nan_to_num(mount[:, _FIELDS["MNT"].index("I")]).astype(int) + 1
    found = {str(number): int((numbers == number).sum()) for number in np.unique(numbers)}
    own = str(content.camera_mount) if str(content.camera_mount) in found else ""
    number, lacks = choose(path, "mount", found, wanted or own)
    chosen, servos = numbers == int(number), int(number) in content.servos
    yaw = "YawB" if servos else "YawE"
    used = [_FIELDS["MNT"].index(field) for field in ("Roll", "Pitch", yaw)]
    camera = quaternion_from_euler(*np.deg2rad(mount[chosen][:, used]).T).T
    if not np.isfinite(camera).all(axis=1).any():
        return None, [*lacks, LogLack(Lack.MOUNT_YAW, f"MNT.{yaw}")]
    camera = at_stamps(known_ns[chosen], camera, stamp_ns, spherical=True)
    return orientation_to_ros(quaternion_multiply(body, camera) if servos else camera), lacks


def _messages(path: Path) -> Iterator[DFMessage]:
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    class Reader(DFReader_binary):  # type: ignore[misc]  # pymavlink has no types
        # The compiled index prints a line for every byte that it cannot parse.
        def init_arrays_fast(self, progress_callback: Callable[[float], None] | None = None) -> None:
            self.init_arrays(progress_callback=progress_callback)

    with path.open("rb") as file:
        binary = file.read(len(_HEAD)) == _HEAD
    log = (Reader if binary else DFReader_text)(str(path))
    try:
        while (message := log.recv_match(type=[*_FIELDS, _PARAMETER])) is not None:
            yield message
    finally:
        if binary:
            log.close()


_HEAD = b"\xa3\x95"
FORMAT = LogFormat(".bin", read_dataflash, magic=_HEAD + b"\x80", chooses=("mount",))
TEXT_FORMAT = LogFormat(".log", read_dataflash, magic=b"FMT, ", chooses=("mount",))
