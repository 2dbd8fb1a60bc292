"""Reads a telemetry log in any supported format.

MAVLink .tlog, PX4 .ulg, ArduPilot .bin, DJI .srt, Airdata .csv, and the djmd track inside a video of DJI.
"""

from __future__ import annotations

from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import TelemetryLog

#: Names of logs beside a video.
LOG_SUFFIXES = (".tlog", ".ulg", ".bin", ".srt", ".csv")


def read_telemetry(path: str | Path) -> TelemetryLog:
    """Read a log; the first bytes select the format, else the suffix.

    Raises
    ------
    InputError
        When the file is missing, of an unknown format, or holds no attitude and no position.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable telemetry log; {error.strerror}") from None
    suffix = path.suffix.lower()
    if head.startswith(b"ULog\x01\x12\x35") or suffix == ".ulg":
        from drocap_ros.recording.telemetry.ulog import read_ulog as read
    elif head.startswith(b"\xa3\x95\x80") or suffix == ".bin":
        from drocap_ros.recording.telemetry.dataflash import read_dataflash as read
    elif suffix == ".srt":
        from drocap_ros.recording.telemetry.srt import read_srt as read
    elif suffix == ".csv":
        from drocap_ros.recording.telemetry.airdata import read_airdata as read
    elif head[4:8] == b"ftyp":
        from drocap_ros.recording.telemetry.djmd.reader import read_djmd as read
    elif suffix == ".tlog":
        from drocap_ros.recording.telemetry.tlog import read_tlog as read
    else:
        raise InputError(
            f"{path}: expected a telemetry log (.tlog, .ulg, .bin, .srt, .csv, DJI video), found another; check it"
        )
    return read(path)
