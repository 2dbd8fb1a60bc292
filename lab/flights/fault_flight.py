"""A flight with one injected fault in the closed loop: how soon commanded motion ends, how far the vehicle goes.

The required bounds of a case are fixed before its flight: those of the protocol or, where a mechanism outside the
bridge ends the motion, those of a :class:`Cause`, with evidence that this mechanism acted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.conditions import Condition, ConditionCode
from drocap_ros.flight.orbit.states import Action, State
from lab.flights.branches import branch
from lab.flights.orbit_loop import LoopSettings, OrbitLoop

FAULT_S = 14.0
MOTION_S, EXCURSION_M = 0.5, 2.5
_WATCH_S = 7.0
_LEAST_DISTANCE_M, _LEAST_HEIGHT_M = 3.0, 1.2

Injection = Callable[[OrbitLoop], None]


class FaultResult(NamedTuple):
    """Outcome of a case.

    motion_s : from the instant when the fault is observable to the last motion by setpoints; negative = sooner
    excursion_m : horizontal, from the position at that instant
    speed_m_s : flown at that instant, or commanded by the last setpoint: the greater
    least_distance_m : to the person, after the fault
    least_height_m : true, above his ground, after the fault, while the autopilot followed us
    resumed : whether motion was commanded again without the operator
    evident : whether the case's cause ended the motion
    violation : the additional requirement that failed, in words; "" = none
    """

    motion_s: float
    excursion_m: float
    speed_m_s: float
    least_distance_m: float
    least_height_m: float
    resumed: bool
    evident: bool
    violation: str
    state: State
    condition: Condition


class Bounds(NamedTuple):
    """Required: s after the fault is observable, and m from the position at that instant."""

    motion_s: float = MOTION_S
    excursion_m: float = EXCURSION_M


class Flight(NamedTuple):
    """A flown case: steps of the control loop since the injection, with the count of accepted setpoints at each."""

    loop: OrbitLoop
    times: list[float]
    accepted: list[int]
    orbit_until_s: float  # last step that commanded the orbit
    motion_until_s: float


@dataclass(frozen=True)
class Cause:
    """A mechanism outside the bridge that ends the motion.

    bounds : from the settings and the speed (m/s) when the fault is observable
    acted : whether this mechanism ended the motion of a flight
    """

    description: str
    bounds: Callable[[LoopSettings, float], Bounds]
    acted: Callable[[Flight], bool]


def start(loop: OrbitLoop) -> None:
    """Start the orbit."""
    loop.start(0.0)


@dataclass(frozen=True)
class Fault:
    """One case.

    observable_s : earliest detection after the injection by the component that must react
    harmless : the orbit may continue
    cause : the mechanism that ends the motion, unless it is the bridge
    codes : the final condition, or the cause behind it, must have one of them
    change : of the settings of the flight
    before, state : (s of the flight, action) each, which lead to the state at the injection
    later : (s after the injection, second injection)
    watch_s : after the injection
    check : additional requirement; returns "" or the violation in words
    """

    name: str
    inject: Injection
    observable_s: float = 0.0
    harmless: bool = False
    cause: Cause | None = None
    codes: tuple[ConditionCode, ...] = ()
    change: Callable[[LoopSettings], LoopSettings] = lambda settings: settings
    before: tuple[tuple[float, Injection], ...] = ((4.0, start),)
    state: State = State.ORBITING
    later: tuple[float, Injection] | None = None
    watch_s: float = _WATCH_S
    check: Callable[[OrbitLoop], str] = field(default=lambda loop: "")

    def settings(self, autopilot: str, seed: int = 4) -> LoopSettings:
        """Settings of the flight."""
        return self.change(LoopSettings(autopilot=autopilot, seed=seed, seconds=FAULT_S + self.watch_s + 1.0))

    def bounds(self, autopilot: str, speed_m_s: float) -> Bounds:
        """Required bounds at this speed."""
        return Bounds() if self.cause is None else self.cause.bounds(self.settings(autopilot), speed_m_s)


_LED: dict[tuple[object, ...], OrbitLoop] = {}


def fly_fault(fault: Fault, autopilot: str, seed: int = 4) -> FaultResult:
    """Lead the loop to the case's state, inject the fault at ``FAULT_S``, record for ``watch_s``.

    The same flight leads to many cases: a process flies it once, and each case is a branch of it.

    Raises
    ------
    AssertionError
        When the loop is not in the case's state before the fault.
    """
    flight = fault.settings(autopilot, seed), fault.before, fault.state
    if flight not in _LED:
        _LED[flight] = lead_to_fault(fault, autopilot, seed)
    return branch(lambda: inject_fault(fault, _LED[flight]))


def lead_to_fault(fault: Fault, autopilot: str, seed: int = 4) -> OrbitLoop:
    """First part of :func:`fly_fault`: the loop at ``FAULT_S``."""
    loop = OrbitLoop(fault.settings(autopilot, seed))
    for at_s, act in fault.before:
        loop.run(at_s)
        act(loop)
    loop.run(FAULT_S)
    safety = loop.controller.safety
    if safety.state != fault.state:
        raise AssertionError(f"{fault.name}: {safety.state.name} before the fault: {safety.reason}")
    return loop


def inject_fault(fault: Fault, loop: OrbitLoop) -> FaultResult:
    """Second part of :func:`fly_fault`, from ``FAULT_S`` on."""
    times: list[float] = []
    accepted: list[int] = []

    def record(loop: OrbitLoop) -> None:
        times.append(loop.t)
        accepted.append(loop.copter.accepted_setpoints)

    fault.inject(loop)
    injected = len(loop.rows)
    loop.run(FAULT_S + fault.observable_s, record)
    position = loop.copter.body.position.copy()
    speed = max(float(np.linalg.norm(v)) for v in (loop.copter.body.velocity, loop.copter.target.velocity))
    observable_s, observable = loop.t, len(loop.rows)
    if fault.later is not None:
        after_s, inject = fault.later
        loop.run(FAULT_S + after_s, record)
        inject(loop)
    loop.run(FAULT_S + fault.watch_s, record)
    rows, control = loop.rows[observable:], loop.copter.kind.control_mode
    actions = [row.action for row in loop.rows[injected:]]
    orbiting = [i for i, action in enumerate(actions) if action == Action.ORBIT]
    ended = next((i for i, action in enumerate(actions) if action != Action.ORBIT), len(actions))
    orbit_until_s = loop.rows[injected + orbiting[-1]].t_s if orbiting else FAULT_S
    flight = Flight(loop, times, accepted, orbit_until_s, loop.copter.motion_until_s)
    return FaultResult(
        motion_s=loop.copter.motion_until_s - observable_s,
        excursion_m=max(float(np.linalg.norm(row.position[:2] - position[:2])) for row in rows),
        speed_m_s=speed,
        least_distance_m=min(row.distance_m for row in rows),
        least_height_m=min((float(row.position[2]) for row in rows if row.mode == control), default=np.inf),
        resumed=Action.ORBIT in actions[ended:],
        evident=fault.cause is None or fault.cause.acted(flight),
        violation=fault.check(loop),
        state=loop.controller.safety.state,
        condition=loop.controller.safety.condition,
    )


def failures(fault: Fault, autopilot: str, result: FaultResult) -> list[str]:
    """Violated requirements of the case, in words; empty = it passes."""
    found = [result.violation] if result.violation else []
    if result.resumed:
        found.append("motion was commanded again without the operator")
    if fault.codes and not set(fault.codes) & set(_codes(result.condition)):
        found.append(f"the condition is not {' or '.join(code.name for code in fault.codes)}")
    if result.least_distance_m <= _LEAST_DISTANCE_M:
        found.append(f"distance to the person of {result.least_distance_m:.2f} m")
    if result.least_height_m < _LEAST_HEIGHT_M:
        found.append(f"height of {result.least_height_m:.2f} m")
    if fault.harmless:
        return found
    bounds = fault.bounds(autopilot, result.speed_m_s)
    if result.motion_s > bounds.motion_s:
        found.append(f"motion for {result.motion_s:.2f} s, bound {bounds.motion_s:.2f} s")
    if result.excursion_m >= bounds.excursion_m:
        found.append(f"excursion of {result.excursion_m:.2f} m, bound {bounds.excursion_m:.2f} m")
    if fault.cause is not None and not result.evident and not within_protocol(result):
        found.append("no evidence of the stated cause")
    return found


def _codes(condition: Condition) -> list[ConditionCode]:
    """The code, and those of the causes behind it."""
    cause = condition.values.get("cause")
    return [condition.code, *(_codes(cause) if isinstance(cause, Condition) else [])]


def within_protocol(result: FaultResult) -> bool:
    """Whether the bounds of the protocol hold: 0.5 s, 2.5 m, motion not resumed."""
    return result.motion_s <= MOTION_S and result.excursion_m < EXCURSION_M and not result.resumed
