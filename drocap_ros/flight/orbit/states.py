"""Types of the orbit's state machine: its states, the operator's commands, what is observed, what may be sent."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.autopilot_settings import LossSettings
from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.safety_config import SafetyConfig


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


@dataclass(frozen=True)
class Observed:
    """Vehicle, link and subject at one instant; ages in s, infinite = never.

    in_control, in_hold : the mode is GUIDED or OFFBOARD; it is the autopilot's hold mode
    position_age_s : since the reported position last changed, so frozen telemetry ages too
    round_trip_s : since the sending of the message that was answered last; NaN = no answer yet
    position, velocity : (3,) ENU; the position is extrapolated over the age of the state
    height_m : above the subject's ground
    subject_distance_m : horizontal
    closing_m_s, approach_m_s : speed of the vehicle towards the subject, and of the subject towards the vehicle
    disturbance : a condition that ends motion and that no other field shows
    followed : whether the autopilot follows our setpoints; if not, only a mode can stop it
    loss_settings : the autopilot's settings for the loss of setpoints
    """

    autopilot: str = "other"
    mode: str = ""
    in_control: bool = False
    in_hold: bool = False
    armed: bool = False
    landed_state: int = 0
    link_age_s: float = math.inf
    heartbeat_age_s: float = math.inf
    state_age_s: float = math.inf
    position_age_s: float = math.inf
    status_age_s: float = math.inf
    round_trip_s: float = math.nan
    gps_fix_type: int = 0
    position_ok: bool = False
    battery_fraction: float = math.nan
    position: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    velocity: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    yaw: float = math.nan
    height_m: float = math.nan
    subject: np.ndarray | None = None
    subject_age_s: float = math.inf
    subject_sd_m: float = math.inf
    subject_distance_m: float = math.nan
    closing_m_s: float = 0.0
    approach_m_s: float = 0.0
    disturbance: Condition | None = None
    followed: bool = True
    loss_settings: LossSettings | None = None


class Limits(NamedTuple):
    """Parameters of the conditions.

    warm_up_s : how long the autopilot must receive setpoints before it grants control
    max_control_timeout_s : longest time-out of the autopilot without setpoints; 0 = not checked
    max_mode_age_s : greatest age of the heartbeat at which a mode is requested
    """

    safety: SafetyConfig
    orbit: OrbitConfig
    warm_up_s: float = 0.0
    max_control_timeout_s: float = 0.0
    max_mode_age_s: float = 0.1


@dataclass(frozen=True)
class SafetyState:
    """State of the machine.

    since_s : of the state
    condition : why it is in the state
    hold_position, hold_yaw : latched
    retreats : whether the hold position moves away from an approaching subject: only where nothing but nearness
        ended the orbit
    retreated_s : when it last did
    slow_s : since when the vehicle has been slow during the hold; NaN = it is not
    fence_centre : (2,) where the orbit began
    modes : modes that are no take-over at present; empty = any
    requesting_s : since when control is requested; NaN = it is not
    hold_mode_s : when the hold mode was first requested; NaN = not yet
    blind : whether the hold began without a trustworthy vehicle state
    lost_s : since when the vehicle is out of sight (no fresh telemetry); NaN = it is in sight
    seen_s : since when it is in sight without interruption; -infinity = it was never lost
    """

    state: State = State.IDLE
    since_s: float = 0.0
    condition: Condition = field(default_factory=lambda: condition(ConditionCode.NO_DATA))
    hold_position: np.ndarray | None = None
    hold_yaw: float = math.nan
    retreats: bool = False
    retreated_s: float = -math.inf
    slow_s: float = math.nan
    fence_centre: np.ndarray | None = None
    modes: frozenset[str] = frozenset()
    requesting_s: float = math.nan
    hold_mode_s: float = math.nan
    blind: bool = False
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


@dataclass(frozen=True)
class OperatorCommand:
    """A command as it was received, not validated.

    kind : number of a :class:`Command`
    radius_m, height_m, angular_speed_deg_s : NaN = as at present or as configured
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
