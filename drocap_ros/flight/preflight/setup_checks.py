"""Checks of what is configured: permission, limits that contradict each other, camera, picture, body."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, goal_of
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.observed import Motion
from drocap_ros.flight.preflight.findings import Finding, Values, check, graded
from drocap_ros.flight.subject.framing import Framing, View, orbit_margin
from drocap_ros.flight.vehicle import VehicleState

_C = ConditionCode
_EDGE = 0.04  # share of the picture's rows: detectors lose feet and head nearer to the border
_WIND_LEAN_M_S2 = 0.9  # a copter of this size leans by 5 deg against 8 m/s
DRIVER = "/dev/video"
_STREAM_DELAY_S = 0.1  # of a usual network stream
_LEAST_PX = 80.0  # height of a person below which the pose networks fail (docs/accuracy.md)
_GOOD_PX = 150.0  # height of a person from which they do not gain
_WALK_M_S = 1.4  # of a brisk walk
_MEASURED_SIZE_ERROR = 0.05  # share: a stature that nobody measured errs by more
_LEAST_ROOM_M = 10.0  # for the subject's walk
_PASSED_OVER = 0.03  # share of the images that a pause of the machine may cost
_TOO_MANY = 0.5  # share without which the bridge sees too little
_SELDOM = 3.0  # images for one that the networks look at, above which optical flow errs by more than they do,
_OFTEN = 2.0  # and what a remedy aims at
_ENOUGH_PX = 1280 * 720  # of an image: networks see it smaller


class Pace(NamedTuple):
    """How the networks keep up with the source, alone on this machine.

    seconds, passed_over : measured, and share of the images that were passed over meanwhile
    every : images for one that the networks looked at; optical flow followed the others
    pixels, threads, cores : of an image, of a network as configured, of this machine
    """

    seconds: float
    passed_over: float
    every: float
    pixels: int
    threads: int
    cores: int


class Pictures(NamedTuple):
    """What the source of the images gave when it was opened.

    refusal : why it gave none; "" = it did
    size : width, height px
    rate_hz : NaN = it gave one image
    latency_s : from the driver's stamp of the exposure until the image was here; NaN = it does not say
    blank : whether all images are of one colour
    pace : None = not measured
    """

    refusal: str = ""
    size: tuple[int, int] = (0, 0)
    rate_hz: float = math.nan
    latency_s: float = math.nan
    blank: bool = False
    pace: Pace | None = None


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
    wanted_size : width, height px that the configuration asks of the source, 0 = any
    pictures : None = the source was not opened
    """

    camera_matrix: np.ndarray | None
    image_size: tuple[int, int]
    camera_words: str
    calibrated: bool
    source: str
    assumed_height_m: float
    models: str
    models_remedy: str = ""
    wanted_size: tuple[int, int] = (0, 0)
    pictures: Pictures | None = None


class Fit(NamedTuple):
    """Rows of a person in the picture: of the head, of the feet, and the difference, px from the top."""

    head_px: float
    feet_px: float
    height_px: float


def setup_findings(config: MavlinkBridgeConfig, setup: Setup, vehicle: VehicleState | None = None) -> Iterator[Finding]:
    """Everything that can be checked without a vehicle, and with one the picture of a mount that nothing points."""
    yield _permission(config)
    yield _limits(config)
    yield _source(setup)
    if setup.pictures is not None:
        yield _opened(setup, setup.pictures)
        if setup.pictures.pace is not None:
            yield _pace(setup.pictures.pace, setup.pictures.rate_hz)
    yield _camera(setup)
    if setup.camera_matrix is not None:
        yield _picture(config, setup, setup.camera_matrix, vehicle)
    yield _latency(config, setup)
    yield _body(config, setup)


@check("commands_enabled", "permission to fly", _C.COMMANDS_DISABLED)
def _permission(config: MavlinkBridgeConfig) -> Finding:
    found = f"commands_enabled is {str(config.commands_enabled).lower()}"
    remedy = "set commands_enabled to true when you have read docs/flight.md"
    return Finding(graded(missing=not config.commands_enabled), found, "true", remedy)


@check("limits", "limits")
def _limits(config: MavlinkBridgeConfig) -> Finding:
    """Limits that are allowed one by one and hinder each other."""
    speed = abs(math.radians(config.angular_speed_deg_s)) * config.radius_m
    words, remedies = [f"orbit of {config.radius_m:g} m, {config.height_m:g} m high, {speed:.1f} m/s"], []
    room = config.fence_radius_m - config.radius_m - speed**2 / (2 * config.braking_m_s2)
    if room < _LEAST_ROOM_M:
        words.append(f"the fence leaves the subject {max(room, 0):.0f} m to walk")
        remedies.append("widen fence_radius_m")
    if config.max_speed_m_s < speed + _WALK_M_S:
        left = f"{config.max_speed_m_s - speed:.1f} m/s to follow a walk of {_WALK_M_S:g}"
        words.append(f"max_speed_m_s {config.max_speed_m_s:g} leaves {left}")
        remedies.append("raise max_speed_m_s, or fly slower")
    braking_s = config.max_speed_m_s / config.braking_m_s2
    if config.blind_hold_s < 0.9 * braking_s:
        words.append(
            f"blind_hold_s {config.blind_hold_s:g} is shorter than braking from max_speed_m_s, {braking_s:.1f} s"
        )
        remedies.append("raise blind_hold_s, or lower max_speed_m_s")
    level, wanted = graded(warning=bool(remedies)), "limits that leave room for each other"
    return Finding(level, "; ".join(words), wanted, "; ".join(remedies), {"speed_m_s": speed, "room_m": room})


@check("perception", "pictures and networks", _C.NO_SUBJECT)
def _source(setup: Setup) -> Finding:
    remedies = [] if setup.source else ["set image_ingest.source to the camera"]
    remedies += [] if setup.models else [setup.models_remedy]
    found = f"{setup.source or 'no source'}, {'networks in ' + setup.models if setup.models else 'no networks'}"
    values = {"source": setup.source, "models": setup.models}
    wanted = "a camera, a detector and a pose network"
    return Finding(graded(missing=bool(remedies)), found, wanted, "; ".join(remedies), values)


@check("images", "images", _C.NO_SUBJECT)
def _opened(setup: Setup, pictures: Pictures) -> Finding:
    """Whether the source gives images as it is asked to."""
    wanted = "images"
    if pictures.refusal:
        return Finding(Level.MISSING, "not opened", wanted, pictures.refusal, {"opened": False})
    (width, height), remedies = pictures.size, []
    words = [f"{width}x{height} px"]
    words += [f"{pictures.rate_hz:.3g} images/s"] if math.isfinite(pictures.rate_hz) else ["one image, then no more"]
    late = math.isfinite(pictures.latency_s)
    words += [f"here {pictures.latency_s:.2f} s after the exposure"] if late else ["latency not known"]
    if any(asked not in (0, got) for asked, got in zip(setup.wanted_size, pictures.size, strict=True)):
        wanted = f"images of {setup.wanted_size[0]}x{setup.wanted_size[1]} px"
        remedies.append("set width_px and height_px to a mode of the camera (v4l2-ctl --list-formats-ext)")
    if pictures.blank:
        words.append("all of one colour")
        remedies.append("uncover the lens")
    if math.isnan(pictures.rate_hz):
        remedies.append("check the cable and the power of the camera")
    values = {
        "opened": True, "width_px": width, "height_px": height, "rate_hz": pictures.rate_hz,
        "latency_s": pictures.latency_s,
    }  # fmt: skip
    return Finding(graded(warning=bool(remedies)), ", ".join(words), wanted, "; ".join(remedies), values)


@check("pace", "this machine", _C.PICTURES_LATE)
def _pace(pace: Pace, rate_hz: float) -> Finding:
    """Whether networks and images keep pace, without the other nodes."""
    keeps_up = pace.passed_over < _PASSED_OVER
    words = "keeps up with" if keeps_up else f"passes over {pace.passed_over:.0%} of"
    found = f"{words} {rate_hz:.3g} images/s for {pace.seconds:.0f} s, the networks look at one in {pace.every:.1f}"
    rate_hz *= (1.0 - pace.passed_over) * min(1.0, _OFTEN / pace.every)
    remedies = [f"set image_ingest.max_rate_hz to {max(1, round(rate_hz))}"]
    if pace.pixels > _ENOUGH_PX:
        remedies.append("width_px and height_px to 1280 and 720")
    if pace.cores > 2 * pace.threads:
        remedies.append(f"pose_estimator.threads to {pace.cores // 2}")
    else:
        remedies.append("pose_model or detector to a smaller one (drocap models list)")
    level = graded(missing=pace.passed_over > _TOO_MANY, warning=not keeps_up or pace.every > _SELDOM)
    values = {"passed_over": pace.passed_over, "every": pace.every, "seconds": pace.seconds}
    return Finding(level, found, f"one in {_SELDOM:g} or more, none passed over", ", or ".join(remedies), values)


@check("camera", "camera", _C.NO_CAMERA_INFO)
def _camera(setup: Setup) -> Finding:
    if setup.camera_matrix is None:
        remedy = "set image_ingest.calibration_file (ROS camera_calibration), or at least horizontal_fov_deg"
        return Finding(Level.MISSING, setup.camera_words, "a calibration, or a field of view", remedy)
    remedy = "calibrate and set image_ingest.calibration_file: an error of the field of view is one of the range"
    values = {"fov_deg": math.degrees(2 * math.atan(0.5 * setup.image_size[0] / float(setup.camera_matrix[0, 0])))}
    return Finding(graded(warning=not setup.calibrated), setup.camera_words, "a calibration", remedy, values)


@check("camera_latency", "camera latency")
def _latency(config: MavlinkBridgeConfig, setup: Setup) -> Finding:
    """Whether the stamps of the pictures are the driver's; how late they are cannot be seen from here."""
    driver, stated_s = setup.source.startswith(DRIVER), config.camera_latency_s
    stamps = f"stamps are {'' if driver else 'not '}the driver's"
    values: Values = {"source": setup.source, "camera_latency_s": stated_s}
    if stated_s > 0:
        return Finding(Level.OK, f"{stated_s:g} s as stated; {stamps}", "measured or stated", values=values)
    aside_deg = abs(config.angular_speed_deg_s) * _STREAM_DELAY_S
    remedy = (
        f"use a camera on {DRIVER}N, or a topic with stamps of the exposure, or measure the delay and set "
        f"camera_latency_s: {_STREAM_DELAY_S:g} s late, a picture has the person {aside_deg:.1f} deg aside"
    )
    return Finding(graded(warning=not driver), f"not stated; {stamps}", "stamps of the exposure", remedy, values)


@check("picture", "person in the picture", _C.PERSON_LEAVES_PICTURE)
def _picture(config: MavlinkBridgeConfig, setup: Setup, matrix: np.ndarray, vehicle: VehicleState | None) -> Finding:
    """Whether the person fits into the picture, and how high it is there."""
    rows = setup.image_size[1]
    framing = Framing(config)
    framing.matrix, framing.size = matrix, setup.image_size
    if config.mount != "fixed" and vehicle is not None:
        framing.watch(vehicle, Motion().velocity, 0.0)
    view = framing.view()
    pitch_deg = -best_pitch_deg(config) if view is None else math.degrees(view.pitch)
    fit = person_in_picture(config, matrix, -pitch_deg)
    inside = _EDGE * rows <= fit.head_px and fit.feet_px <= (1 - _EDGE) * rows
    if view is None:
        # From this distance on the person is half as high as the picture.
        least_m = 2.0 * float(matrix[1, 1]) * config.body_height_m / rows
        level, remedies = graded(missing=not inside), [f"fly at least {least_m:.0f} m away, or use a wider lens"]
        how = "mount aims at the person"
    else:
        level, remedies = _unaimed_camera(config, framing, view, inside, vehicle.autopilot if vehicle else "")
        how = f"mount at {pitch_deg:.0f} deg" if view.level else f"camera fixed at {pitch_deg:g} deg"
    remedies = remedies if level != Level.OK else []
    if fit.height_px < _GOOD_PX:
        level = max(level, graded(missing=fit.height_px < _LEAST_PX, warning=True))
        remedies.append("fly closer, or raise width_px and height_px")
    found = f"{fit.height_px:.0f} px high, rows {fit.head_px:.0f} to {fit.feet_px:.0f} of {rows} ({how})"
    values = {**fit._asdict(), "rows": rows, "pitch_deg": pitch_deg}
    return Finding(level, found, f"inside the picture, {_GOOD_PX:.0f} px high", "; ".join(remedies), values)


def _unaimed_camera(
    config: MavlinkBridgeConfig, framing: Framing, view: View, inside: bool, autopilot: str
) -> tuple[Level, list[str]]:
    """As the bridge judges an orbit by a camera that nothing points: it leans with the body, or a mount keeps it."""
    goal = goal_of(config)
    lost, pitch_deg = framing.refusal(goal) is not None, -best_pitch_deg(config)
    if view.level:
        # Flown also with a part of the person cut off.
        remedy = f"set gimbal_control to true, or point the mount to {pitch_deg:.0f} deg before the start"
        return (Level.OK, []) if inside and not lost else (graded(missing=lost, warning=True), [remedy])
    if lost:
        remedy = f"tilt the camera to {pitch_deg:.0f} deg (camera_pitch_deg), fly slower or farther, or use a gimbal"
        return Level.MISSING, [remedy]
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


def person_in_picture(config: MavlinkBridgeConfig, matrix: np.ndarray, pitch_down_deg: float) -> Fit:
    """Rows of a standing person at the orbit's distance; infinite = beside or behind the camera.

    matrix : (3, 3) px
    pitch_down_deg : of the optical axis against the horizon
    """

    def row(height_m: float) -> float:
        angle = math.atan2(config.height_m - height_m, config.radius_m) - math.radians(pitch_down_deg)
        if abs(angle) >= 0.5 * math.pi:
            return math.copysign(math.inf, angle)
        return float(matrix[1, 2] + matrix[1, 1] * math.tan(angle))

    head, feet = row(config.body_height_m), row(0.0)
    return Fit(head, feet, feet - head)


def best_pitch_deg(config: MavlinkBridgeConfig) -> float:
    """Pitch in degrees, down positive, that has the standing person in the middle."""
    head, feet = (math.atan2(config.height_m - z, config.radius_m) for z in (config.body_height_m, 0.0))
    return math.degrees((head + feet) / 2)


@check("body_height", "body height")
def _body(config: MavlinkBridgeConfig, setup: Setup) -> Finding:
    measured = config.size_error <= _MEASURED_SIZE_ERROR
    remedies = []
    if not measured:
        remedies.append(
            "measure the person, set body_height_m, and size_error to 0.04: a range is as wrong as the height"
        )
    if abs(setup.assumed_height_m - config.body_height_m) > 0.005:
        remedies.append(f"set initializer.assumed_height_m ({setup.assumed_height_m:g}) to the same")
    words = "measured" if measured else "assumed"
    found = f"{config.body_height_m:g} m, {words} (size_error {config.size_error:g})"
    values = {"body_height_m": config.body_height_m, "size_error": config.size_error}
    return Finding(graded(warning=bool(remedies)), found, "measured", "; ".join(remedies), values)
