"""Checks of the vehicle: its health, its settings, its fence, its mount, its battery."""

from __future__ import annotations

import math
from collections.abc import Iterator

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.autopilot_settings import LossSettings, loss_settings_of
from drocap_ros.flight.mavlink.dialects import PX4
from drocap_ros.flight.mavlink.mount import SERVOS, TYPE_PARAMETER
from drocap_ros.flight.orbit.motion_checks import battery_condition, loss_condition
from drocap_ros.flight.preflight.findings import LASTING, Finding, Level, Measured, Stream
from drocap_ros.flight.preflight.setting_checks import setting_findings
from drocap_ros.flight.vehicle_state import LANDED_IN_AIR, LANDED_ON_GROUND, SATELLITES_UNKNOWN, VehicleState

_C = ConditionCode
_CAMERA = (_C.CAMERA_UNKNOWN, _C.MOUNT_TYPE_UNKNOWN, _C.MOUNT_OUTDATED)
_GOOD_SATELLITES = 8
_MOUNT = "GIMBAL_DEVICE_ATTITUDE_STATUS"
_FIXES = {0: "no receiver", 1: "no fix", 2: "2D", 3: "3D", 4: "3D, differential", 5: "RTK float", 6: "RTK fixed"}
_LANDED = {LANDED_ON_GROUND: "on the ground", LANDED_IN_AIR: "in the air"}
#: Values of GF_ACTION that guard nobody: its 4 is flight termination, above a person.
_PX4_FENCES: dict[float, str] = {0: "off", 1: "warns only", 4: "stops the motors"}
_ACTIONS = {
    0: "drifts by the sticks", 1: "drifts in altitude mode", 2: "drifts in manual flight", 3: "returns", 4: "lands",
    5: "holds", 6: "ends the flight", 7: "stops the motors",
}  # fmt: skip


def vehicle_findings(config: MavlinkBridgeConfig, measured: Measured, vehicle: VehicleState) -> Iterator[Finding]:
    """Everything about the vehicle, whose state is known."""
    yield _autopilot(measured, vehicle)
    yield from _loss(config, measured, vehicle)
    yield from setting_findings(config, measured, vehicle.autopilot)
    if vehicle.autopilot == "px4":
        yield from _px4_settings(config, measured, vehicle)
        yield _px4_fence(config, measured)
    else:
        yield _ardupilot_fence(config, measured)
    yield _mount(config, measured)
    yield _satellites(vehicle)
    yield _estimator(vehicle)
    yield _battery(config, vehicle)
    yield _phase(vehicle)


def _autopilot(measured: Measured, vehicle: VehicleState) -> Finding:
    known = vehicle.autopilot in ("ardupilot", "px4")
    version = measured.version or "version not reported"
    return Finding(
        "autopilot", "autopilot", Level.OK if known else Level.MISSING, f"{vehicle.autopilot}, {version}",
        "ArduPilot Copter or PX4", "" if known else "the bridge flies no other autopilot",
        {"autopilot": vehicle.autopilot, "version": measured.version}, (_C.AUTOPILOT_UNSUPPORTED,),
    )  # fmt: skip


def _loss(config: MavlinkBridgeConfig, measured: Measured, vehicle: VehicleState) -> Iterator[Finding]:
    settings = loss_settings_of(vehicle.autopilot, measured.settings)
    if settings is None:
        return
    limit = config.max_control_timeout_s
    name = settings.timeout_name
    refusal = loss_condition(settings, limit)
    wrong = refusal is not None and refusal.code in (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG)
    level = Level.MISSING if wrong else Level.OK if limit else Level.WARNING
    yield Finding(
        name.lower(), name, level, _value(settings.timeout_s, " s"), f"at most {limit:g} s" if limit else "0.5 s",
        f"set {name} to {limit:g} on the autopilot: for so long it flies on after the bridge's death" if wrong
        else "" if limit else "set max_control_timeout_s to 0.5: 0 switches the check off",
        {"value": settings.timeout_s, "limit": limit}, (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG),
    )  # fmt: skip
    if vehicle.autopilot == "px4":
        yield _loss_action(settings, refused=refusal is not None and not wrong)


def _loss_action(settings: LossSettings, refused: bool) -> Finding:
    holds = settings.action == 5
    return Finding(
        settings.action_name.lower(), settings.action_name,
        Level.OK if holds else Level.MISSING if refused else Level.WARNING,
        _value(settings.action) + _words(_ACTIONS, settings.action), "5 (holds)",
        "" if holds else f"set {settings.action_name} to 5 on the autopilot: what it does after the bridge's death",
        {"value": settings.action}, (_C.LOSS_ACTION_FATAL,),
    )  # fmt: skip


def _px4_settings(config: MavlinkBridgeConfig, measured: Measured, vehicle: VehicleState) -> Iterator[Finding]:
    if "COM_RC_OVERRIDE" in measured.settings:
        value = measured.setting("COM_RC_OVERRIDE")
        obeys = not math.isnan(value) and int(value) & 2 == 2
        yield Finding(
            "com_rc_override", "COM_RC_OVERRIDE", Level.OK if obeys else Level.WARNING, _value(value),
            "3 (the sticks take over in OFFBOARD)",
            "" if obeys else "set COM_RC_OVERRIDE to 3 on the autopilot, or take over by the mode switch only",
            {"value": value},
        )  # fmt: skip
    if not config.mode_change_allowed and vehicle.mode != PX4.control_mode:
        yield Finding(
            "engage", "way into OFFBOARD", Level.MISSING, "mode_change_allowed is false", "true",
            "set mode_change_allowed to true and start by `drocap orbit engage`: PX4 grants OFFBOARD only while "
            "setpoints arrive", {}, (_C.MODE_CHANGE_FORBIDDEN, _C.NOT_IN_CONTROL_MODE),
        )  # fmt: skip


def _ardupilot_fence(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    enabled = measured.setting("FENCE_ENABLE")
    kinds = measured.setting("FENCE_TYPE")
    radius = height = math.nan
    if enabled == 1:
        radius, height = measured.setting("FENCE_RADIUS"), measured.setting("FENCE_ALT_MAX")
        if not math.isnan(kinds):
            radius = radius if int(kinds) & 2 else 0.0
            height = height if int(kinds) & 1 else 0.0
    state = "off" if enabled == 0 else "" if enabled == 1 else "FENCE_ENABLE not reported"
    if not state and measured.setting("FENCE_ACTION") == 0:
        state = "reports only"
    return _fence(
        config, measured, state, radius, height, "FENCE_RADIUS", "FENCE_ALT_MAX",
        "FENCE_ENABLE to 1, FENCE_TYPE to 3 (height and circle), FENCE_ACTION to 4 (brake)",
    )  # fmt: skip


def _px4_fence(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    action = measured.setting("GF_ACTION")
    radius, height = measured.setting("GF_MAX_HOR_DIST"), measured.setting("GF_MAX_VER_DIST")
    state = "GF_ACTION not reported" if math.isnan(action) else ""
    state = _PX4_FENCES.get(action, state)
    return _fence(
        config, measured, state, radius, height, "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST", "GF_ACTION to 2 (hold) or 3"
    )


def _fence(
    config: MavlinkBridgeConfig, measured: Measured, state: str, radius_m: float, height_m: float, radius_name: str,
    height_name: str, how: str,
) -> Finding:  # fmt: skip
    """The autopilot's own fence against ours; 0 = that side has none."""
    names = (radius_name, height_name)
    if not any(name in measured.settings for name in names):
        found, remedy = "not read", "stop the running bridge and run this again to read it"
        level = Level.WARNING
    elif state:
        found, level = state, Level.WARNING
        remedy = (
            f"set {how}, {radius_name} above {config.fence_radius_m:g} and {height_name} above {config.max_height_m:g} "
            "on the autopilot: the last guard that needs no companion computer"
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


def _mount(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    stream = measured.streams.get(_MOUNT, Stream(0.0, config.gimbal_hz))
    number = measured.setting(TYPE_PARAMETER)
    servo = number == SERVOS
    kind = config.mount if config.mount != "auto" else "servo" if servo else "gimbal"
    reported = stream.real_hz > 0
    found = f"{kind}, angles at {stream.real_hz:.1f} Hz" + (
        "" if math.isnan(number) else f", {TYPE_PARAMETER} {number:g}"
    )
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
            "connect the mount and set its type on the autopilot (ArduPilot: MNT1_TYPE); without one set mount: fixed "
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
        {"kind": kind, "real_hz": stream.real_hz, "mnt1_type": number}, _CAMERA,
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


def _battery(config: MavlinkBridgeConfig, vehicle: VehicleState) -> Finding:
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
            "set up a battery monitor with a current sensor (ArduPilot: BATT_MONITOR 4 and BATT_CAPACITY; PX4: "
            "BAT1_CAPACITY), or min_battery_voltage_v to fly by the voltage alone"
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


def _words(names: dict[int, str], value: float) -> str:
    return f" ({names[int(value)]})" if value in names else ""
