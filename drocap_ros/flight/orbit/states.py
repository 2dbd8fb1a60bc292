"""Types of the orbit's state machine: its states, the operator's commands, what is observed, what may be sent."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.autopilot import LossSettings
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
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

    in_control, in_hold : the mode is the autopilot's for setpoints; it is its hold mode
    heard : all modes that were reported since the last step, late ones too; empty = the mode alone
    left_by_itself : whether the autopilot left the control mode as for the loss of setpoints, and nobody chose this
    system_status : MAV_STATE of the autopilot; 0 = unknown
    vehicles : MAVLink systems of the autopilots on the link, unless the operator has chosen one
    heartbeat_age_s : since the newest report of the mode
    position_age_s : since the reported position last changed, so frozen telemetry ages too
    round_trip_s : since the sending of the message that was answered last; NaN = no answer yet
    packet_loss : share of the vehicle's last packets that have not arrived
    stream_gap_s : since the last setpoint left
    position, velocity : (3,) ENU; the position is extrapolated over the age of the state
    height_m : above the subject's ground
    subject_contradicted : whether images since the subject was located showed something else in his place
    subject_distance_m : horizontal
    closing_m_s, approach_m_s : speed of the vehicle towards the subject, and of the subject towards the vehicle
    approach_sd_m_s : standard deviation of ``approach_m_s``
    intruder : another one that commands, or whose keypoints would be followed
    disturbance : a condition that ends motion and that no other field shows
    followed : whether the autopilot follows our setpoints; if not, only a mode can stop it
    loss_settings : the autopilot's settings for the loss of setpoints
    camera_problem : why the camera's attitude is unknown
    calibrated : whether the camera's matrix is known, without which no subject is located
    away_m, away_s : from the vehicle to its place on the orbit, and for how long this has been too far
    framing_margin : between the person and the border of a fixed camera's picture, as a share of its height
    """

    autopilot: str = "other"
    mode: str = ""
    in_control: bool = False
    in_hold: bool = False
    heard: frozenset[str] = frozenset()
    left_by_itself: bool = False
    armed: bool = False
    system_status: int = 0
    landed_state: int = 0
    vehicles: frozenset[int] = frozenset()
    link_age_s: float = math.inf
    heartbeat_age_s: float = math.inf
    state_age_s: float = math.inf
    position_age_s: float = math.inf
    status_age_s: float = math.inf
    round_trip_s: float = math.nan
    packet_loss: float = 0.0
    stream_gap_s: float = 0.0
    gps_fix_type: int = 0
    position_ok: bool = False
    battery_fraction: float = math.nan
    battery_voltage_v: float = math.nan
    position: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    velocity: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    yaw: float = math.nan
    height_m: float = math.nan
    subject: np.ndarray | None = None
    subject_age_s: float = math.inf
    subject_contradicted: bool = False
    subject_sd_m: float = math.inf
    subject_distance_m: float = math.nan
    closing_m_s: float = 0.0
    approach_m_s: float = 0.0
    approach_sd_m_s: float = 0.0
    intruder: Condition | None = None
    disturbance: Condition | None = None
    followed: bool = True
    loss_settings: LossSettings | None = None
    camera_problem: Condition | None = None
    calibrated: bool = True
    away_m: float = 0.0
    away_s: float = 0.0
    framing_margin: float = math.inf

    @property
    def jumped(self) -> bool:
        """Whether the reported position has jumped: what was latched in it names another place now."""
        return self.disturbance is not None and self.disturbance.code == ConditionCode.POSITION_JUMPED


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
