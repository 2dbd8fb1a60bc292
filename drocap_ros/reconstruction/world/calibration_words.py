"""What the adjustment found out about the telemetry, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Standard deviations from zero at which a correction is stated.
_CLEAR = 2.0


def telemetry_words(meta: Mapping[str, Any]) -> str:
    """One to three sentences for the meta data of a motion; "" where no telemetry was adjusted."""
    rejected = meta.get("telemetry_rejected")
    if isinstance(rejected, str):
        return f"Telemetry not used: {rejected}."
    windows = meta.get("calibration")
    if not isinstance(windows, list) or not windows or not isinstance(windows[0], Mapping):
        return ""
    try:
        return _calibration(windows[0])
    except (KeyError, TypeError, ValueError, IndexError):
        return ""  # written by hand or by another version


def _calibration(found: Mapping[str, Any]) -> str:
    tilt, yaw, roll = (float(v) for v in found["misalignment_deg"])
    spread = [float(v) for v in found["misalignment_std_deg"]]
    facts = [
        _correction("gimbal pitch", tilt, spread[0], "deg"),
        _correction("gimbal yaw", yaw, spread[1], "deg"),
        _correction("gimbal roll", roll, spread[2], "deg"),
        _correction(
            "attitude's stamps", 1e3 * float(found["attitude_latency_s"]),
            1e3 * float(found["attitude_latency_std_s"]), "ms",
        ),
        _correction(
            "position's stamps", 1e3 * float(found["position_latency_s"]),
            1e3 * float(found["position_latency_std_s"]), "ms",
        ),
    ]  # fmt: skip
    stated = [fact for fact in facts if fact]
    scale = f"scale known to {100 * float(found['scale_std']):.1f} %"
    feet = f"feet in contact for {100 * float(found['contact_share']):.0f} % of the time"
    corrections = ", ".join(stated) if stated else "no error of the telemetry is clear"
    still = (
        ""
        if found.get("camera_moves", True)
        else "; the reported camera never moves: it is fixed, or its log is frozen"
    )
    return f"{corrections[0].upper()}{corrections[1:]}; {scale}, {feet}{still}."


def _correction(name: str, value: float, std: float, unit: str) -> str:
    digits = 0 if unit == "ms" else 1
    clear = abs(value) > _CLEAR * std
    return f"{name} corrected by {value:.{digits}f} +- {std:.{digits}f} {unit}" if clear else ""
