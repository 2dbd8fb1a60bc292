"""Checks of the vehicle: its health, its settings, its fence, its mount, its battery."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from drocap_ros.flight.autopilot import Autopilot, autopilot_of, supported_titles
from drocap_ros.flight.autopilot.autopilot import FenceSettings, FlownSpeeds, LossAction
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.findings import Finding, Level
from drocap_ros.flight.orbit.motion_checks import battery_condition, loss_condition
from drocap_ros.flight.preflight.measured import LASTING, Measured, Stream
from drocap_ros.flight.vehicle_state import LANDED_IN_AIR, LANDED_ON_GROUND, SATELLITES_UNKNOWN, VehicleState

_C = ConditionCode
_CAMERA = (_C.CAMERA_UNKNOWN, _C.MOUNT_TYPE_UNKNOWN, _C.MOUNT_OUTDATED)
_GOOD_SATELLITES = 8
_MOUNT = "GIMBAL_DEVICE_ATTITUDE_STATUS"
_FIXES = {0: "no receiver", 1: "no fix", 2: "2D", 3: "3D", 4: "3D, differential", 5: "RTK float", 6: "RTK fixed"}
_LANDED = {LANDED_ON_GROUND: "on the ground", LANDED_IN_AIR: "in the air"}


def vehicle_findings(config: MavlinkBridgeConfig, measured: Measured, vehicle: VehicleState) -> Iterator[Finding]:
    """Everything about the vehicle, whose state is known."""
    autopilot = autopilot_of(vehicle.autopilot)
    yield _identity(measured, vehicle, autopilot)
    yield from _loss(config, measured, autopilot)
    yield from _settings(config, measured, autopilot)
    yield from _way_into_control(config, vehicle, autopilot)
    if autopilot.fence is not None:
        yield _fence(config, measured, autopilot.fence)
    yield _mount(config, measured, autopilot)
    yield _satellites(vehicle)
    yield _estimator(vehicle)
    yield _battery(config, vehicle, autopilot)
    yield _phase(vehicle)


def _identity(measured: Measured, vehicle: VehicleState, autopilot: Autopilot) -> Finding:
    known = autopilot.supported
    version = measured.version or "version not reported"
    return Finding(
        "autopilot", "autopilot", Level.OK if known else Level.MISSING, f"{vehicle.autopilot}, {version}",
        supported_titles(), "" if known else "the bridge flies no other autopilot",
        {"autopilot": vehicle.autopilot, "version": measured.version}, (_C.AUTOPILOT_UNSUPPORTED,),
    )  # fmt: skip


def _loss(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Iterator[Finding]:
    settings, meaning = autopilot.loss_settings(measured.settings), autopilot.loss_action
    if settings is None:
        return
    limit = config.max_control_timeout_s
    name = settings.timeout_name
    refusal = loss_condition(settings, meaning, limit)
    wrong = refusal is not None and refusal.code in (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG)
    level = Level.MISSING if wrong else Level.OK if limit else Level.WARNING
    yield Finding(
        name.lower(), name, level, _value(settings.timeout_s, " s"), f"at most {limit:g} s" if limit else "0.5 s",
        f"set {name} to {limit:g} on the autopilot: for so long it flies on after the bridge's death" if wrong
        else "" if limit else "set max_control_timeout_s to 0.5: 0 switches the check off",
        {"value": settings.timeout_s, "limit": limit}, (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG),
    )  # fmt: skip
    if meaning is not None:
        yield _loss_action(settings.action, meaning, refused=refusal is not None and not wrong)


def _loss_action(action: float, meaning: LossAction, refused: bool) -> Finding:
    holds = action == meaning.hold
    wanted, remedy = f"{meaning.hold} ({meaning.words[meaning.hold]})", ""
    if not holds:
        remedy = f"set {meaning.setting} to {meaning.hold} on the autopilot: what it does after the bridge's death"
    return Finding(
        meaning.setting.lower(), meaning.setting,
        Level.OK if holds else Level.MISSING if refused else Level.WARNING,
        _value(action) + _words(meaning.words, action), wanted, remedy, {"value": action}, (_C.LOSS_ACTION_FATAL,),
    )  # fmt: skip


def _settings(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Iterator[Finding]:
    """A finding for each parameter that was reported: no version of an autopilot has all of them."""
    names = [check.name for check in autopilot.checks]
    if names and not any(name in measured.settings for name in names):
        yield Finding(
            "settings", "autopilot's settings", Level.WARNING, "not read", f"good values of {', '.join(names)}",
            "stop the running bridge and run this again to read them",
        )  # fmt: skip
        return
    speeds = FlownSpeeds(abs(math.radians(config.angular_speed_deg_s)) * config.radius_m, config.max_speed_m_s)
    for check in autopilot.checks:
        value = measured.setting(check.name)
        if math.isnan(value) and not (check.always and check.name in measured.settings):
            continue
        level = check.judge(value, speeds)
        remedy = "" if level == Level.OK else check.remedy.format(speeds=speeds)
        wanted = check.wanted.format(speeds=speeds)
        yield Finding(check.name.lower(), check.name, level, _value(value), wanted, remedy, {"value": value})


def _way_into_control(config: MavlinkBridgeConfig, vehicle: VehicleState, autopilot: Autopilot) -> Iterator[Finding]:
    """Where the pilot cannot enter the control mode by hand, the bridge must be allowed to request it."""
    mode, hints = autopilot.control_mode, autopilot.hints
    if autopilot.supported and not hints.by_hand and not config.mode_change_allowed and vehicle.mode != mode:
        yield Finding(
            "engage", f"way into {mode}", Level.MISSING, "mode_change_allowed is false", "true",
            f"set mode_change_allowed to true and start by `drocap orbit engage`: {hints.engaged}", {},
            (_C.MODE_CHANGE_FORBIDDEN, _C.NOT_IN_CONTROL_MODE),
        )  # fmt: skip


def _fence(config: MavlinkBridgeConfig, measured: Measured, settings: FenceSettings) -> Finding:
    """The autopilot's own fence against ours."""
    problem, radius_m, height_m = settings.read(measured.setting)
    radius_name, height_name = settings.radius, settings.height
    if radius_name not in measured.settings and height_name not in measured.settings:
        found, remedy = "not read", "stop the running bridge and run this again to read it"
        level = Level.WARNING
    elif problem:
        found, level = problem, Level.WARNING
        remedy = (
            f"set {settings.how}, {radius_name} above {config.fence_radius_m:g} and {height_name} above "
            f"{config.max_height_m:g} on the autopilot: the last guard that needs no companion computer"
        )
    else:
        found = f"{_side(radius_m)} wide, {_side(height_m)} high"
        remedies = []
        # Ours is around the subject at the start, the autopilot's around its home.
        if not radius_m > config.fence_radius_m:
            remedies.append(f"set {radius_name} above {config.fence_radius_m:g}, or fence_radius_m lower")
        if not height_m > config.max_height_m:
            remedies.append(f"set {height_name} above {config.max_height_m:g}, or max_height_m lower")
        level = Level.WARNING if remedies else Level.OK
        remedy = "; ".join([*remedies, "a breach there ends in its own action"]) if remedies else ""
    return Finding(
        "fence", "autopilot's fence", level, found,
        f"on, beyond ours: {config.fence_radius_m:g} m wide from the subject, {config.max_height_m:g} m high", remedy,
        {"radius_m": radius_m, "height_m": height_m, "own_radius_m": config.fence_radius_m,
         "own_height_m": config.max_height_m},
    )  # fmt: skip


def _side(metres: float) -> str:
    return "unlimited" if metres == 0 else _value(metres, " m")


def _mount(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Finding:
    stream = measured.streams.get(_MOUNT, Stream(0.0, config.gimbal_hz))
    setting = autopilot.mount_type_setting
    number = measured.setting(setting)
    servo = number == autopilot.servo_mount
    kind = config.mount if config.mount != "auto" else "servo" if servo else "gimbal"
    reported = stream.real_hz > 0
    found = f"{kind}, angles at {stream.real_hz:.1f} Hz" + ("" if math.isnan(number) else f", {setting} {number:g}")
    wanted, level, remedy = f"{config.gimbal_hz:g} Hz", Level.OK, ""
    if kind == "fixed":
        found, wanted = f"fixed, {config.camera_pitch_deg:g} deg against the body", "as built"
        if reported or config.gimbal_control:
            level, remedy = (
                Level.WARNING,
                "a mount reports its angles: set mount to auto"
                if reported
                else ("set gimbal_control to false: there is nothing to turn"),
            )
    elif not reported:
        found, level = "no mount reports its angles", Level.MISSING
        remedy = (
            f"connect the mount and set its type on the autopilot{autopilot.hints.mount}; without one set mount: fixed "
            "and camera_pitch_deg"
        )
    elif servo and kind == "gimbal":
        level, remedy = Level.WARNING, "set mount to servo or auto: the angles of servos are against the body"
    elif kind == "servo" and not servo and not math.isnan(number):
        level, remedy = Level.WARNING, "set mount to gimbal or auto: the angles of this mount are against the horizon"
    elif stream.real_hz < config.rate_shortfall * config.gimbal_hz:
        level, remedy = Level.WARNING, "lower gimbal_hz, or raise the rate of the link"
    problem = next((c for c, share in measured.conditions if c.code in _CAMERA and share > LASTING), None)
    if problem is not None and level != Level.MISSING:
        level, remedy = Level.MISSING, str(problem)
    return Finding(
        "mount", "mount", level, found, wanted, remedy,
        {"kind": kind, "real_hz": stream.real_hz, "type": number}, _CAMERA,
    )  # fmt: skip


def _satellites(vehicle: VehicleState) -> Finding:
    fix, count = vehicle.gps_fix_type, vehicle.satellites
    few = count != SATELLITES_UNKNOWN and count < _GOOD_SATELLITES
    level = Level.MISSING if fix < 3 else Level.WARNING if few else Level.OK
    number = "" if count == SATELLITES_UNKNOWN else f", {count} satellites"
    return Finding(
        "satellites", "satellite fix", level, _FIXES.get(fix, f"type {fix}") + number,
        f"3D, {_GOOD_SATELLITES} satellites", "" if level == Level.OK else "wait, in the open",
        {"fix_type": fix, "satellites": count}, (_C.NO_SATELLITE_FIX,),
    )  # fmt: skip


def _estimator(vehicle: VehicleState) -> Finding:
    return Finding(
        "estimator", "position estimate", Level.OK if vehicle.position_ok else Level.MISSING,
        "healthy" if vehicle.position_ok else "not usable", "healthy",
        "" if vehicle.position_ok else "wait for the autopilot's estimator; see its messages in the ground station", {},
        (_C.ESTIMATOR_UNHEALTHY, _C.VEHICLE_STATE_UNKNOWN),
    )  # fmt: skip


def _battery(config: MavlinkBridgeConfig, vehicle: VehicleState, autopilot: Autopilot) -> Finding:
    charge, volts = vehicle.battery_fraction, vehicle.battery_voltage_v
    level, remedy = Level.OK, ""
    found = _value(volts, " V") if math.isnan(charge) else f"{100 * charge:.0f} %, {_value(volts, ' V')}"
    wanted = f"above {100 * config.min_battery_fraction:.0f} %"
    if config.min_battery_voltage_v:
        wanted += f", {config.min_battery_voltage_v:g} V"
    problem = battery_condition(charge, volts, config)
    if problem is not None and problem.code == _C.BATTERY_UNKNOWN:
        level = Level.MISSING
        found += ", no charge" if not math.isnan(volts) else ": no battery monitor"
        remedy = (
            f"set up a battery monitor with a current sensor{autopilot.hints.battery}, or min_battery_voltage_v to fly "
            "by the voltage alone"
        )
    elif problem is not None:
        level, remedy = Level.MISSING, "charge the battery, or correct its capacity on the autopilot"
    return Finding(
        "battery", "battery", level, found, wanted, remedy, {"fraction": charge, "voltage_v": volts},
        (_C.BATTERY_UNKNOWN, _C.BATTERY_LOW),
    )  # fmt: skip


def _phase(vehicle: VehicleState) -> Finding:
    where = _LANDED.get(vehicle.landed_state, "place not reported")
    armed = "armed" if vehicle.armed else "not armed"
    return Finding(
        "phase", "now", Level.OK, f"{where}, {armed}, mode {vehicle.mode}", "", "",
        {"armed": vehicle.armed, "landed_state": vehicle.landed_state, "mode": vehicle.mode},
    )  # fmt: skip


def _value(value: float, unit: str = "") -> str:
    return "not reported" if math.isnan(value) else f"{value:.6g}{unit}"


def _words(names: Mapping[int, str], value: float) -> str:
    return f" ({names[int(value)]})" if value in names else ""
