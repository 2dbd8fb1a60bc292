"""Replay of recorded flights of real autopilots: the same setpoints into the simulated vehicle, from the same state.

Before the instant of the comparison the loops see the recorded motion, so that their own states become those of the
recorded autopilot; from then on the simulated body flies freely.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.simulation.vehicle.copter_reports import Body
from drocap_ros.simulation.vehicle.flight_control import Manner, Target, control_of

STEP_S = 0.01
FAULT_S = 3.0
#: ArduPilot's path, and the integrals of both, depend on all earlier setpoints.
_RUN_UP_S, _TREND_S = 60.0, 2.0
#: Of the flights in 8 m/s: its direction is not recorded, and was fitted to them.
WIND_M_S = (-8.0, -0.8)
_LOST_S = 0.595  # PX4: from the last setpoint to its hold mode, COM_OF_LOSS_T 0.5


class RecordedFlight(NamedTuple):
    """A recorded flight, ENU: (T,) s, (T, 3) m and m/s, (T,) rad, and the setpoints that left the bridge, (S, ...)."""

    time_s: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    yaw: np.ndarray
    setpoint_s: np.ndarray
    setpoint_position: np.ndarray
    setpoint_velocity: np.ndarray
    setpoint_acceleration: np.ndarray


class Event(NamedTuple):
    """A mode that begins."""

    at_s: float
    manner: Manner


class Case(NamedTuple):
    """What happened in a recorded flight.

    start_s : instant from which the simulated vehicle flies freely
    heard_until_s : setpoints that left later did not arrive
    timeout_s : ArduPilot's GUID_TIMEOUT
    wind : (2,) m/s ENU, without gusts
    """

    name: str
    start_s: float = FAULT_S
    events: tuple[Event, ...] = ()
    heard_until_s: float = np.inf
    timeout_s: float = 0.5
    wind: tuple[float, float] = (0.0, 0.0)


class Replayed(NamedTuple):
    """(N,) s since the start, (N, 2) m simulated and recorded horizontal position."""

    time_s: np.ndarray
    simulated: np.ndarray
    recorded: np.ndarray

    @property
    def error_m(self) -> np.ndarray:
        """(N,) distance between both."""
        error: np.ndarray = np.linalg.norm(self.simulated - self.recorded, axis=1)
        return error

    def farthest_m(self, simulated: bool) -> float:
        """Greatest distance from the start."""
        path = self.simulated if simulated else self.recorded
        return float(np.linalg.norm(path - path[0], axis=1).max())


def load_recorded(path: Path) -> RecordedFlight:
    """Read an archive of `time_s`, `position_m`, ... as the recordings have them; without setpoints those are empty."""
    with np.load(path) as data:
        empty = np.zeros((0, 3))
        setpoints = [
            data.get(f"setpoint_{name}", empty) for name in ("position_m", "velocity_m_s", "acceleration_m_s2")
        ]
        times = data.get("setpoint_time_s", np.zeros(0))
        own = (data["time_s"], data["position_m"], data["velocity_m_s"], data["yaw_rad"])
        return RecordedFlight(*(np.asarray(a, float) for a in (*own, times, *setpoints)))


def replay(flight: RecordedFlight, case: Case, autopilot: str, seconds: float = 4.0) -> Replayed:
    """Fly the case for some seconds.

    By how much PX4's estimate errs is not recorded: a trim of the integrals, fitted to the two seconds before the
    start, and to nothing after it, stands for that.
    """
    earliest_s = float(flight.setpoint_s[0]) + 0.05 if len(flight.setpoint_s) else 0.0
    first_s = max(case.start_s - _RUN_UP_S, float(flight.time_s[0]), earliest_s)
    trim = np.zeros(2)
    if autopilot == "px4":
        before = case._replace(start_s=case.start_s - _TREND_S, events=(), heard_until_s=np.inf)
        plain = _fly(flight, before, autopilot, _TREND_S, first_s, trim)
        moved = _fly(flight, before, autopilot, _TREND_S, first_s, np.array([1.0, 0.0]))
        effect = moved.simulated[:, 0] - plain.simulated[:, 0]
        trim = effect @ (plain.recorded - plain.simulated) / (effect @ effect)
    return _fly(flight, case, autopilot, seconds, first_s, trim)


def _fly(
    flight: RecordedFlight, case: Case, autopilot: str, seconds: float, first_s: float, trim: np.ndarray
) -> Replayed:
    times = np.arange(first_s, min(case.start_s + seconds, float(flight.time_s[-1])), STEP_S)
    position, velocity = (
        np.stack([np.interp(times, flight.time_s, values[:, i]) for i in range(3)], axis=1)
        for values in (flight.position, flight.velocity)
    )
    kind = autopilot_of(autopilot)
    assert kind.simulated is not None
    body = Body(position[0], float(flight.yaw[0]), np.array([*case.wind, 0.0]), kind.simulated.airframe, gust=0.0)
    hovering = body.drag()
    body.velocity = velocity[0]
    control = control_of(kind, position[0], body.yaw, hovering - np.array([*trim, 0.0]))
    control.begin(Manner.SETPOINTS, position[0], velocity[0], body.yaw)
    control.push = [float(v) for v in _slope(velocity, 0)[:2]]
    arrivals = flight.setpoint_s + kind.simulated.transit_s
    heard = flight.setpoint_s <= case.heard_until_s
    index = int(np.searchsorted(arrivals, first_s - 0.1))
    last_s, events, rows = -1.0, list(case.events), []
    for k, t in enumerate(times.tolist()):
        while index < len(arrivals) and arrivals[index] <= t:
            if heard[index] and control.manner == Manner.SETPOINTS:
                control.take(_target(flight, index))
                last_s = t
            index += 1
        if not len(arrivals) and t < case.start_s:
            control.take(Target(position[k], velocity[k], _slope(velocity, k)))
            last_s = t
        if t < case.start_s:
            body.position, body.velocity = position[k].copy(), velocity[k].copy()
        while events and events[0].at_s <= t:
            control.begin(events.pop(0).manner, body.position, body.velocity, body.yaw)
            last_s = -np.inf
        command = control.command(body.position, body.velocity, bool(t - last_s > case.timeout_s), STEP_S)
        if t >= case.start_s:
            rows.append((t - case.start_s, *body.position[:2], *position[k, :2]))
        body.step(command, 0.0, STEP_S)
    table = np.array(rows)
    return Replayed(table[:, 0], table[:, 1:3], table[:, 3:5])


def _target(flight: RecordedFlight, index: int) -> Target:
    return Target(
        flight.setpoint_position[index].copy(), flight.setpoint_velocity[index].copy(),
        flight.setpoint_acceleration[index].copy(),
    )  # fmt: skip


def _slope(velocity: np.ndarray, k: int) -> np.ndarray:
    first, last = max(k - 5, 0), min(k + 5, len(velocity) - 1)
    slope: np.ndarray = (velocity[last] - velocity[first]) / (STEP_S * max(last - first, 1))
    return slope


def _lost(name: str, last_s: float) -> Case:
    """PX4 loses the stream and holds."""
    return Case(name, last_s, (Event(last_s + _LOST_S, Manner.HOLD),), heard_until_s=last_s + 0.01)


def recorded_cases(flight: RecordedFlight, name: str) -> Sequence[Case]:  # noqa: C901 - a table of names, one line each
    """What happened in a recording, by its name; a whole orbit is compared from several instants on."""
    last_s = float(flight.setpoint_s[-1]) if len(flight.setpoint_s) else FAULT_S
    if name.startswith("bridge_killed"):
        return [Case(name, FAULT_S, timeout_s=0.3 if "0.3s" in name else 0.5)]
    if name.startswith(("px4_bridge_sigkill", "px4_kill_obl0")):
        return [_lost(name, last_s)]
    if name.startswith(("px4_setpoints_dropped", "px4_uplink_cut")):
        return [_lost(name, FAULT_S)]
    if name == "px4_bridge_sigstop_3s":
        return [_lost(name, float(flight.setpoint_s[flight.setpoint_s < FAULT_S][-1]))]
    if name.startswith("px4_operator_stop") or name == "px4_bridge_sigterm":
        return [Case(name, FAULT_S, (Event(last_s, Manner.HOLD),))]
    if name in ("px4_perception_stops", "px4_downlink_cut"):
        return [Case(name)]
    if name.startswith("px4_downlink_cut_pilot"):
        return [Case(name, FAULT_S, (Event(FAULT_S + 1.1, Manner.HOLD),))]
    if name in ("px4_pilot_loiter", "px4_pilot_posctl", "pilot_takes_loiter"):
        return [Case(name, FAULT_S, (Event(FAULT_S, Manner.HOLD),))]
    if name == "pilot_takes_brake":
        return [Case(name, FAULT_S, (Event(FAULT_S, Manner.BRAKE),))]
    if len(flight.setpoint_s) and ("orbit" in name or "stand" in name or "walk" in name or "override1" in name):
        starts = np.arange(FAULT_S, float(flight.time_s[-1]) - 4.0, 4.0)
        wind = WIND_M_S if "wind_8" in name else (0.0, 0.0)
        return [Case(name, float(start), wind=wind) for start in starts]
    return []
