"""Types of the orbit's state machine: its states, the operator's commands, what may be sent."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.bridge_config import OrbitConfig, SafetyConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition


class State(enum.IntEnum):
    """As in ``msg/OrbitStatus.msg``."""

    IDLE = 0
    READY = 1
    ORBITING = 2
    HOLDING = 3
    TAKEN_OVER = 4
    FAULT = 5


class Command(enum.IntEnum):
    """As in ``srv/OrbitCommand.srv``."""

    STOP = 0
    START = 1
    ADJUST = 2
    ENGAGE = 3


class Action(enum.Enum):
    """What may be sent now."""

    NOTHING = "nothing"
    ORBIT = "setpoints of the orbit"
    HOLD = "a position setpoint at the hold position"
    HALT = "velocity zero, where no position is known"


class ModeRequest(enum.Enum):
    """The mode to request from the autopilot now."""

    NONE = ""
    CONTROL = "control"
    HOLD = "hold"


class Limits(NamedTuple):
    """Parameters of the conditions.

    warm_up_s : how long the autopilot must receive setpoints before it grants control
    max_control_timeout_s : longest time-out of the autopilot without setpoints; 0 = not checked
    max_mode_age_s : greatest age of the report of the mode at which another one is requested
    """

    safety: SafetyConfig
    orbit: OrbitConfig
    warm_up_s: float = 0.0
    max_control_timeout_s: float = 0.0
    max_mode_age_s: float = 0.1


class Pace(NamedTuple):
    """Share of its speed at which the orbit is flown, 0 to 1, with its rate in 1/s.

    kept : the share that a vehicle still has that brakes and accelerates as usual
    at_s : monotonic
    place : (3,) m, of the vehicle; at pace 0 where it was when the pace became 0
    """

    value: float = 1.0
    rate: float = 0.0
    kept: float = 1.0
    at_s: float = 0.0
    place: np.ndarray | None = None


@dataclass(frozen=True)
class SafetyState:
    """State of the machine.

    since_s : of the state
    condition : why it is in the state
    pace : of the orbit; below 1 while it is degraded
    hold_position, hold_yaw : latched
    retreats : whether the hold position moves away from an approaching subject: only where nothing but nearness
        ended the orbit
    retreated_s : when it last did
    slow_s : since when the vehicle has been slow during the hold; NaN = it is not
    fence_centre : (2,) where the orbit began
    modes : modes that are no take-over at present; empty = any
    requesting_s : since when control is requested; NaN = it is not
    failed : why the last request of control ended without an orbit, until the next command; None = it did not
    hold_mode_s : when the hold mode was first requested; NaN = not yet
    blind : whether the hold began without a trustworthy vehicle state
    resumable : whether the orbit may resume by itself: a harmless cause alone began the hold
    jumped_s : when the reported position has jumped last in this hold
    clear_s : since when all conditions hold again in such a hold; NaN = they do not
    lost_s : since when the vehicle is out of sight (no fresh telemetry); NaN = it is in sight
    seen_s : since when it is in sight without interruption; -infinity = it was never lost
    """

    state: State = State.IDLE
    since_s: float = 0.0
    condition: Condition = field(default_factory=lambda: condition(ConditionCode.NO_DATA))
    pace: Pace = field(default_factory=Pace)
    hold_position: np.ndarray | None = None
    hold_yaw: float = math.nan
    retreats: bool = False
    retreated_s: float = -math.inf
    slow_s: float = math.nan
    fence_centre: np.ndarray | None = None
    modes: frozenset[str] = frozenset()
    requesting_s: float = math.nan
    failed: Condition | None = None
    hold_mode_s: float = math.nan
    blind: bool = False
    resumable: bool = False
    jumped_s: float = -math.inf
    clear_s: float = math.nan
    lost_s: float = math.nan
    seen_s: float = -math.inf

    @property
    def reason(self) -> str:
        """The condition as a sentence."""
        return str(self.condition)

    @property
    def requesting(self) -> bool:
        """Whether control is being requested from the autopilot."""
        return not math.isnan(self.requesting_s)

    @property
    def bound(self) -> bool:
        """Whether the vehicle flies, or may soon fly by itself, by the present subject: no other may replace it."""
        return self.state == State.ORBITING or self.requesting or self.resumable


@dataclass(frozen=True)
class OperatorCommand:
    """A command as it was received, not validated.

    kind : number of a :class:`Command`
    radius_m, height_m, angular_speed_deg_s : NaN = as at present (adjust) or as configured
    stamp_ns : when it was given; 0 = now
    """

    kind: int
    radius_m: float = math.nan
    height_m: float = math.nan
    angular_speed_deg_s: float = math.nan
    stamp_ns: int = 0


class CommandAnswer(NamedTuple):
    """Whether a command was accepted, and why (not)."""

    accepted: bool
    condition: Condition

    def __str__(self) -> str:
        return str(self.condition) if self.accepted else f"refused: {self.condition}"


class Decision(NamedTuple):
    """What may be sent now, and the answer to a command, if there was one."""

    action: Action
    mode_request: ModeRequest
    answer: CommandAnswer | None
