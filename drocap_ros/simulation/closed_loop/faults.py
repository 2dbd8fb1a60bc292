"""Faults in flight, one at a time, in the closed loop: how soon commanded motion ends, and how far the vehicle goes.

Every case says before it is flown what must hold: the bounds of the protocol, or, where a mechanism outside the
bridge decides, a :class:`Cause` with the bounds that follow from it and the evidence that it was at work.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.orbit.controller import OperatorCommand
from drocap_ros.flight.orbit.safety import Action, Command, State
from drocap_ros.observation import PoseObservation
from drocap_ros.simulation.closed_loop.orbit_loop import LoopSettings, OrbitLoop, with_config

FAULT_S = 14.0
MOTION_S, EXCURSION_M = 0.5, 2.5
_WATCH_S = 7.0
_FRAME_S = 0.17  # the next picture and its way: then a fault of perception can be seen
_HEARTBEAT_S = 0.21  # mode and status come five times a second
_LINK_S = 0.05  # the next setpoint, or the next telemetry, stays away
_ECHO_S = 0.65  # the simulated autopilot repeats its echo for 0.5 s, ten times a second
_DRIFT_M = 0.3  # of the position estimate while the vehicle stops: 0.4 m with a time constant of 20 s
_MAX_ACCELERATION = 4.5  # of the simulated vehicle, m/s^2
#: Measured stops from 2 m/s, m: a position setpoint, LOITER (taken for PX4's hold mode too), BRAKE.
_POSITION_STOP_M, _LOITER_STOP_M, _BRAKE_STOP_M = 1.5, 2.0, 3.4


class FaultResult(NamedTuple):
    """What a fault did.

    motion_s : how long after the fault became observable setpoints still moved the vehicle; < 0 = sooner
    excursion_m : horizontal, from where it was when the fault became observable
    speed_m_s : flown at that time, or asked for by the last setpoint: the greater
    least_distance_m : to the person, from the fault on
    resumed : whether motion was commanded again without the operator
    evident : whether the case's cause was the mechanism that ended the motion
    broken : what else did not hold, in words
    """

    motion_s: float
    excursion_m: float
    speed_m_s: float
    least_distance_m: float
    resumed: bool
    evident: bool
    broken: str
    state: State
    reason: str


class Bounds(NamedTuple):
    """What must hold: s after the fault became observable, and m from there."""

    motion_s: float = MOTION_S
    excursion_m: float = EXCURSION_M


class Flight(NamedTuple):
    """A flown case: steps of the control loop since the fault was made, with the setpoints accepted until each."""

    loop: OrbitLoop
    times: list[float]
    accepted: list[int]
    orbit_until_s: float  # last step that commanded the orbit
    motion_until_s: float


@dataclass(frozen=True)
class Cause:
    """A mechanism that is not ours and decides how the case ends.

    words : what it is
    bounds : what follows from it, by the settings and the speed, m/s, when the fault became observable
    at_work : whether it was it that ended the motion
    """

    words: str
    bounds: Callable[[LoopSettings, float], Bounds]
    at_work: Callable[[Flight], bool]


def _orbit(loop: OrbitLoop) -> None:
    loop.start()
    loop.run(FAULT_S)


@dataclass(frozen=True)
class Fault:
    """One case.

    inject : makes the fault
    observable_s : when it can be seen at the earliest by who is to act on it, after it was made
    harmless : the orbit may go on
    cause : the mechanism that decides, where it is not the bridge
    says : words of which the reason must hold one at the end
    change : settings of the flight
    later : what happens so long after the fault
    begin, state : how the loop comes to the fault, and the state that it is in then
    check : what else must hold, "" or what does not
    """

    name: str
    inject: Callable[[OrbitLoop], None]
    observable_s: float = 0.0
    harmless: bool = False
    cause: Cause | None = None
    says: tuple[str, ...] = ()
    change: Callable[[LoopSettings], LoopSettings] = lambda settings: settings
    later: tuple[tuple[float, Callable[[OrbitLoop], None]], ...] = ()
    begin: Callable[[OrbitLoop], None] = _orbit
    state: State = State.ORBITING
    check: Callable[[OrbitLoop], str] = field(default=lambda loop: "")

    def bounds(self, settings: LoopSettings, speed_m_s: float) -> Bounds:
        """Those of this case, stated before it is flown."""
        return Bounds() if self.cause is None else self.cause.bounds(settings, speed_m_s)


def settings_of(fault: Fault, autopilot: str, seed: int = 4) -> LoopSettings:
    """Settings of a case's flight."""
    return fault.change(LoopSettings(autopilot=autopilot, seed=seed, seconds=FAULT_S + _WATCH_S + 1.0))


def fly_fault(fault: Fault, autopilot: str, seed: int = 4) -> FaultResult:
    """Come to the state, make the fault at ``FAULT_S``, watch.

    Raises
    ------
    AssertionError
        When the flight is not in the case's state before the fault.
    """
    loop = OrbitLoop(settings_of(fault, autopilot, seed))
    fault.begin(loop)
    loop.run(FAULT_S)
    safety = loop.controller.safety
    if safety.state != fault.state:
        raise AssertionError(f"{fault.name}: {safety.state.name} before the fault: {safety.reason}")
    times: list[float] = []
    accepted: list[int] = []

    def watch(loop: OrbitLoop) -> None:
        times.append(loop.t)
        accepted.append(loop.copter.accepted_setpoints)

    fault.inject(loop)
    begin = len(loop.rows)
    loop.run(FAULT_S + fault.observable_s, watch)
    place = loop.copter.body.position.copy()
    speed = max(float(np.linalg.norm(v)) for v in (loop.copter.body.velocity, loop.copter._target.velocity))
    observed_s, first = loop.t, len(loop.rows)
    for after_s, action in fault.later:
        loop.run(FAULT_S + after_s, watch)
        action(loop)
    loop.run(FAULT_S + _WATCH_S, watch)
    rows = loop.rows[first:]
    away = [float(np.linalg.norm(row.position[:2] - place[:2])) for row in rows]
    actions = [row.action for row in loop.rows[begin:]]
    moved = [i for i, a in enumerate(actions) if a == Action.ORBIT]
    ended = next((i for i, a in enumerate(actions) if a != Action.ORBIT), len(actions))
    until = loop.rows[begin + moved[-1]].t_s if moved else FAULT_S
    flight = Flight(loop, times, accepted, until, loop.copter.motion_until_s)
    return FaultResult(
        loop.copter.motion_until_s - observed_s, max(away), speed, min(row.distance_m for row in rows),
        Action.ORBIT in actions[ended:], fault.cause is None or fault.cause.at_work(flight), fault.check(loop),
        loop.controller.safety.state, loop.controller.safety.reason,
    )  # fmt: skip


def failures(fault: Fault, autopilot: str, result: FaultResult) -> list[str]:
    """What does not hold of what the case states, in words."""
    found = [result.broken] if result.broken else []
    if result.resumed:
        found.append("motion was commanded again without the operator")
    if fault.says and not any(word in result.reason for word in fault.says):
        found.append(f"the reason does not say {' or '.join(fault.says)}")
    if result.least_distance_m <= 3.0:
        found.append(f"came to {result.least_distance_m:.2f} m of the person")
    if fault.harmless:
        return found
    bounds = fault.bounds(settings_of(fault, autopilot), result.speed_m_s)
    if result.motion_s > bounds.motion_s:
        found.append(f"motion for {result.motion_s:.2f} s, bound {bounds.motion_s:.2f} s")
    if result.excursion_m >= bounds.excursion_m:
        found.append(f"excursion of {result.excursion_m:.2f} m, bound {bounds.excursion_m:.2f} m")
    if fault.cause is not None and not result.evident and not keeps(result):
        found.append("the stated cause was not at work")
    return found


def keeps(result: FaultResult) -> bool:
    """Whether the bounds of the protocol hold: 0.5 s, 2.5 m, no motion again by itself."""
    return result.motion_s <= MOTION_S and result.excursion_m < EXCURSION_M and not result.resumed


# -- causes --------------------------------------------------------------------------------------------


def _scaled(stop_m: float, speed: float) -> float:
    """A stop measured from 2 m/s, from another speed: between linear (lag) and quadratic (deceleration)."""
    return stop_m * max(speed / 2, (speed / 2) ** 2)


def _timeout_s(settings: LoopSettings) -> float:
    return settings.guid_timeout_s if settings.autopilot == "ardupilot" else settings.offboard_loss_s


def _timeout_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The last setpoint is flown for the time-out, then ArduPilot holds a place and PX4 changes to its hold mode."""
    flown_s = _timeout_s(settings) + 0.02
    stop_m = _POSITION_STOP_M if settings.autopilot == "ardupilot" else _LOITER_STOP_M
    return Bounds(max(flown_s, MOTION_S), speed * flown_s + _scaled(stop_m, speed) + _DRIFT_M)


def _nothing_arrived(flight: Flight) -> bool:
    """No setpoint was accepted between the fault and the end of the motion."""
    during = [
        count for t, count in zip(flight.times, flight.accepted, strict=True)
        if FAULT_S + 0.06 <= t <= flight.motion_until_s
    ]  # fmt: skip
    return len(during) > 0 and during[0] == during[-1]


_DELAY_S = 1.0


def _delay_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Nothing arrives for the delay: the time-out acts; then all comes that was sent before the delay was noticed.

    It is noticed by the age of telemetry or, if only the way up is late, by answers that stay away.
    """
    noticed_s = settings.config.max_round_trip_s + 1.0 / settings.config.time_sync_hz + 1.0 / settings.config.control_hz
    alone = _timeout_bounds(settings, speed)
    return Bounds(_DELAY_S + noticed_s, alone.excursion_m + speed * noticed_s)


def _all_in_the_pipe(flight: Flight) -> bool:
    """We had ended the orbit as soon as it could be noticed; what moved the vehicle later was on its way then."""
    noticed = flight.orbit_until_s - FAULT_S <= MOTION_S + 0.2
    return noticed and flight.motion_until_s - flight.orbit_until_s <= _DELAY_S + 0.1


def _lossy_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Most words are lost, the hold too; what arrived last is flown for the time-out."""
    noticed_s = settings.config.max_state_age_s + 2.0 / settings.config.control_hz
    alone = _timeout_bounds(settings, speed)
    return Bounds(noticed_s + alone.motion_s, alone.excursion_m + speed * noticed_s)


def _reacted(flight: Flight) -> bool:
    """We had ended the orbit within the bound of the protocol."""
    return flight.orbit_until_s - FAULT_S <= MOTION_S


def _jump_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Until the jump is told and the hold has come, the autopilot makes for the old setpoint with all it has."""
    pulled_s = 0.15
    speed += _MAX_ACCELERATION * pulled_s
    return Bounds(MOTION_S, speed * pulled_s + _scaled(_POSITION_STOP_M, speed) + _DRIFT_M)


_TAKEN_S = 0.8


def _mode_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Nothing of ours is obeyed; the mode stops the vehicle, at the latest like the slowest that was measured."""
    return Bounds(MOTION_S, _scaled(_BRAKE_STOP_M, speed) + _DRIFT_M)


def _pilot_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The hold has begun; the pilot's mode stops the rest of the speed by its own deceleration, at most all of it."""
    return Bounds(MOTION_S, speed * (_TAKEN_S - _FRAME_S) + _scaled(_LOITER_STOP_M, speed) + _DRIFT_M)


def _another_flies(flight: Flight) -> bool:
    """The last mode was somebody else's choice, and we had ended the orbit in time and stayed silent."""
    by = flight.loop.copter.mode_log[-1][2]
    silent = flight.loop.controller.safety.state == State.TAKEN_OVER
    return silent and (by == "pilot" or by.startswith("failsafe")) and _reacted(flight)


TIMEOUT = Cause("no word of ours arrives: the autopilot's own time-out ends it", _timeout_bounds, _nothing_arrived)
DELAYED = Cause("setpoints in the delayed link cannot be called back", _delay_bounds, _all_in_the_pipe)
LOSSY = Cause("the hold was lost on the way like most else: the autopilot's time-out", _lossy_bounds, _reacted)
JUMPED = Cause("the autopilot makes for the setpoint from before its jump until the hold comes", _jump_bounds, _reacted)
MODE = Cause("the mode that the pilot or the autopilot chose brakes in its own way", _mode_bounds, _another_flies)
PILOT = Cause("the pilot's own mode brakes, not the hold", _pilot_bounds, _another_flies)


# -- what is done to the flight ------------------------------------------------------------------------


def _perceive(change: Callable[[PoseObservation], PoseObservation | None]) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        loop.perceive = change

    return inject


def _shifted(seen: PoseObservation, pixels: float, track_id: int = 1) -> PoseObservation:
    return dataclasses.replace(seen, keypoints=seen.keypoints + np.array([pixels, 0], np.float32), track_id=track_id)


def _freeze(loop: OrbitLoop) -> None:
    kept: list[PoseObservation] = []

    def change(seen: PoseObservation) -> PoseObservation:
        kept.append(seen)
        return dataclasses.replace(kept[0], stamp_ns=seen.stamp_ns)

    loop.perceive = change


def _half(loop: OrbitLoop) -> None:
    chance = random.Random(1)
    loop.perceive = lambda seen: seen if chance.random() < 0.5 else None


def _set(**values: Any) -> Callable[[OrbitLoop], None]:
    """Set attributes by their path: ``copter_battery=5`` sets ``loop.copter.battery``."""

    def inject(loop: OrbitLoop) -> None:
        for name, value in values.items():
            owner, _, attribute = name.partition("__")
            if attribute:
                setattr(getattr(loop, owner), attribute, value)
            else:
                setattr(loop, owner, value)

    return inject


def _both(**values: Any) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        for channel in (loop.down, loop.up):
            for name, value in values.items():
                setattr(channel, name, value)

    return inject


def _mode(mode: str, px4: str = "") -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        loop.copter.set_mode(px4 if px4 and loop.settings.autopilot == "px4" else mode, "pilot")

    return inject


def _at(name: str) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        setattr(loop.copter, name, loop.t)

    return inject


def _restart(loop: OrbitLoop) -> None:
    loop.stopped = False
    loop.restart()


def _storm(loop: OrbitLoop) -> None:
    chance = random.Random(7)
    for _ in range(500):
        loop.command(chance.choice(list(Command)), radius_m=chance.uniform(-50, 50), height_m=chance.uniform(-5, 50))


def _foreign(loop: OrbitLoop) -> None:
    """Another vehicle on the same link says that it is in LAND, disarmed, elsewhere."""
    other = mavlink.MAVLink(None, srcSystem=42, srcComponent=1)
    for i in range(400):
        packets = other.heartbeat_encode(2, 3, 1, 9, 4), other.local_position_ned_encode(i, 500, 0, 0, 0, 0, 0)
        for packet in packets:
            loop.down.write(packet.pack(other))


def _walk_into(loop: OrbitLoop) -> None:
    """The person walks straight to where the vehicle is."""
    here = loop.copter.body.position[:2]
    first = int(loop.t * loop.settings.perception_hz)
    way = here - loop._joints[first, 0, :2]
    length = float(np.hypot(*way))
    steps = np.arange(len(loop._joints) - first) / loop.settings.perception_hz * 1.4
    loop._joints[first:, :, :2] += (np.minimum(steps, length)[:, None] * way / length)[:, None]


def _walk_away(loop: OrbitLoop) -> None:
    first = int(loop.t * loop.settings.perception_hz)
    steps = np.arange(len(loop._joints) - first) / loop.settings.perception_hz * 1.4
    loop._joints[first:, :, 0] += steps[:, None]


def _deny_hold(loop: OrbitLoop) -> None:
    loop.copter.denied_modes = frozenset({"BRAKE", "LOITER"})
    loop.perceive = lambda seen: None


def _pilot_modes(loop: OrbitLoop) -> tuple[str, str]:
    """(a mode that is not control, control) by this autopilot's names."""
    return ("POSCTL", "OFFBOARD") if loop.settings.autopilot == "px4" else ("LOITER", "GUIDED")


def _to_control(loop: OrbitLoop) -> None:
    loop.copter.set_mode(_pilot_modes(loop)[1], "pilot")


def _to_position(loop: OrbitLoop) -> None:
    loop.copter.set_mode(_pilot_modes(loop)[0], "pilot")


def _wait(loop: OrbitLoop) -> None:
    loop.run(FAULT_S)


def _engage(loop: OrbitLoop) -> None:
    """Control is asked for and not granted yet."""
    loop.copter.denied_modes = frozenset({"GUIDED", "OFFBOARD"})
    loop.run(FAULT_S - 1.6)
    loop.command(Command.ENGAGE)
    loop.run(FAULT_S)


def _held(loop: OrbitLoop) -> None:
    loop.start()
    loop.run(FAULT_S - 1.5)
    loop.command(Command.STOP)
    loop.run(FAULT_S)


def _failed(loop: OrbitLoop) -> None:
    """A hold whose mode never came."""
    loop.copter.denied_modes = frozenset({"BRAKE", "LOITER"})
    loop.start(3.0)
    loop.run(5.5)
    loop.command(Command.STOP)
    loop.run(FAULT_S)


def _taken(loop: OrbitLoop) -> None:
    loop.start()
    loop.run(FAULT_S - 3.0)
    _to_position(loop)
    loop.run(FAULT_S)


def _blind(loop: OrbitLoop) -> None:
    loop.perceive = lambda seen: None
    loop.run(FAULT_S)


def _old_commands(loop: OrbitLoop) -> None:
    """A recording of commands is played again."""
    for age_s in range(3, 200):
        stamp_ns = loop.clock_ns() - age_s * 10**9
        for kind in (Command.START, Command.ENGAGE, Command.ADJUST):
            loop.controller.command(OperatorCommand(int(kind), 9.0, 3.0, -19.0, stamp_ns))


def _senseless(loop: OrbitLoop) -> None:
    for number in (-1, 4, 77, 255):
        for value in (float("nan"), float("inf"), -1e30, 0.0):
            loop.controller.command(OperatorCommand(number, value, value, value))
    for value in (-5.0, 0.0, 1e30, float("inf")):
        loop.controller.command(OperatorCommand(int(Command.ADJUST), radius_m=value))


def _still_6_m(loop: OrbitLoop) -> str:
    goal = loop.controller._goal
    return "" if goal.radius_m == loop.settings.config.radius_m else f"the radius became {goal.radius_m:g} m"


def _inside_fence(loop: OrbitLoop) -> str:
    centre = loop.pelvis(FAULT_S - 4.0)[:2]
    farthest = max(float(np.linalg.norm(row.position[:2] - centre)) for row in loop.rows)
    limit = loop.settings.config.fence_radius_m
    # The fence is kept by the estimate, and its centre is where the subject was believed to be.
    return "" if farthest < limit + 1.0 else f"{farthest:.1f} m from where the orbit began, fence {limit:g} m"


def _reboot(loop: OrbitLoop) -> None:
    """The autopilot's time since boot begins again: its stamps jump back."""
    loop.copter._boot_s -= 25.0


def _jump(loop: OrbitLoop) -> None:
    """The autopilot's position estimate jumps: a glitch of GPS that it takes over."""
    loop.copter._gps_error = loop.copter._gps_error + np.array([12.0, -9.0, 0.0])


def _never_moved(loop: OrbitLoop) -> str:
    moved = any(row.action == Action.ORBIT for row in loop.rows if row.t_s > FAULT_S)
    return "the orbit was commanded after the fault" if moved else ""


def _pilot(state: str, begin: Callable[[OrbitLoop], None], where: State, mode: str, **values: Any) -> Fault:
    """A mode change by the pilot in some state: nothing of ours may move the vehicle afterwards."""
    inject = _to_control if mode == "control" else _to_position
    return Fault(
        f"pilot takes {mode} while {state}", inject, _HEARTBEAT_S, begin=begin, state=where, check=_never_moved,
        **values,
    )  # fmt: skip


def _by_hand(settings: LoopSettings) -> LoopSettings:
    return dataclasses.replace(settings, start_mode="ALTCTL" if settings.autopilot == "px4" else "ALT_HOLD")


def _short(settings: LoopSettings) -> LoopSettings:
    return dataclasses.replace(settings, guid_timeout_s=0.3, offboard_loss_s=0.3)


def _shipped(settings: LoopSettings) -> LoopSettings:
    """Time-outs as the autopilots ship: flown only because the operator says that it is no matter."""
    settings = with_config(settings, max_control_timeout_s=0.0)
    return dataclasses.replace(settings, guid_timeout_s=3.0, offboard_loss_s=1.0)


_LOCATED = ("last located", "no subject is tracked")
_TOLD = ("telemetry lost or frozen", "attitude is", "nothing heard", "answered nothing", "echoed")
_TAKEN = ("the pilot has taken over",)

FAULTS: tuple[Fault, ...] = (
    Fault("perception stops", _perceive(lambda seen: None), _FRAME_S, says=_LOCATED),
    Fault(
        "perception says there is nobody", _perceive(lambda s: dataclasses.replace(s, track_id=0)), _FRAME_S,
        says=_LOCATED,
    ),
    Fault("keypoints jump by 400 px", _perceive(lambda s: _shifted(s, 400)), _FRAME_S, says=_LOCATED),
    Fault(
        "keypoints are NaN", _perceive(lambda s: dataclasses.replace(s, keypoints=s.keypoints * np.float32(np.nan))),
        _FRAME_S, says=_LOCATED,
    ),
    Fault("picture freezes, stamps go on", _freeze, _FRAME_S, says=_LOCATED),
    Fault("another person, by its track", _perceive(lambda s: _shifted(s, 150, 2)), _FRAME_S, says=_LOCATED),
    Fault("another person 2 m aside, same track", _perceive(lambda s: _shifted(s, 370)), _FRAME_S, says=_LOCATED),
    Fault(
        "perception 1 s late", _perceive(lambda s: dataclasses.replace(s, stamp_ns=s.stamp_ns - 10**9)), _FRAME_S,
        says=_LOCATED,
    ),
    Fault(
        "stamps 5 s in the future", _perceive(lambda s: dataclasses.replace(s, stamp_ns=s.stamp_ns + 5 * 10**9)),
        _FRAME_S, says=_LOCATED,
    ),
    Fault("every other picture lost", _half, harmless=True),
    Fault("process killed (SIGKILL)", _set(stopped=True), _LINK_S, cause=TIMEOUT),
    Fault("process killed, time-outs of 0.3 s", _set(stopped=True), _LINK_S, cause=TIMEOUT, change=_short),
    Fault("process killed, time-outs as shipped", _set(stopped=True), _LINK_S, cause=TIMEOUT, change=_shipped),
    Fault(
        "process stopped for 3 s (SIGSTOP)", _set(stopped=True), _LINK_S, cause=TIMEOUT,
        later=((3.0, _set(stopped=False)),), says=("stood still", *_TAKEN),
    ),
    Fault(
        "process restarts after 1 s", _set(stopped=True), _LINK_S, cause=TIMEOUT, later=((1.0, _restart),),
        check=_never_moved, says=("all conditions for motion hold", "the autopilot has not told"),
    ),
    Fault("process restarts at once", _restart, _LINK_S, cause=TIMEOUT, check=_never_moved),
    Fault("control loop hangs", _set(hung=True)),
    Fault("control loop hangs for 1 s", _set(hung=True), later=((1.0, _set(hung=False)),), says=("stood still",)),
    Fault("link lost", _both(cut=True), _LINK_S, cause=TIMEOUT, says=_TOLD),
    Fault("link lost for 2 s", _both(cut=True), _LINK_S, cause=TIMEOUT, later=((2.0, _both(cut=False)),)),
    Fault("downlink lost", _set(down__cut=True), _LINK_S, says=_TOLD),
    Fault("uplink lost", _set(up__cut=True), _LINK_S, cause=TIMEOUT, says=(*_TOLD, *_TAKEN)),
    Fault("link delayed by 1 s", _both(delay_s=_DELAY_S), _LINK_S, cause=DELAYED, says=(*_TOLD, *_TAKEN)),
    Fault("downlink delayed by 1 s", _set(down__delay_s=_DELAY_S), _LINK_S, says=_TOLD),
    Fault("uplink delayed by 1 s", _set(up__delay_s=_DELAY_S), _LINK_S, cause=DELAYED, says=(*_TOLD, *_TAKEN)),
    Fault("30 % loss", _both(loss=0.3), harmless=True),
    Fault("80 % loss", _both(loss=0.8), _LINK_S, cause=LOSSY, says=(*_TOLD, *_LOCATED, *_TAKEN)),
    Fault("every packet twice", _both(duplicate=1.0), harmless=True),
    Fault("packets out of order", _both(jitter_s=0.08), harmless=True),
    Fault("a foreign system on the link", _foreign, harmless=True),
    Fault("GPS lost", _at("gps_lost_s"), 0.4 + _HEARTBEAT_S, says=("satellite fix",)),
    Fault("estimator fails", _at("ekf_failed_s"), _HEARTBEAT_S, says=("estimator", *_TAKEN)),
    Fault("battery at 10 %", _set(copter__battery=10), _HEARTBEAT_S, says=("battery",)),
    Fault("battery unknown", _set(copter__battery=-1), _HEARTBEAT_S, says=("battery",)),
    Fault("pilot takes LOITER (POSCTL)", _mode("LOITER", "POSCTL"), _HEARTBEAT_S, cause=MODE, says=_TAKEN),
    Fault("pilot takes ALT_HOLD (ALTCTL)", _mode("ALT_HOLD", "ALTCTL"), _HEARTBEAT_S, cause=MODE, says=_TAKEN),
    Fault("pilot takes LAND", _mode("LAND"), _HEARTBEAT_S, cause=MODE, says=_TAKEN),
    Fault("pilot takes RTL", _mode("RTL"), _HEARTBEAT_S, cause=MODE, says=_TAKEN),
    Fault(
        "pilot takes over during a hold", _perceive(lambda seen: None), _FRAME_S, cause=PILOT, says=_TAKEN,
        later=((_TAKEN_S, _mode("LOITER", "POSCTL")),),
    ),
    Fault(
        "pilot takes over and gives back", _mode("LOITER", "POSCTL"), _HEARTBEAT_S, cause=MODE, says=_TAKEN,
        later=((2.0, _to_control),),
    ),
    _pilot("idle", _blind, State.IDLE, "control", says=_LOCATED),
    _pilot("ready", _wait, State.READY, "position"),
    _pilot("engaging", _engage, State.READY, "position", change=_by_hand, says=_TAKEN),
    _pilot("holding", _held, State.HOLDING, "position", says=_TAKEN),
    _pilot("in fault", _failed, State.FAULT, "position", says=_TAKEN),
    _pilot("taken over", _taken, State.TAKEN_OVER, "control", says=_TAKEN),
    Fault("the autopilot's own fence is breached", _set(copter__fence_m=0.5), _HEARTBEAT_S, cause=MODE, says=_TAKEN),
    Fault("clock jumps 3 s ahead", _set(clock_jump_s=3.0), _LINK_S, says=("our clock jumped",)),
    Fault("clock jumps 3 s back", _set(clock_jump_s=-3.0), _LINK_S, says=("our clock jumped",)),
    Fault("the autopilot's clock begins again", _reboot, harmless=True),
    Fault("the autopilot's position jumps by 15 m", _jump, _LINK_S, cause=JUMPED, says=("position jumped",)),
    Fault("telemetry frozen, clock goes on", _set(copter__frozen=True), _LINK_S, says=_TOLD),
    Fault(
        "telemetry frozen with its clock", _set(copter__frozen=True, copter__frozen_clock=True), _LINK_S, says=_TOLD
    ),
    Fault("autopilot follows no more, says nothing", _set(copter__deaf=True), _ECHO_S, says=("echoed", *_TAKEN)),
    Fault("storm of 500 commands", _storm, says=("stopped by the operator",)),
    Fault("commands of the past", _old_commands, harmless=True, check=_still_6_m),
    Fault("senseless commands", _senseless, harmless=True, check=_still_6_m),
    Fault(
        "landing reported", _set(copter__landed_state=mavlink.MAV_LANDED_STATE_LANDING), _HEARTBEAT_S,
        says=("the vehicle is landing",),
    ),
    Fault("subject walks towards the vehicle", _walk_into, harmless=True),
    Fault(
        "subject leaves the fence", _walk_away, harmless=True, says=("fence",), check=_inside_fence,
        change=lambda settings: with_config(settings, fence_radius_m=9.0),
    ),
    Fault("hold mode denied", _deny_hold, _FRAME_S, says=("take over by hand",)),
)  # fmt: skip
