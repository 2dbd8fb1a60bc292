"""Checks of what is configured: permission, limits that contradict each other, camera, picture, body."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.findings import Finding, Level
from drocap_ros.flight.observed import Motion
from drocap_ros.flight.orbit_goal import goal_of
from drocap_ros.flight.subject.framing import Framing, View, orbit_margin
from drocap_ros.flight.vehicle_state import VehicleState

_C = ConditionCode
_EDGE = 0.04
_WIND_LEAN_M_S2 = 0.9  # a copter of this size leans by 5 deg against 8 m/s
_SIDEWAYS_RAD = 1.5
_DRIVER, _STREAM_DELAY_S = "/dev/video", 0.1
_LEAST_PX, _GOOD_PX = 80.0, 150.0
_WALK_M_S = 1.4
_MEASURED_SIZE_ERROR = 0.05
_LEAST_ROOM_M = 10.0


class Setup(NamedTuple):
    """The configuration around the bridge's own.

    camera_matrix : (3, 3) px; None = unknown
    image_size : width, height px
    camera_words : where the camera matrix comes from; without one, why
    calibrated : whether it was measured, not stated
    source : of the images
    assumed_height_m : of the initializer
    models : where the networks are; "" = none found
    models_remedy : then
    """

    camera_matrix: np.ndarray | None
    image_size: tuple[int, int]
    camera_words: str
    calibrated: bool
    source: str
    assumed_height_m: float
    models: str
    models_remedy: str = ""


class Fit(NamedTuple):
    """Rows of a person in the picture: of the head, of the feet, and the difference, px from the top."""

    head_px: float
    feet_px: float
    height_px: float


def setup_findings(config: MavlinkBridgeConfig, setup: Setup, vehicle: VehicleState | None = None) -> Iterator[Finding]:
    """Everything that can be checked without a vehicle, and with one the picture of a mount that nothing points."""
    yield _permission(config)
    yield from _limits(config)
    yield _source(setup)
    yield from _camera(config, setup, vehicle)
    yield _latency(config, setup)
    yield from _body(config, setup)


def _permission(config: MavlinkBridgeConfig) -> Finding:
    allowed = config.commands_enabled
    return Finding(
        "commands_enabled", "permission to fly", Level.OK if allowed else Level.MISSING,
        f"commands_enabled is {str(allowed).lower()}", "true",
        "" if allowed else "set commands_enabled to true when you have read docs/flight.md", {},
        (_C.COMMANDS_DISABLED,),
    )  # fmt: skip


def _limits(config: MavlinkBridgeConfig) -> Iterator[Finding]:
    """Limits that are allowed one by one and hinder each other."""
    omega = abs(math.radians(config.angular_speed_deg_s))
    speed = omega * config.radius_m
    problems = []
    room = config.fence_radius_m - config.radius_m - speed**2 / (2 * config.braking_m_s2)
    if room < _LEAST_ROOM_M:
        problems.append((f"the fence leaves the subject {max(room, 0):.0f} m to walk", "widen fence_radius_m"))
    if config.max_speed_m_s < speed + _WALK_M_S:
        problems.append((
            f"max_speed_m_s {config.max_speed_m_s:g} leaves {config.max_speed_m_s - speed:.1f} m/s to follow a walk of "
            f"{_WALK_M_S:g}", "raise max_speed_m_s, or fly slower",
        ))  # fmt: skip
    braking_s = config.max_speed_m_s / config.braking_m_s2
    if config.blind_hold_s < 0.9 * braking_s:
        problems.append((
            f"blind_hold_s {config.blind_hold_s:g} is shorter than braking from max_speed_m_s, {braking_s:.1f} s",
            "raise blind_hold_s, or lower max_speed_m_s",
        ))  # fmt: skip
    found = f"orbit of {config.radius_m:g} m, {config.height_m:g} m high, {speed:.1f} m/s"
    yield Finding(
        "limits", "limits", Level.WARNING if problems else Level.OK,
        "; ".join([found, *(words for words, _ in problems)]), "limits that leave room for each other",
        "; ".join(remedy for _, remedy in problems), {"speed_m_s": speed, "room_m": room},
    )  # fmt: skip


def _source(setup: Setup) -> Finding:
    remedies = []
    if not setup.source:
        remedies.append("set image_ingest.source to the camera")
    if not setup.models:
        remedies.append(setup.models_remedy)
    return Finding(
        "perception", "pictures and networks", Level.MISSING if remedies else Level.OK,
        f"{setup.source or 'no source'}, {'networks in ' + setup.models if setup.models else 'no networks'}",
        "a camera, a detector and a pose network", "; ".join(remedies),
        {"source": setup.source, "models": setup.models}, (_C.NO_SUBJECT,),
    )  # fmt: skip


def _camera(config: MavlinkBridgeConfig, setup: Setup, vehicle: VehicleState | None) -> Iterator[Finding]:
    if setup.camera_matrix is None:
        yield Finding(
            "camera", "camera", Level.MISSING, setup.camera_words, "a calibration, or a field of view",
            "set image_ingest.calibration_file (ROS camera_calibration), or at least horizontal_fov_deg", {},
            (_C.NO_CAMERA_INFO,),
        )  # fmt: skip
        return
    yield Finding(
        "camera", "camera", Level.OK if setup.calibrated else Level.WARNING, setup.camera_words, "a calibration",
        "" if setup.calibrated else "calibrate and set image_ingest.calibration_file: an error of the field of view is "
        "one of the range", {"fov_deg": _fov_deg(setup.camera_matrix, setup.image_size[0])},
    )  # fmt: skip
    yield _picture(config, setup, setup.camera_matrix, vehicle)


def _latency(config: MavlinkBridgeConfig, setup: Setup) -> Finding:
    """Whether the stamps of the pictures are the driver's; how late they are cannot be seen from here."""
    driver, stated_s = setup.source.startswith(_DRIVER), config.camera_latency_s
    stamps = f"stamps are {'' if driver else 'not '}the driver's"
    if stated_s > 0:
        return Finding(
            "camera_latency", "camera latency", Level.OK, f"{stated_s:g} s as stated; {stamps}", "measured or stated",
            "", {"source": setup.source, "camera_latency_s": stated_s},
        )  # fmt: skip
    aside_deg = abs(config.angular_speed_deg_s) * _STREAM_DELAY_S
    remedy = (
        f"use a camera on {_DRIVER}N, or a topic with stamps of the exposure, or measure the delay and set "
        f"camera_latency_s: {_STREAM_DELAY_S:g} s late, a picture has the person {aside_deg:.1f} deg aside"
    )
    return Finding(
        "camera_latency", "camera latency", Level.OK if driver else Level.WARNING,
        f"not stated; {stamps}", "stamps of the exposure", "" if driver else remedy,
        {"source": setup.source, "camera_latency_s": stated_s},
    )  # fmt: skip


def _picture(config: MavlinkBridgeConfig, setup: Setup, matrix: np.ndarray, vehicle: VehicleState | None) -> Finding:
    """Whether the person fits into the picture, and how high it is there."""
    rows, aimed_deg = setup.image_size[1], -best_pitch_deg(config)
    framing = Framing(config)
    framing.matrix, framing.size = matrix, setup.image_size
    if config.mount != "fixed" and vehicle is not None:
        framing.watch(vehicle, Motion(), math.nan, 0.0)
    view = framing.view()
    pitch_deg = aimed_deg if view is None else math.degrees(view.pitch)
    fit = person_in_picture(config, matrix, -pitch_deg)
    level: Level = Level.OK
    remedies: list[str] = []
    if view is not None:
        level, remedies = _unaimed_camera(
            config, framing, view, _inside(fit, rows), vehicle.autopilot if vehicle else ""
        )
    elif not _inside(fit, rows):
        level = Level.MISSING
        remedies.append(f"fly at least {_least_radius_m(config, matrix, rows):.0f} m away, or use a wider lens")
    if fit.height_px < _GOOD_PX:
        level = max(level, Level.MISSING if fit.height_px < _LEAST_PX else Level.WARNING)
        remedies.append("fly closer, or raise width_px and height_px")
    how = "mount aims at the person"
    if view is not None:
        how = f"mount at {pitch_deg:.0f} deg" if view.level else f"camera fixed at {pitch_deg:g} deg"
    return Finding(
        "picture", "person in the picture", level,
        f"{fit.height_px:.0f} px high, rows {fit.head_px:.0f} to {fit.feet_px:.0f} of {rows} ({how})",
        f"inside the picture, {_GOOD_PX:.0f} px high", "; ".join(remedies),
        {"height_px": fit.height_px, "head_px": fit.head_px, "feet_px": fit.feet_px, "rows": rows,
         "pitch_deg": pitch_deg},
        (_C.PERSON_LEAVES_PICTURE,),
    )  # fmt: skip


def _unaimed_camera(
    config: MavlinkBridgeConfig, framing: Framing, view: View, inside: bool, autopilot: str
) -> tuple[Level, list[str]]:
    """As the bridge judges an orbit by a camera that nothing points: it leans with the body, or a mount keeps it."""
    goal = goal_of(config)
    refusal = framing.refusal(goal)
    if refusal is not None:
        return Level.MISSING, [str(refusal.values["remedy"])]
    if view.level:
        # Flown, with a part of the person cut off.
        remedy = f"set gimbal_control to true, or point the mount to {-best_pitch_deg(config):.0f} deg before the start"
        return (Level.OK, []) if inside else (Level.WARNING, [remedy])
    problems = []
    if orbit_margin(view, goal, config.body_height_m, _WIND_LEAN_M_S2) < 0:
        problems.append("a wind of 8 m/s would lean the person out of it: use a gimbal, or fly farther away")
    walker_m = framing.least_radius(goal, _WALK_M_S, autopilot_of(autopilot).gives_way_s)
    if walker_m > goal.radius_m:
        problems.append(
            f"about one who walks at {_WALK_M_S:g} m/s the orbit is flown at {walker_m:.1f} m, so that he stays in"
            " it: use a gimbal or a wider lens to fly nearer"
        )
    return (Level.WARNING if problems else Level.OK), problems


def person_in_picture(
    config: MavlinkBridgeConfig, matrix: np.ndarray, pitch_down_deg: float, radius_m: float | None = None
) -> Fit:
    """Rows of a standing person at the orbit's distance; infinite = beside or behind the camera.

    matrix : (3, 3) px
    pitch_down_deg : of the optical axis against the horizon
    radius_m : instead of the orbit's
    """
    distance = config.radius_m if radius_m is None else radius_m

    def row(height_m: float) -> float:
        angle = math.atan2(config.height_m - height_m, distance) - math.radians(pitch_down_deg)
        if abs(angle) > _SIDEWAYS_RAD:
            return math.copysign(math.inf, angle)
        return float(matrix[1, 2] + matrix[1, 1] * math.tan(angle))

    head, feet = row(config.body_height_m), row(0.0)
    return Fit(head, feet, feet - head)


def best_pitch_deg(config: MavlinkBridgeConfig) -> float:
    """Pitch in degrees, down positive, that has the standing person in the middle."""
    head, feet = (math.atan2(config.height_m - z, config.radius_m) for z in (config.body_height_m, 0.0))
    return math.degrees((head + feet) / 2)


def _inside(fit: Fit, rows: int) -> bool:
    return _EDGE * rows <= fit.head_px and fit.feet_px <= (1 - _EDGE) * rows


def _least_radius_m(config: MavlinkBridgeConfig, matrix: np.ndarray, rows: int) -> float:
    """Distance from which the person is half as high as the picture."""
    return 2.0 * float(matrix[1, 1]) * config.body_height_m / rows


def _fov_deg(matrix: np.ndarray, width: int) -> float:
    return math.degrees(2 * math.atan(0.5 * width / float(matrix[0, 0])))


def _body(config: MavlinkBridgeConfig, setup: Setup) -> Iterator[Finding]:
    measured = config.size_error <= _MEASURED_SIZE_ERROR
    other = abs(setup.assumed_height_m - config.body_height_m) > 0.005
    remedies = []
    if not measured:
        remedies.append(
            "measure the person, set body_height_m, and size_error to 0.04: a range is as wrong as the height"
        )
    if other:
        remedies.append(f"set initializer.assumed_height_m ({setup.assumed_height_m:g}) to the same")
    words = "measured" if measured else "assumed"
    yield Finding(
        "body_height", "body height", Level.WARNING if remedies else Level.OK,
        f"{config.body_height_m:g} m, {words} (size_error {config.size_error:g})", "measured", "; ".join(remedies),
        {"body_height_m": config.body_height_m, "size_error": config.size_error},
    )  # fmt: skip
