"""What the adjustment found out about the telemetry, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from drocap_ros.reconstruction.world.world_model import MEASURED

#: Wander of the reported position (m) and attitude (degrees) that is stated: twice that of good telemetry.
_WANDER_M = 0.1
_WANDER_DEG = 0.2


def telemetry_words(meta: Mapping[str, Any]) -> str:
    """A sentence for the meta data of a motion; "" where no telemetry was adjusted."""
    rejected = meta.get("telemetry_rejected")
    if isinstance(rejected, str):
        return f"Telemetry not used: {rejected}."
    camera, windows = meta.get("camera"), meta.get("calibration")
    try:
        if cuts_s := meta.get("cuts_s"):
            cuts = ", ".join(f"{cut:.1f}" for cut in cuts_s)
            return f"Cut at {cuts} s: no camera belongs to the whole clip; give one scene (--start, --end)."
        if isinstance(camera, Mapping):
            return _camera(camera)
        if not isinstance(windows, list) or not windows or not isinstance(windows[0], Mapping):
            return ""
        return _calibrations(windows, meta.get("assumed_height_m"))
    except (KeyError, TypeError, ValueError, IndexError, ZeroDivisionError):
        return ""  # written by hand or by another version


def _camera(camera: Mapping[str, Any]) -> str:
    """The camera that the picture alone gave."""
    words = f"Camera from the picture: {camera.get('words', 'unknown')}"
    if camera.get("residual_px"):
        share = 100 * camera["covered"]
        words += f"; fixed points {camera['residual_px']:.1f} px off, enough of them in {share:.0f} % of the images"
    if "up_std_deg" in camera:
        words += f"; up by {camera['up_words']}, to {camera['up_std_deg']:.1f} deg; metres by the assumed stature"
    if camera.get("focal_std_px"):
        words += f"; focal length {camera['focal_px']:.0f} +- {camera['focal_std_px']:.0f} px"
    return f"{words}."


def _calibrations(windows: list[Mapping[str, Any]], height_m: float | None) -> str:
    """The worst of each fact over the windows of a long recording."""
    corrections = _causes(windows) or ", ".join(_corrections(windows)) or "no error of the telemetry is clear"
    scale = f"scale known to {100 * max(w['scale_std'] for w in windows):.1f} %"
    feet = f"feet in contact for {100 * min(w['contact_share'] for w in windows):.0f} % of the time"
    worst = f" (worst of {len(windows)} windows)" if len(windows) > 1 else ""
    rest = f"{worst}{_points(windows)}{_path(windows)}{_stature(windows, height_m)}."
    return f"{corrections[0].upper()}{corrections[1:]}; {scale}, {feet}{rest}"


def _causes(windows: list[Mapping[str, Any]]) -> str:
    """The single error, or those that points cannot distinguish, that explain most of what the points correct."""
    causes = windows[0].get("causes") or []
    named = [f"{c['cause']} corrected by {_size(c['size'], c['std'], c['unit'])}" for c in causes]
    if not named:
        return ""
    share = f"explains {100 * causes[0]['explains']:.0f} % of what the points contradict"
    doubt = "; the points cannot distinguish them" if len(named) > 1 else ""
    return f"{' or '.join(named)} {share}{doubt}"


def _corrections(windows: list[Mapping[str, Any]]) -> list[str]:
    turned = [(w["misalignment_deg"], w["misalignment_std_deg"]) for w in windows]
    facts = [
        _correction(f"gimbal {name}", [(v[axis], std[axis]) for v, std in turned], "deg")
        for axis, name in enumerate(("pitch", "yaw", "roll"))
    ]
    facts += [
        _correction(
            f"{name}'s stamps",
            [(1e3 * w[f"{name}_latency_s"], 1e3 * w[f"{name}_latency_std_s"]) for w in windows],
            "ms",
        )
        for name in ("attitude", "position")
    ]
    return [fact for fact in facts if fact]


def _points(windows: list[Mapping[str, Any]]) -> str:
    """What fixed points of the picture say about the reported path; the same in all windows."""
    seen = windows[0].get("background")
    if not isinstance(seen, Mapping):
        return ""
    words = f"; measured by {seen['tracks']} tracks of fixed points, {seen['residual_px']:.1f} px off"
    wander = [
        f"{name} by {seen[key]:.{digits}f} {unit}"
        for name, key, digits, unit, least in (
            ("position", "position_wander_m", 1, "m", _WANDER_M),
            ("attitude", "attitude_wander_deg", 1, "deg", _WANDER_DEG),
        )
        if seen[key] > least
    ]
    if (share := seen.get("contradicted_share", 0.0)) > 0.02:
        words += f"; for {100 * share:.0f} % of the time most lie elsewhere: they move, or the log is wrong there"
    if windows[0].get("causes"):  # the wander is what other terms take of that error
        return words
    return words + (f"; against them the reported pose wanders, {' and '.join(wander)}" if wander else "")


def _path(windows: list[Mapping[str, Any]]) -> str:
    """Whether the reported camera stands, or its position jumps."""
    words, stop_s = "", max(w.get("camera_stops_s", 0.0) for w in windows)
    if not any(w.get("camera_moves", True) for w in windows):
        words = "; the reported camera never moves: it is fixed, or its log is frozen"
    elif stop_s > 0:
        words = f"; the reported camera stands still for {stop_s:.1f} s: it hovers, or its log is frozen"
    if jump := max(w.get("camera_jumps_m", 0.0) for w in windows):
        words += f"; the reported position jumps by {jump:.1f} m: cut the recording there (--start, --end)"
    return words


def _correction(name: str, found: list[tuple[float, float]], unit: str) -> str:
    value, std = max(found, key=lambda v: abs(v[0]) / v[1])
    # 95 of 100 errors of nothing are smaller than two standard deviations.
    return f"{name} corrected by {_size(value, std, unit)}" if abs(value) > 2.0 * std else ""


def _size(value: float, std: float, unit: str) -> str:
    digits = 0 if unit == "ms" else 1
    return f"{value:.{digits}f} +- {std:.{digits}f} {unit}"


def _stature(windows: list[Mapping[str, Any]], height_m: float | None) -> str:
    """Whether a measured scale makes the person taller or shorter than people are expected to be."""
    off = [math.log(w["scale"]) / w["stature_std"] for w in windows if w["scale_std"] < MEASURED and "stature_std" in w]
    worst = max(off, key=abs, default=0.0)
    # Three standard deviations: one person in 370.
    if abs(worst) < 3.0:
        return ""
    size = max((w["scale"] for w in windows if w["scale_std"] < MEASURED), key=lambda v: abs(math.log(v)))
    person = "the assumed one" if height_m is None else f"the assumed {height_m:.2f} m"
    return (
        f"; the person measures {size:.2f} times {person}, {abs(worst):.0f} standard deviations off: check the lens, "
        "the log and assumed_height_m"
    )
