"""Everything that the rest asks of an autopilot.

An instance in a file of its own (``ardupilot.py``, ``px4.py``) is all that an autopilot needs; the registry is
``__init__.py``.  An autopilot without an instance is :data:`UNKNOWN`: it has no control mode, so nothing flies it, and
the conditions for motion refuse it.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.coasting import Coast, Coasting, HeldCoasting, Setpoint


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
    override : a parameter, its bit that lets the sticks end the control mode, and its value as shipped; None = never
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
    override: tuple[str, int, int] | None = None
    streams: Mapping[str, float] = field(default_factory=dict)
    transit_s: float = 0.0
    clock_rate: float = 1.0
    critical_when_lost: bool = False
    flags_at_rest: int = 0


class LossSettings(NamedTuple):
    """Reaction to the loss of setpoints: time-out in s and number of the action, with their parameters' names.

    NaN = not reported; action_name "" = the autopilot has no such setting.
    """

    timeout_name: str
    timeout_s: float
    action_name: str = ""
    action: float = math.nan


class LossAction(NamedTuple):
    """What an autopilot's action on the loss of setpoints means, by the action's number.

    setting : name of the parameter
    hold : number of the action that holds the position
    words : what the vehicle does, for tables
    fatal : consequence that forbids motion, as a sentence
    leaves : consequence that should change, as a verb
    modes : mode that the autopilot enters by itself; without an entry any mode may be it
    """

    setting: str
    hold: int
    words: Mapping[int, str]
    fatal: Mapping[int, str]
    leaves: Mapping[int, str]
    modes: Mapping[int, str]


class Level(enum.IntEnum):
    """How much a finding before a flight matters."""

    OK = 0
    WAITS = 1  # on the ground: only in the air it can be judged
    WARNING = 2  # it flies; the setting or the link should change
    MISSING = 3  # the bridge refuses motion, or soon ends it


class FlownSpeeds(NamedTuple):
    """Speeds in m/s that the configuration asks for: of the orbit, and ``max_speed_m_s``."""

    orbit_m_s: float
    greatest_m_s: float


class SettingCheck(NamedTuple):
    """A parameter that the check before a flight judges.

    wanted, remedy : sentences, in which ``speeds`` is a :class:`FlownSpeeds`
    judge : level of a value
    always : whether a row appears where the value was asked for and not reported; else the version lacks it
    """

    name: str
    wanted: str
    remedy: str
    judge: Callable[[float, FlownSpeeds], Level]
    always: bool = False


def warn_if(wrong: Callable[[float], bool]) -> Callable[[float, FlownSpeeds], Level]:
    """A judge that warns."""
    return lambda value, _: Level.WARNING if wrong(value) else Level.OK


class Fence(NamedTuple):
    """The autopilot's own fence as it is set: metres, 0 = unlimited, NaN = not reported.

    problem : why it guards nothing; "" = it does
    """

    problem: str
    radius_m: float
    height_m: float


class FenceSettings(NamedTuple):
    """Parameters of the autopilot's own fence.

    others : beside the two sizes
    how : settings that switch it on, for the remedy
    read : the fence by the parameters; a missing one is NaN
    """

    radius: str
    height: str
    others: tuple[str, ...]
    how: str
    read: Callable[[Callable[[str], float]], Fence]


class Hints(NamedTuple):
    """The autopilot's part of remedies, in words; "" = none.

    port : settings of a telemetry port that the bridge has for itself
    mount : where the kind of the mount is set
    battery : settings of a battery monitor with a current sensor
    by_hand : how the pilot enters the control mode; "" = the pilot cannot
    engaged : why the operator has to engage instead
    limits : what orbits under it cannot do yet
    """

    port: str = ""
    mount: str = ""
    battery: str = ""
    by_hand: str = ""
    engaged: str = ""
    limits: str = ""


# Of an unknown autopilot: nothing flies it.
_NO_COASTING, _NO_HINTS = HeldCoasting(0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.5), Hints()


@dataclass(frozen=True, eq=False)
class Autopilot:
    """One autopilot.  Instances are compared by identity.

    Identity and modes

    name : as in ``VehicleState``;  title : of people
    mav_autopilot : MAV_AUTOPILOT of its heartbeat; None = of no heartbeat
    modes : custom modes by their names; other numbers get pymavlink's names
    submodes : whether a custom mode is a main and a sub mode, in its third and fourth byte
    control_mode, hold_mode : names; "" = it has none
    handed_over_mode : the mode in which the pilot hands over to the bridge
    warm_up_s : how long setpoints must be sent before the control mode is granted
    answers_twice : whether it acknowledges a mode at once, and then in earnest

    Telemetry

    estimator_message : by which it reports the health of its estimator;  estimator_bad : flags that deny it
    rest_flags : those of them that it sets whenever it is at rest: they do not count on the ground
    heartbeat_on_request : whether it grants a rate for its heartbeat; else CURRENT_MODE shows a change of the mode
    integers_in_bytes : whether an integer parameter has its bytes in the field of the float
    velocity_sd_m_s : of its reported velocity, until a flight has shown it
    height_wanders : whether the reported height wanders by decimetres within seconds
    heading_sd_deg : of its reported heading, where it errs by more than its attitude

    Flight by setpoints, and without them

    position_gain_per_s : of its position loop
    continues_setpoints : whether it continues a setpoint by its velocity and acceleration along a path that is limited
        in jerk and overshoots; else it holds a setpoint as it came, and passes its acceleration on to the thrust
    needs_mode_to_stop : whether only another mode stops a vehicle that follows no setpoints; else its time-out has
    starts_from_ground : whether a setpoint may start a vehicle that stands on the ground
    timeout_setting : parameter of the time-out without setpoints, s; "" = none
    shipped_timeout_s : its value where it is not reported
    loss_action : what follows it; None = it holds its position in the control mode
    coasting : motion after the last setpoint
    steady_coast, greatest_coast : shares of ``max_coast_m``: of a steady flight, to which gusts, turns and the way add,
        and of any setpoint
    gives_way_s : of the way of one who walks up to the vehicle, by which he comes nearer before it flies as fast
    echo_m, echo_m_s : how far the echoed target may be from what was sent; infinite = it has another velocity

    Its settings before a flight

    mount_type_setting : parameter of the mount's kind, whose value ``servo_mount`` means servos without a sensor
    checks, fence, hints

    simulated : its counterpart in the simulation; None = it cannot be simulated
    """

    name: str
    title: str = ""
    mav_autopilot: int | None = None
    modes: Mapping[str, int] = field(default_factory=dict)
    submodes: bool = False
    control_mode: str = ""
    hold_mode: str = ""
    handed_over_mode: str = ""
    warm_up_s: float = 0.0
    answers_twice: bool = False

    estimator_message: str = ""
    estimator_bad: int = 0
    rest_flags: int = 0
    heartbeat_on_request: bool = True
    integers_in_bytes: bool = False
    velocity_sd_m_s: float = 0.1
    height_wanders: bool = False
    heading_sd_deg: float = 0.0

    position_gain_per_s: float = 1.0
    continues_setpoints: bool = False
    needs_mode_to_stop: bool = True
    starts_from_ground: bool = True
    timeout_setting: str = ""
    shipped_timeout_s: float = math.inf
    loss_action: LossAction | None = None
    coasting: Coasting = _NO_COASTING
    steady_coast: float = 0.5
    greatest_coast: float = 0.5
    gives_way_s: float = 2.4  # of the slowest one
    echo_m: float = 0.0
    echo_m_s: float = 0.0

    mount_type_setting: str = ""
    servo_mount: float = math.nan
    checks: tuple[SettingCheck, ...] = ()
    fence: FenceSettings | None = None
    hints: Hints = _NO_HINTS
    simulated: Simulated | None = None

    @property
    def supported(self) -> bool:
        """Whether the bridge flies it."""
        return bool(self.control_mode)

    def mode_name(self, custom_mode: int) -> str:
        """Name of a mode; "" = not in the table."""
        return next((name for name, number in self.modes.items() if number == custom_mode), "")

    def mode_numbers(self, mode: str) -> tuple[int, int]:
        """Main and sub mode of MAV_CMD_DO_SET_MODE."""
        number = self.modes[mode]
        return (number >> 16 & 0xFF, number >> 24) if self.submodes else (number, 0)

    def mode_parameters(self, mode: str) -> tuple[float, ...]:
        """The seven parameters of MAV_CMD_DO_SET_MODE."""
        main, sub = self.mode_numbers(mode)
        return (1.0, float(main), float(sub), 0.0, 0.0, 0.0, 0.0)  # 1: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED

    @property
    def loss_names(self) -> tuple[str, ...]:
        """Parameters that decide its flight without setpoints."""
        action = () if self.loss_action is None else (self.loss_action.setting,)
        return (self.timeout_setting, *action) if self.timeout_setting else action

    def loss_settings(self, values: Mapping[str, float]) -> LossSettings | None:
        """Reaction to the loss of setpoints by its parameters; None = it has no such settings."""
        if not self.timeout_setting:
            return None
        timeout_s = values.get(self.timeout_setting, math.nan)
        if self.loss_action is None:
            return LossSettings(self.timeout_setting, timeout_s)
        setting = self.loss_action.setting
        return LossSettings(self.timeout_setting, timeout_s, setting, values.get(setting, math.nan))

    def timeout_s(self, settings: LossSettings | None) -> float:
        """For how long it flies on without setpoints: as reported, else as it ships."""
        reported = math.nan if settings is None else settings.timeout_s
        return self.shipped_timeout_s if math.isnan(reported) else reported

    @property
    def preflight_names(self) -> tuple[str, ...]:
        """Parameters that the check before a flight reads."""
        fence = () if self.fence is None else (self.fence.radius, self.fence.height, *self.fence.others)
        mount = (self.mount_type_setting,) if self.mount_type_setting else ()
        return (*self.loss_names, *fence, *mount, *(check.name for check in self.checks))

    def coast_of(self, setpoint: Setpoint, position: np.ndarray, velocity: np.ndarray, timeout_s: float) -> Coast:
        """Horizontal motion until the vehicle stands, if this setpoint is the last one.

        position, velocity : (3,) m, m/s of the vehicle, in the frame of the setpoint
        """
        here, flown = complex(*position[:2]), complex(*velocity[:2])
        goal, wanted, push = (complex(*vector[:2]) for vector in setpoint[:3])
        return self.coasting.after(here, flown, goal, wanted, push, timeout_s)


#: An autopilot without an instance of its own.
UNKNOWN = Autopilot("other", "an unknown autopilot")
