"""Checks of the vehicle: its health, its settings, its fence, its mount, its battery."""

from __future__ import annotations

import math
from collections.abc import Iterator

from drocap_ros.flight.autopilot import Autopilot, autopilot_of, supported_titles
from drocap_ros.flight.autopilot.autopilot import FenceSettings, FlownSpeeds, Level, LossAction, LossSettings
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.motion_checks import LANDED_STATES, battery_condition, loss_condition
from drocap_ros.flight.preflight.findings import LASTING, Finding, Measured, Stream, Values, check, graded
from drocap_ros.flight.vehicle import LANDED_IN_AIR, LANDED_ON_GROUND, SATELLITES_UNKNOWN, VehicleState

_C = ConditionCode
_CAMERA = (_C.CAMERA_UNKNOWN, _C.MOUNT_TYPE_UNKNOWN, _C.MOUNT_OUTDATED)
_GOOD_SATELLITES = 8  # with fewer the position wanders by metres
_MOUNT = "GIMBAL_DEVICE_ATTITUDE_STATUS"
_FIXES = {0: "no receiver", 1: "no fix", 2: "2D", 3: "3D", 4: "3D, differential", 5: "RTK float", 6: "RTK fixed"}
_LANDED = {**LANDED_STATES, LANDED_IN_AIR: "in the air"}


def vehicle_findings(config: MavlinkBridgeConfig, measured: Measured, vehicle: VehicleState) -> Iterator[Finding]:
    """Everything about the vehicle, whose state is known."""
    autopilot = autopilot_of(vehicle.autopilot)
    yield _identity(measured, vehicle, autopilot)
    yield from _loss(config, measured, autopilot)
    yield from _settings(config, measured, autopilot)
    by_hand = autopilot.hints.by_hand or not autopilot.supported
    if not (by_hand or config.mode_change_allowed or vehicle.mode == autopilot.control_mode):
        yield _way_into_control(autopilot)
    if autopilot.fence is not None:
        yield _fence(config, measured, autopilot.fence)
    yield _mount(config, measured, autopilot)
    yield _satellites(vehicle)
    yield _estimator(vehicle)
    yield _battery(config, vehicle, autopilot)
    if vehicle.landed_state == LANDED_ON_GROUND and math.isfinite(vehicle.position_enu_m[2]):
        yield _ground(config, vehicle)
    yield _phase(vehicle)
    if not _flies(vehicle):
        yield from _waiting(autopilot)


@check("autopilot", "autopilot", _C.AUTOPILOT_UNSUPPORTED)
def _identity(measured: Measured, vehicle: VehicleState, autopilot: Autopilot) -> Finding:
    level, limits = graded(missing=not autopilot.supported), autopilot.hints.limits
    values = {"autopilot": vehicle.autopilot, "version": measured.version}
    found = f"{vehicle.autopilot}, {measured.version or 'version not reported'}{limits and f': {limits}'}"
    return Finding(level, found, supported_titles(), "the bridge flies no other autopilot", values)


def _loss(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Iterator[Finding]:
    settings, meaning = autopilot.loss_settings(measured.settings), autopilot.loss_action
    if settings is None:
        return
    refusal = loss_condition(settings, meaning, config.max_control_timeout_s)
    too_long = refusal is not None and refusal.code in (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG)
    name = settings.timeout_name
    verdict = _loss_timeout(settings, config.max_control_timeout_s, too_long)
    yield verdict.named(name.lower(), name, (_C.TIMEOUT_UNKNOWN, _C.TIMEOUT_TOO_LONG))
    if meaning is not None:
        verdict = _loss_action(settings.action, meaning, refused=refusal is not None and not too_long)
        yield verdict.named(meaning.setting.lower(), meaning.setting, (_C.LOSS_ACTION_FATAL,))


def _loss_timeout(settings: LossSettings, limit_s: float, too_long: bool) -> Finding:
    found, values = _value(settings.timeout_s, " s"), {"value": settings.timeout_s, "limit": limit_s}
    if not limit_s:
        remedy = "set max_control_timeout_s to 0.5: 0 switches the check off"
        return Finding(Level.WARNING, found, "0.5 s", remedy, values)
    remedy = (
        f"set {settings.timeout_name} to {limit_s:g} on the autopilot: so long it flies on after the bridge's death"
    )
    return Finding(graded(missing=too_long), found, f"at most {limit_s:g} s", remedy, values)


def _loss_action(action: float, meaning: LossAction, refused: bool) -> Finding:
    level = graded(missing=refused, warning=True) if action != meaning.hold else Level.OK
    words = f" ({meaning.words[int(action)]})" if action in meaning.words else ""
    wanted = f"{meaning.hold} ({meaning.words[meaning.hold]})"
    remedy = f"set {meaning.setting} to {meaning.hold} on the autopilot: what it does after the bridge's death"
    return Finding(level, _value(action) + words, wanted, remedy, {"value": action})


def _settings(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Iterator[Finding]:
    """A finding for each parameter that was reported: no version of an autopilot has all of them."""
    names = [each.name for each in autopilot.checks]
    if names and not any(name in measured.settings for name in names):
        wanted, remedy = f"good values of {', '.join(names)}", "stop the running bridge and run this again to read them"
        yield Finding(Level.WARNING, "not read", wanted, remedy).named("settings", "autopilot's settings")
        return
    speeds = FlownSpeeds(abs(math.radians(config.angular_speed_deg_s)) * config.radius_m, config.max_speed_m_s)
    for each in autopilot.checks:
        value = measured.setting(each.name)
        if not math.isnan(value) or (each.always and each.name in measured.settings):
            wanted, remedy = (text.format(speeds=speeds) for text in (each.wanted, each.remedy))
            verdict = Finding(each.judge(value, speeds), _value(value), wanted, remedy, {"value": value})
            yield verdict.named(each.name.lower(), each.name)


def _way_into_control(autopilot: Autopilot) -> Finding:
    """Where the pilot cannot enter the control mode by hand, the bridge must be allowed to request it."""
    remedy = f"set mode_change_allowed to true and start by `drocap orbit engage`: {autopilot.hints.engaged}"
    verdict = Finding(Level.MISSING, "mode_change_allowed is false", "true", remedy)
    conditions = (_C.MODE_CHANGE_FORBIDDEN, _C.NOT_IN_CONTROL_MODE)
    return verdict.named("engage", f"way into {autopilot.control_mode}", conditions)


@check("fence", "autopilot's fence")
def _fence(config: MavlinkBridgeConfig, measured: Measured, settings: FenceSettings) -> Finding:
    """The autopilot's own fence against ours."""
    problem, radius_m, height_m = settings.read(measured.setting)
    own_radius_m, own_height_m = config.fence_radius_m, config.max_height_m
    wanted = f"on, beyond ours: {own_radius_m:g} m wide from the subject, {own_height_m:g} m high"
    values = {
        "radius_m": radius_m, "height_m": height_m, "own_radius_m": own_radius_m, "own_height_m": own_height_m,
    }  # fmt: skip
    if not {settings.radius, settings.height} & set(measured.settings):
        remedy = "stop the running bridge and run this again to read it"
        return Finding(Level.WARNING, "not read", wanted, remedy, values)
    if problem:
        sizes = f"{settings.radius} above {own_radius_m:g} and {settings.height} above {own_height_m:g}"
        remedy = f"set {settings.how}, {sizes} on the autopilot: the last guard that needs no companion computer"
        return Finding(Level.WARNING, problem, wanted, remedy, values)
    remedies = []
    # Ours is around the subject at the start, the autopilot's around its home.
    if not radius_m > own_radius_m:
        remedies.append(f"set {settings.radius} above {own_radius_m:g}, or fence_radius_m lower")
    if not height_m > own_height_m:
        remedies.append(f"set {settings.height} above {own_height_m:g}, or max_height_m lower")
    level, found = graded(warning=bool(remedies)), f"{_side(radius_m)} wide, {_side(height_m)} high"
    return Finding(level, found, wanted, "; ".join([*remedies, "a breach there ends in its own action"]), values)


def _side(metres: float) -> str:
    return "unlimited" if metres == 0 else _value(metres, " m")


@check("mount", "mount", *_CAMERA)
def _mount(config: MavlinkBridgeConfig, measured: Measured, autopilot: Autopilot) -> Finding:
    real_hz = measured.streams.get(_MOUNT, Stream(0.0, config.gimbal_hz)).real_hz
    setting = autopilot.mount_type_setting
    number = measured.setting(setting)
    servo = number == autopilot.servo_mount
    kind = config.mount if config.mount != "auto" else "servo" if servo else "gimbal"
    found = f"{kind}, angles at {real_hz:.1f} Hz" + ("" if math.isnan(number) else f", {setting} {number:g}")
    wanted = f"{config.gimbal_hz:g} Hz"
    if kind == "fixed":
        found, wanted = f"fixed, {config.camera_pitch_deg:g} deg against the body", "as built"
        level, remedy = _fixed_camera(config, real_hz)
    elif real_hz > 0:
        level, remedy = _mount_kind(config, kind, real_hz, None if math.isnan(number) else servo)
    else:
        how = f"set its type on the autopilot{autopilot.hints.mount}"
        found, level = "no mount reports its angles", Level.MISSING
        remedy = f"connect the mount and {how}; without one set mount: fixed and camera_pitch_deg"
    problem = next((c for c, share in measured.conditions if c.code in _CAMERA and share > LASTING), None)
    if problem is not None and level != Level.MISSING:
        level, remedy = Level.MISSING, str(problem)
    return Finding(level, found, wanted, remedy, {"kind": kind, "real_hz": real_hz, "type": number})


def _fixed_camera(config: MavlinkBridgeConfig, real_hz: float) -> tuple[Level, str]:
    if real_hz > 0:
        return Level.WARNING, "a mount reports its angles: set mount to auto"
    return graded(warning=config.gimbal_control), "set gimbal_control to false: there is nothing to turn"


def _mount_kind(config: MavlinkBridgeConfig, kind: str, real_hz: float, servo: bool | None) -> tuple[Level, str]:
    """Whether a mount that reports its angles is of its configured kind; ``servo`` None = it is not known."""
    if servo and kind == "gimbal":
        return Level.WARNING, "set mount to servo or auto: the angles of servos are against the body"
    if servo is False and kind == "servo":
        return Level.WARNING, "set mount to gimbal or auto: the angles of this mount are against the horizon"
    slow = real_hz < config.rate_shortfall * config.gimbal_hz
    return graded(warning=slow), "lower gimbal_hz, or raise the rate of the link"


@check("satellites", "satellite fix", _C.NO_SATELLITE_FIX)
def _satellites(vehicle: VehicleState) -> Finding:
    fix, count = vehicle.gps_fix_type, vehicle.satellites
    known = count != SATELLITES_UNKNOWN
    level = graded(missing=fix < 3, warning=known and count < _GOOD_SATELLITES)
    found = _FIXES.get(fix, f"type {fix}") + (f", {count} satellites" if known else "")
    values = {"fix_type": fix, "satellites": count}
    return Finding(level, found, f"3D, {_GOOD_SATELLITES} satellites", "wait, in the open", values)


@check("estimator", "position estimate", _C.ESTIMATOR_UNHEALTHY, _C.VEHICLE_STATE_UNKNOWN)
def _estimator(vehicle: VehicleState) -> Finding:
    found = "healthy" if vehicle.position_ok else "not usable"
    remedy = "wait for the autopilot's estimator; see its messages in the ground station"
    return Finding(graded(missing=not vehicle.position_ok), found, "healthy", remedy)


@check("ground_height_m", "the subject's ground", _C.HEIGHT_CONTRADICTED, _C.TOO_LOW)
def _ground(config: MavlinkBridgeConfig, vehicle: VehicleState) -> Finding:
    """The height that is reported on the ground, where the subject's ground is usually level with it."""
    stands_m, stated_m = float(vehicle.position_enu_m[2]), config.ground_height_m
    found = f"the vehicle stands at {stands_m:.1f} m in the autopilot's frame, ground_height_m is {stated_m:g}"
    remedy = f"set ground_height_m to {stands_m:.1f} where the subject stands as high as the vehicle does now"
    level = graded(warning=abs(stands_m - stated_m) > config.height_error_m)
    return Finding(level, found, f"within {config.height_error_m:g} m", remedy, {"stands_m": stands_m})


@check("battery", "battery", _C.BATTERY_UNKNOWN, _C.BATTERY_LOW)
def _battery(config: MavlinkBridgeConfig, vehicle: VehicleState, autopilot: Autopilot) -> Finding:
    charge, volts = vehicle.battery_fraction, vehicle.battery_voltage_v
    found = _value(volts, " V") if math.isnan(charge) else f"{100 * charge:.0f} %, {_value(volts, ' V')}"
    wanted = f"above {100 * config.min_battery_fraction:.0f} %"
    if config.min_battery_voltage_v:
        wanted += f", {config.min_battery_voltage_v:g} V"
    problem = battery_condition(charge, volts, config)
    remedy = "charge the battery, or correct its capacity on the autopilot"
    if problem is not None and problem.code == _C.BATTERY_UNKNOWN:
        found += ", no charge" if not math.isnan(volts) else ": no battery monitor"
        monitor = f"a battery monitor with a current sensor{autopilot.hints.battery}"
        remedy = f"set up {monitor}, or min_battery_voltage_v to fly by the voltage alone"
    return Finding(graded(missing=problem is not None), found, wanted, remedy, {"fraction": charge, "voltage_v": volts})


@check("phase", "now", _C.NOT_ARMED, _C.NOT_FLYING)
def _phase(vehicle: VehicleState) -> Finding:
    where = _LANDED.get(vehicle.landed_state, "place not reported")
    found = f"{where}, {'armed' if vehicle.armed else 'not armed'}, mode {vehicle.mode}"
    values: Values = {"armed": vehicle.armed, "landed_state": vehicle.landed_state, "mode": vehicle.mode}
    level = Level.OK if _flies(vehicle) else Level.WAITS
    return Finding(level, found, "armed, in the air", "the bridge moves it only there", values)


def _flies(vehicle: VehicleState) -> bool:
    return vehicle.armed and vehicle.landed_state not in LANDED_STATES


def _waiting(autopilot: Autopilot) -> Iterator[Finding]:
    """What can be judged in the air only."""
    rows = (
        ("estimator_flight", "position estimate in flight", "healthy"),
        ("subject", "subject", "located, farther than min_distance_m"),
        ("place", "place and speed", "inside the limits"),
    )
    for code, name, wanted in rows[0 if autopilot.rest_flags else 1 :]:  # at rest the estimator shows nothing of flags
        verdict = Finding(Level.WAITS, "not judged on the ground", wanted, "hover, and see `drocap orbit status`")
        yield verdict.named(code, name)


def _value(value: float, unit: str = "") -> str:
    return "not reported" if math.isnan(value) else f"{value:.6g}{unit}"
