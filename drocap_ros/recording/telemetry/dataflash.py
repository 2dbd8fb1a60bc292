"""States of the vehicle from an ArduPilot DataFlash log (``.bin``), through pymavlink's reader."""

from __future__ import annotations

import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import geodetic_to_enu, orientation_to_ros, quaternion_from_euler, quaternion_multiply
from drocap_ros.flight.mavlink.mount import SERVOS, TYPE_PARAMETER
from drocap_ros.recording.telemetry.log import Lack, LogLack, TelemetryLog, at_stamps, make_log

_EARLIEST_UTC_S = 1e9
#: message -> fields used
_FIELDS = {
    "ATT": ("Roll", "Pitch", "Yaw"),
    "POS": ("Lat", "Lng", "Alt"),
    "MNT": ("Roll", "Pitch", "YawE", "YawB"),
}
_PARAMETER = "PARM"


def read_dataflash(path: Path) -> TelemetryLog:
    """Attitude (ATT), position (POS) and mount (MNT) by time since power-up; UTC from the GPS.

    The angles of servos (``MNT1_TYPE`` is 1) are against the body, those of other mounts against horizon and north.

    Raises
    ------
    InputError
        When the file cannot be read, is no DataFlash log, or holds no attitude.
    """
    with path.open("rb") as file:
        if file.read(2) != b"\xa3\x95":
            raise InputError(f"{path}: expected an ArduPilot DataFlash log, found other content at its start")
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in _FIELDS}
    utc_us: list[float] = []
    lacks: list[LogLack] = []
    servos = False
    try:
        # pymavlink prints remarks on damaged files.
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            for message in _messages(path):
                name = message.get_type()
                if name == _PARAMETER:
                    servos = message.Value == SERVOS if message.Name == TYPE_PARAMETER else servos
                    continue
                values = tuple(float(getattr(message, field, np.nan)) for field in _FIELDS[name])
                rows[name].append((float(message.TimeUS), *values))
                if name == "ATT" and message._timestamp > _EARLIEST_UTC_S:
                    utc_us.append(message._timestamp * 1e6 - message.TimeUS)
    except Exception as error:  # pymavlink passes on any error of its parser
        if not rows["ATT"]:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: expected an ArduPilot DataFlash log that can be read; {reason}") from None
        lacks.append(LogLack(Lack.DAMAGED))
    if not rows["ATT"]:
        raise InputError(f"{path}: expected ATT messages of an ArduPilot log, found none; is it a DataFlash .bin?")
    stamp_ns, angles = _series(rows["ATT"])
    body = quaternion_from_euler(*np.deg2rad(angles).T).T
    position = gimbal = None
    if rows["POS"]:
        known_ns, geodetic = _series(rows["POS"])
        fixed = (geodetic[:, 0] != 0) | (geodetic[:, 1] != 0)
        if fixed.any():
            enu = geodetic_to_enu(geodetic, geodetic[fixed][0])
            position = at_stamps(known_ns[fixed], enu[fixed], stamp_ns, spherical=False)
            lacks.append(LogLack(Lack.LOCAL_POSITION, "POS"))
    if rows["MNT"]:
        known_ns, mount = _series(rows["MNT"])
        yaw = "YawB" if servos else "YawE"
        used = [_FIELDS["MNT"].index(field) for field in ("Roll", "Pitch", yaw)]
        camera = quaternion_from_euler(*np.deg2rad(mount[:, used]).T).T
        if np.isfinite(camera).all(axis=1).any():
            camera = at_stamps(known_ns, camera, stamp_ns, spherical=True)
            gimbal = orientation_to_ros(quaternion_multiply(body, camera) if servos else camera)
        else:
            lacks.append(LogLack(Lack.MOUNT_YAW, f"MNT.{yaw}"))
    return make_log(
        path,
        "ArduPilot DataFlash log",
        stamp_ns,
        orientation=orientation_to_ros(body),
        position=position,
        gimbal=gimbal,
        utc_minus_stamp_ns=int(np.median(utc_us)) * 1000 if utc_us else None,
        lacks=tuple(lacks),
    )


def _messages(path: Path) -> Any:
    from pymavlink.DFReader import DFReader_binary

    class Reader(DFReader_binary):
        # The compiled index prints a line for every byte that it cannot parse.
        def init_arrays_fast(self, progress_callback: Any = None) -> None:
            self.init_arrays(progress_callback=progress_callback)

    log = Reader(str(path))
    try:
        while (message := log.recv_match(type=[*_FIELDS, _PARAMETER])) is not None:
            yield message
    finally:
        log.close()


def _series(rows: list[tuple[float, ...]]) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(rows, dtype=np.float64)
    table = table[(table[:, 0] >= 0) & (table[:, 0] < 2**52)]
    return np.round(table[:, 0] * 1000).astype(np.int64), table[:, 1:]
