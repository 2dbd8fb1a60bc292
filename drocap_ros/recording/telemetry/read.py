"""Reads a telemetry log in any supported format: MAVLink, PX4, ArduPilot, DJI, Airdata, GPX, GoPro."""

from __future__ import annotations

from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.file_kind import unpacking
from drocap_ros.recording.telemetry import airdata, dataflash, djmd, gpx, srt, tlog, ulog
from drocap_ros.recording.telemetry.log import LogFormat, TelemetryLog

#: A format is one module and its entry here.
FORMATS = (
    *(ulog.FORMAT, dataflash.FORMAT, dataflash.TEXT_FORMAT, srt.FORMAT, airdata.FORMAT, djmd.FORMAT, tlog.FORMAT),
    gpx.FORMAT,
)
#: Ends of the names of logs beside a video.
LOG_SUFFIXES = tuple(f.suffix for f in FORMATS if f.suffix)


def read_telemetry(path: str | Path) -> TelemetryLog:
    """Read a log; the first bytes select the format, else the suffix.

    path : of the file; ``FILE#NAME`` or ``FILE#vehicle=NAME,mount=NAME`` chooses one of several in it
    """
    path, choice = split_choice(Path(path))
    try:
        with path.open("rb") as file:
            head = file.read(16)
        suffix = path.suffix.lower()
        fitting = [f for f in FORMATS if f.begins(head)] or [f for f in FORMATS if f.suffix and f.suffix == suffix]
        if not fitting:
            raise InputError(
                f"{path}: expected a telemetry log ({', '.join(LOG_SUFFIXES)}, DJI video), found another"
                f"{unpacking(path)}"
            )
        return fitting[0].read(path, **_keywords(path, choice, fitting[0]))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable telemetry log; {error.strerror}") from None


def split_choice(path: Path) -> tuple[Path, str]:
    """File and choice of ``FILE#CHOICE``."""
    name, sign, choice = path.name.rpartition("#")
    return (path.with_name(name), choice) if sign and name and not path.exists() else (path, "")


def _keywords(path: Path, choice: str, form: LogFormat) -> dict[str, str]:
    pairs = [part.rpartition("=")[::2] for part in choice.split(",")] if choice else []
    found = {key or "".join(form.chooses[:1]): name for key, name in pairs}
    if unknown := [f"{key}={name}" for key, name in found.items() if key not in form.chooses]:
        kinds = " or ".join(f"#{kind}=NAME" for kind in form.chooses) or "no choice"
        raise InputError(
            f"{path}: expected {kinds} after this log's name, found #{unknown[0].lstrip('=')}; leave it out"
        )
    return found
