"""Types of the orbit's state machine: one for each state, the operator's commands, what may be sent."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

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
    PRESENT = 16


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


class Sight(NamedTuple):
    """Whether the vehicle is in sight, by fresh telemetry.

    lost_s : since when it is not; None = it is
    seen_s : since when it is, without interruption; -infinity = it was never lost
    """

    lost_s: float | None = None
    seen_s: float = -math.inf

    @property
    def lost(self) -> bool:
        """Whether the vehicle is out of sight."""
        return self.lost_s is not None


@dataclass(frozen=True)
class SafetyState:
    """A state of the machine; each has a type with what it needs.

    since_s : monotonic
    condition : why the machine is in it
    """

    state: ClassVar[State]

    since_s: float = 0.0
    condition: Condition = field(default_factory=lambda: condition(ConditionCode.NO_DATA))
    sight: Sight = field(default_factory=Sight)

    @property
    def reason(self) -> str:
        """The condition as a sentence."""
        return str(self.condition)

    @property
    def bound(self) -> bool:
        """Whether the vehicle flies, or may soon fly by itself, by the present subject: no other may replace it."""
        return isinstance(self, Orbiting | Requesting)


@dataclass(frozen=True)
class Idle(SafetyState):
    """Something forbids motion.

    failed : why the last request of control ended without an orbit, until the next command; None = it did not
    asked_s : when a request of control ended that the autopilot may still grant; -infinity = there is none
    """

    state = State.IDLE
    failed: Condition | None = None
    asked_s: float = -math.inf


@dataclass(frozen=True)
class Ready(Idle):
    """All conditions for motion hold."""

    state = State.READY


@dataclass(frozen=True)
class TakenOver(SafetyState):
    """The pilot, or a failsafe of the autopilot, has taken over: nothing is sent."""

    state = State.TAKEN_OVER


@dataclass(frozen=True)
class Commanding(SafetyState):
    """States in which the vehicle is, or was, commanded.

    modes : that are no take-over at present; empty = any
    """

    modes: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Requesting(Commanding):
    """Control is requested from the autopilot; the vehicle's place (3,) m and yaw are what is sent meanwhile."""

    state = State.READY
    position: np.ndarray | None = None
    yaw: float = math.nan


@dataclass(frozen=True)
class Orbiting(Commanding):
    """The orbit is flown.

    fence_centre : (2,) m, where it began
    pace : below 1 while it is degraded
    """

    state = State.ORBITING
    fence_centre: np.ndarray | None = None
    pace: Pace = field(default_factory=Pace)


@dataclass(frozen=True)
class Holding(Commanding):
    """An active hold at a place.

    position, yaw : latched; None = no place is known
    fence_centre : of the orbit before; None = there was none
    blind : whether the hold began without a trustworthy vehicle state
    retreats : whether the place moves away from an approaching subject: only where nothing but nearness ended the orbit
    retreated_s : when it last did
    slow_s : since when the vehicle has been slow; None = it is not
    hold_mode_s : when the autopilot's hold mode was first requested; None = not yet
    jumped_s : when the reported position has jumped last
    """

    state = State.HOLDING
    position: np.ndarray | None = None
    yaw: float = math.nan
    fence_centre: np.ndarray | None = None
    blind: bool = False
    retreats: bool = False
    retreated_s: float = -math.inf
    slow_s: float | None = None
    hold_mode_s: float | None = None
    jumped_s: float = -math.inf


@dataclass(frozen=True)
class Fault(Holding):
    """A hold whose mode the autopilot does not enter."""

    state = State.FAULT


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
