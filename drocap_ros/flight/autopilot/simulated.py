"""What a simulated copter takes from its autopilot: loops, airframe, modes of the pilot, what it streams by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Gains(NamedTuple):
    """Of position (1/s) and velocity (1/s, 1/s^2, none); the wanted acceleration is passed on as it is."""

    position: float
    velocity: float
    integral: float
    derivative: float


class Airframe(NamedTuple):
    """Of a copter.

    lags_s : of the thrust, one after the other
    drag, inflow : of the air, per m and per s: what the body and what the propellers slow down
    friction : per s of the own motion
    """

    lags_s: tuple[float, float]
    drag: float
    inflow: float
    friction: float


class Decay(NamedTuple):
    """How fast the wanted velocity follows a commanded one: 1/s, at most m/s^2."""

    gain_per_s: float
    most_m_s2: float


class StickOverride(NamedTuple):
    """Parameter whose bit lets the sticks end the control mode, and its value as shipped."""

    setting: str
    bit: int
    shipped: int


@dataclass(frozen=True)
class ReportErrors:
    """Errors (position in m, velocity in m/s) of the autopilot's estimate along one axis, as a process.

    e[t] = first e[t-1] + second e[t-2] + noise, in steps of 0.1 s, fitted to recorded flights by
    ``lab/studies/report_errors.py``.

    first, second : rows of (2, 2)
    noise : standard deviations of one step
    correlation : of the two noises
    """

    first: tuple[tuple[float, float], tuple[float, float]]
    second: tuple[tuple[float, float], tuple[float, float]]
    noise: tuple[float, float]
    correlation: float


@dataclass(frozen=True)
class Simulated:
    """The simulated counterpart.

    stick_mode : in which the sticks command velocities
    settings : parameters that the simulated vehicle has set for this bridge
    gains, airframe : of loops and body
    stop, hold, stick : wanted velocity in the hold mode, in other modes with the sticks released, and by the sticks
    jerk_m_s3 : of these
    lost_modes : mode entered when setpoints cease, by the loss action's number; empty = the time-out ends the motion
    loss_check_s : least and greatest delay of that
    override : whether the sticks end the control mode; None = never
    streams : messages that are sent unrequested, with their periods in s
    transit_s : from the bridge's process to the controller
    horizontal, vertical : errors of its estimate; the vehicle flies by it
    clock_rate : seconds of its clock per second
    critical_when_lost : whether its heartbeat reports a critical state while the loss action flies
    flags_at_rest : flags of its estimator that it adds while the vehicle stands on the ground
    """

    stick_mode: str
    settings: Mapping[str, float]
    gains: Gains
    airframe: Airframe
    stop: Decay
    hold: Decay
    stick: Decay
    jerk_m_s3: float
    horizontal: ReportErrors
    vertical: ReportErrors
    lost_modes: Mapping[int, str] = field(default_factory=dict)
    loss_check_s: tuple[float, float] = (0.0, 0.0)
    override: StickOverride | None = None
    streams: Mapping[str, float] = field(default_factory=dict)
    transit_s: float = 0.0
    clock_rate: float = 1.0
    critical_when_lost: bool = False
    flags_at_rest: int = 0
