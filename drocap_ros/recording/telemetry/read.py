"""Reads a telemetry log in any supported format: MAVLink, PX4, ArduPilot, DJI, Airdata."""

from __future__ import annotations

from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry import airdata, dataflash, djmd, srt, tlog, ulog
from drocap_ros.recording.telemetry.log import TelemetryLog

#: A format is one module and its entry here.
FORMATS = (ulog.FORMAT, dataflash.FORMAT, srt.FORMAT, airdata.FORMAT, djmd.FORMAT, tlog.FORMAT)
#: Ends of the names of logs beside a video.
LOG_SUFFIXES = tuple(f.suffix for f in FORMATS if f.suffix)


def read_telemetry(path: str | Path) -> TelemetryLog:
    """Read a log; the first bytes select the format, else the suffix."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(16)
        suffix = path.suffix.lower()
        fitting = [f for f in FORMATS if f.begins(head)] or [f for f in FORMATS if f.suffix and f.suffix == suffix]
        if not fitting:
            raise InputError(
                f"{path}: expected a telemetry log ({', '.join(LOG_SUFFIXES)}, DJI video), found another; check it"
            )
        return fitting[0].read(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable telemetry log; {error.strerror}") from None
