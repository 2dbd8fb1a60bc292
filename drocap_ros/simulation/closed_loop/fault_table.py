"""Table of the faults in flight, by the part that fails.

``benchmarks/flight_faults.py`` flies all of them with both autopilots.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Action, Command, OperatorCommand, State
from drocap_ros.observation import PoseObservation
from drocap_ros.simulation.closed_loop.fault_causes import (
    DELAY_S,
    DELAYED,
    ECHO_S,
    FRAME_S,
    HEARTBEAT_S,
    JUMPED,
    LINK_S,
    LOSSY,
    MODE,
    PILOT,
    TAKEN_S,
    TIMEOUT,
)
from drocap_ros.simulation.closed_loop.fault_flight import FAULT_S, Fault, Injection, start
from drocap_ros.simulation.closed_loop.orbit_loop import LoopSettings, OrbitLoop, with_config

_C = ConditionCode
_LOCATED = (_C.SUBJECT_OUTDATED, _C.NO_SUBJECT)
_TELEMETRY = (
    _C.POSITION_FROZEN, _C.ATTITUDE_OUTDATED, _C.LINK_SILENT, _C.ROUND_TRIP_TOO_LONG, _C.SETPOINTS_NOT_FOLLOWED,
)  # fmt: skip
_TAKEN = (_C.PILOT_TOOK_OVER,)
_STALLED = _C.CONTROL_LOOP_STALLED
_RESTARTED = (_C.ALL_CLEAR, _C.TIMEOUT_UNKNOWN)
_LANDING = mavlink.MAV_LANDED_STATE_LANDING


def _assign(owner: str = "", **values: Any) -> Injection:
    """Set attributes of the loop, or of its part ``owner``: "copter", "down", "up", or "link" for both directions."""

    def inject(loop: OrbitLoop) -> None:
        parts = [loop.down, loop.up] if owner == "link" else [getattr(loop, owner) if owner else loop]
        for part in parts:
            for name, value in values.items():
                setattr(part, name, value)

    return inject


def _perceived(fields: Callable[[PoseObservation], dict[str, Any]]) -> Injection:
    """Replace fields of each observation."""
    return _assign(perceive=lambda seen: dataclasses.replace(seen, **fields(seen)))


def _shifted(seen: PoseObservation, pixels: float) -> np.ndarray:
    return seen.keypoints + np.array([pixels, 0], np.float32)


def _freeze(loop: OrbitLoop) -> None:
    kept: list[PoseObservation] = []

    def change(seen: PoseObservation) -> PoseObservation:
        kept.append(seen)
        return dataclasses.replace(kept[0], stamp_ns=seen.stamp_ns)

    loop.perceive = change


def _lose_half(loop: OrbitLoop) -> None:
    chance = random.Random(1)
    loop.perceive = lambda seen: seen if chance.random() < 0.5 else None


def _restart(loop: OrbitLoop) -> None:
    loop.stopped = False
    loop.restart()


def _foreign_system(loop: OrbitLoop) -> None:
    """Packets of another vehicle: disarmed, in LAND, far away."""
    other = mavlink.MAVLink(None, srcSystem=42, srcComponent=1)
    for i in range(400):
        packets = other.heartbeat_encode(2, 3, 1, 9, 4), other.local_position_ned_encode(i, 500, 0, 0, 0, 0, 0)
        for packet in packets:
            loop.down.write(packet.pack(other))


def _begins(name: str) -> Injection:
    """A failure of the copter that begins now."""
    return lambda loop: setattr(loop.copter, name, loop.t)


def _restart_clock(loop: OrbitLoop) -> None:
    loop.copter.boot_s -= 25.0


def _jump(loop: OrbitLoop) -> None:
    """A GPS glitch of 15 m that the autopilot accepts."""
    loop.copter.gps_error = loop.copter.gps_error + np.array([12.0, -9.0, 0.0])


def _pilot(ardupilot: str, px4: str = "") -> Injection:
    """The pilot switches the mode; its name for ArduPilot, and for PX4 where that differs."""

    def inject(loop: OrbitLoop) -> None:
        loop.copter.set_mode(px4 if px4 and loop.settings.autopilot == "px4" else ardupilot, "pilot")

    return inject


def _command(kind: Command) -> Injection:
    return lambda loop: loop.command(kind)


def _storm(loop: OrbitLoop) -> None:
    chance = random.Random(7)
    for _ in range(500):
        loop.command(chance.choice(list(Command)), radius_m=chance.uniform(-50, 50), height_m=chance.uniform(-5, 50))


def _old_commands(loop: OrbitLoop) -> None:
    """Commands with stamps 3 to 200 s in the past, as from a replayed recording."""
    for age_s in range(3, 200):
        stamp_ns = loop.clock_ns() - age_s * 10**9
        for kind in (Command.START, Command.ENGAGE, Command.ADJUST):
            loop.controller.command(OperatorCommand(int(kind), 9.0, 3.0, -19.0, stamp_ns))


def _invalid_commands(loop: OrbitLoop) -> None:
    """Unknown numbers, values out of range."""
    for number in (-1, 4, 77, 255):
        for value in (float("nan"), float("inf"), -1e30, 0.0):
            loop.controller.command(OperatorCommand(number, value, value, value))
    for value in (-5.0, 0.0, 1e30, float("inf")):
        loop.controller.command(OperatorCommand(int(Command.ADJUST), radius_m=value))


def _walk_to_vehicle(loop: OrbitLoop) -> None:
    joints = loop.future_joints()
    way = loop.copter.body.position[:2] - joints[0, 0, :2]
    length = float(np.hypot(*way))
    joints[:, :, :2] += (np.minimum(_steps_m(loop), length)[:, None] * way / length)[:, None]


def _walk_east(loop: OrbitLoop) -> None:
    loop.future_joints()[:, :, 0] += _steps_m(loop)[:, None]


def _steps_m(loop: OrbitLoop) -> np.ndarray:
    """Distance walked at each future frame, at 1.4 m/s."""
    return np.arange(len(loop.future_joints())) / loop.settings.perception_hz * 1.4


_LOSE_SUBJECT = _assign(perceive=lambda seen: None)
_DENY_HOLD = _assign("copter", denied_modes=frozenset({"BRAKE", "LOITER"}))
_DENY_CONTROL = _assign("copter", denied_modes=frozenset({"GUIDED", "OFFBOARD"}))
_TO_CONTROL, _TO_POSITION = _pilot("GUIDED", "OFFBOARD"), _pilot("LOITER", "POSCTL")
_STOP, _ENGAGE = _command(Command.STOP), _command(Command.ENGAGE)


def _stick_mode(settings: LoopSettings) -> LoopSettings:
    return dataclasses.replace(settings, start_mode="ALTCTL" if settings.autopilot == "px4" else "ALT_HOLD")


def _short_timeouts(settings: LoopSettings) -> LoopSettings:
    return dataclasses.replace(settings, guid_timeout_s=0.3, offboard_loss_s=0.3)


def _shipped_timeouts(settings: LoopSettings) -> LoopSettings:
    """Time-outs as the autopilots ship: a flight only with the operator's permission."""
    settings = with_config(settings, max_control_timeout_s=0.0)
    return dataclasses.replace(settings, guid_timeout_s=3.0, offboard_loss_s=1.0)


def _same_radius(loop: OrbitLoop) -> str:
    assert loop.status is not None
    radius_m = loop.status.radius_m - loop.status.radius_error_m
    return "" if abs(radius_m - loop.settings.config.radius_m) < 1e-6 else f"the radius became {radius_m:g} m"


def _inside_fence(loop: OrbitLoop) -> str:
    centre = loop.pelvis(FAULT_S - 4.0)[:2]
    farthest = max(float(np.linalg.norm(row.position[:2] - centre)) for row in loop.rows)
    limit = loop.settings.config.fence_radius_m
    # The bridge keeps the fence by its estimates, and about the estimated position of the subject.
    return "" if farthest < limit + 1.0 else f"{farthest:.1f} m from the start of the orbit, fence {limit:g} m"


def _no_orbit(loop: OrbitLoop) -> str:
    orbiting = any(row.action == Action.ORBIT for row in loop.rows if row.t_s > FAULT_S)
    return "the orbit was commanded after the fault" if orbiting else ""


def _perception(name: str, inject: Injection) -> Fault:
    return Fault(name, inject, FRAME_S, codes=_LOCATED)


def _process(name: str, **values: Any) -> Fault:
    """The process stops: only the autopilot's time-out can end the motion."""
    return Fault(name, _assign(stopped=True), LINK_S, cause=TIMEOUT, **values)


def _link(name: str, owner: str, fault: dict[str, Any], **values: Any) -> Fault:
    return Fault(name, _assign(owner, **fault), LINK_S, **{"codes": _TELEMETRY, **values})


def _taking_over(name: str, inject: Injection, **values: Any) -> Fault:
    return Fault(name, inject, HEARTBEAT_S, cause=MODE, codes=_TAKEN, **values)


def _in_state(name: str, inject: Injection, state: State, *before: tuple[float, Injection], **values: Any) -> Fault:
    """A mode change by the pilot in another state: the bridge must not move the vehicle afterwards."""
    values = {"codes": _TAKEN, **values}
    return Fault(name, inject, HEARTBEAT_S, before=before, state=state, check=_no_orbit, **values)


_PERCEPTION = (
    _perception("perception stops", _LOSE_SUBJECT),
    _perception("perception finds no subject", _perceived(lambda seen: {"track_id": 0})),
    _perception("keypoints jump by 400 px", _perceived(lambda seen: {"keypoints": _shifted(seen, 400)})),
    _perception("keypoints are NaN", _perceived(lambda seen: {"keypoints": seen.keypoints * np.float32(np.nan)})),
    _perception("image frozen, stamps continue", _freeze),
    _perception(
        "another person, by its track", _perceived(lambda seen: {"keypoints": _shifted(seen, 150), "track_id": 2})
    ),
    _perception("another person 2 m aside, same track", _perceived(lambda seen: {"keypoints": _shifted(seen, 370)})),
    _perception("perception 1 s late", _perceived(lambda seen: {"stamp_ns": seen.stamp_ns - 10**9})),
    _perception("stamps 5 s in the future", _perceived(lambda seen: {"stamp_ns": seen.stamp_ns + 5 * 10**9})),
    Fault("every other image lost", _lose_half, harmless=True),
)
_PROCESS = (
    _process("process killed (SIGKILL)"),
    _process("process killed, time-outs of 0.3 s", change=_short_timeouts),
    _process("process killed, time-outs as shipped", change=_shipped_timeouts),
    _process("process stopped for 3 s (SIGSTOP)", later=(3.0, _assign(stopped=False)), codes=(_STALLED, *_TAKEN)),
    _process("process restarts after 1 s", later=(1.0, _restart), check=_no_orbit, codes=_RESTARTED),
    Fault("process restarts at once", _restart, LINK_S, cause=TIMEOUT, check=_no_orbit),
    Fault("control loop hangs", _assign(hung=True)),
    Fault("control loop hangs for 1 s", _assign(hung=True), later=(1.0, _assign(hung=False)), codes=(_STALLED,)),
    Fault("clock jumps 3 s ahead", _assign(clock_jump_s=3.0), LINK_S, codes=(_C.CLOCK_JUMPED,)),
    Fault("clock jumps 3 s back", _assign(clock_jump_s=-3.0), LINK_S, codes=(_C.CLOCK_JUMPED,)),
)
_LINK = (
    _link("link lost", "link", {"cut": True}, cause=TIMEOUT),
    _link("link lost for 2 s", "link", {"cut": True}, cause=TIMEOUT, later=(2.0, _assign("link", cut=False)), codes=()),
    _link("downlink lost", "down", {"cut": True}),
    _link("uplink lost", "up", {"cut": True}, cause=TIMEOUT, codes=(*_TELEMETRY, *_TAKEN)),
    _link("link delayed by 1 s", "link", {"delay_s": DELAY_S}, cause=DELAYED, codes=(*_TELEMETRY, *_TAKEN)),
    _link("downlink delayed by 1 s", "down", {"delay_s": DELAY_S}),
    _link("uplink delayed by 1 s", "up", {"delay_s": DELAY_S}, cause=DELAYED, codes=(*_TELEMETRY, *_TAKEN)),
    Fault("30 % loss", _assign("link", loss=0.3), harmless=True),
    _link("80 % loss", "link", {"loss": 0.8}, cause=LOSSY, codes=(*_TELEMETRY, *_LOCATED, *_TAKEN)),
    Fault("every packet twice", _assign("link", duplicate=1.0), harmless=True),
    Fault("packets out of order", _assign("link", jitter_s=0.08), harmless=True),
    Fault("a foreign system on the link", _foreign_system, harmless=True),
    _link("telemetry frozen, clock continues", "copter", {"frozen": True}),
    _link("telemetry frozen with its clock", "copter", {"frozen": True, "frozen_clock": True}),
)
_VEHICLE = (
    Fault("GPS lost", _begins("gps_lost_s"), 0.4 + HEARTBEAT_S, codes=(_C.NO_SATELLITE_FIX,)),
    Fault("estimator fails", _begins("ekf_failed_s"), HEARTBEAT_S, codes=(_C.ESTIMATOR_UNHEALTHY, *_TAKEN)),
    Fault("battery at 10 %", _assign("copter", battery=10), HEARTBEAT_S, codes=(_C.BATTERY_LOW,)),
    Fault("battery unknown", _assign("copter", battery=-1), HEARTBEAT_S, codes=(_C.BATTERY_UNKNOWN,)),
    Fault("landing reported", _assign("copter", landed_state=_LANDING), HEARTBEAT_S, codes=(_C.NOT_FLYING,)),
    _taking_over("the autopilot's own fence is breached", _assign("copter", fence_m=0.5)),
    Fault("the autopilot's clock restarts", _restart_clock, harmless=True),
    Fault("the autopilot's position jumps by 15 m", _jump, LINK_S, cause=JUMPED, codes=(_C.POSITION_JUMPED,)),
    Fault("setpoints ignored", _assign("copter", deaf=True), ECHO_S, codes=(_C.SETPOINTS_NOT_FOLLOWED, *_TAKEN)),
    Fault(
        "hold mode denied", _LOSE_SUBJECT, FRAME_S, before=((0.0, _DENY_HOLD), (4.0, start)),
        codes=(_C.HOLD_MODE_MISSING,),
    ),
)  # fmt: skip
_PILOT = (
    _taking_over("pilot takes LOITER (POSCTL)", _TO_POSITION),
    _taking_over("pilot takes ALT_HOLD (ALTCTL)", _pilot("ALT_HOLD", "ALTCTL")),
    _taking_over("pilot takes LAND", _pilot("LAND")),
    _taking_over("pilot takes RTL", _pilot("RTL")),
    _taking_over("pilot takes over and gives back", _TO_POSITION, later=(2.0, _TO_CONTROL)),
    Fault(
        "pilot takes over during a hold", _LOSE_SUBJECT, FRAME_S, cause=PILOT, codes=_TAKEN,
        later=(TAKEN_S, _TO_POSITION),
    ),
    _in_state("pilot takes control while idle", _TO_CONTROL, State.IDLE, (0.0, _LOSE_SUBJECT), codes=_LOCATED),
    _in_state("pilot takes position while ready", _TO_POSITION, State.READY, codes=()),
    _in_state(
        "pilot takes position while engaging", _TO_POSITION, State.READY, (0.0, _DENY_CONTROL),
        (FAULT_S - 1.6, _ENGAGE), change=_stick_mode,
    ),
    _in_state(
        "pilot takes position while holding", _TO_POSITION, State.HOLDING, (4.0, start), (FAULT_S - 1.5, _STOP)
    ),
    _in_state(
        "pilot takes position while in fault", _TO_POSITION, State.FAULT, (0.0, _DENY_HOLD), (3.0, start), (5.5, _STOP)
    ),
    _in_state(
        "pilot takes control while taken over", _TO_CONTROL, State.TAKEN_OVER, (4.0, start),
        (FAULT_S - 3.0, _TO_POSITION),
    ),
)  # fmt: skip
_OPERATOR = (
    Fault("storm of 500 commands", _storm, codes=(_C.STOPPED,)),
    Fault("commands of the past", _old_commands, harmless=True, check=_same_radius),
    Fault("invalid commands", _invalid_commands, harmless=True, check=_same_radius),
)
_SUBJECT = (
    Fault("subject walks towards the vehicle", _walk_to_vehicle, harmless=True),
    Fault(
        "subject leaves the fence", _walk_east, harmless=True, codes=(_C.AT_FENCE,), check=_inside_fence,
        change=lambda settings: with_config(settings, fence_radius_m=9.0),
    ),
)  # fmt: skip

FAULTS: tuple[Fault, ...] = (*_PERCEPTION, *_PROCESS, *_LINK, *_VEHICLE, *_PILOT, *_OPERATOR, *_SUBJECT)
