"""When motion may be commanded: an explicit state machine, a pure function of what is observed.

``docs/flight.md`` has the diagram.  Nothing here reads a clock or sends anything: :func:`reduce` gets the state,
what is observed, the time and the operator's command, and says the next state, what may be sent, and why.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.safety_config import SafetyConfig

_AT_REST_M_S = 0.35
_BLIND_MODE_REQUEST_S = 2.0
_BLIND_STOP_S = 10.0
_REACTION_S = 0.5
_NEAR_M, _STOPPING_S, _MAX_WAY_OUT_M = 5.0, 1.2, 1.5
_LEAD_S, _CLEAR_M, _MAX_LEAD_M = 1.5, 0.3, 3.0
_DEAD_RECKONING_S = 0.6
_LEAST_SUBJECT_AGE_S = 0.25
_HOLD_MODE_PATIENCE_S = 5.0
_LANDED_BAD = {1: "on the ground", 3: "taking off", 4: "landing"}


class State(enum.IntEnum):
    """As in ``msg/OrbitStatus.msg``."""

    IDLE = 0
    READY = 1
    ORBITING = 2
    HOLDING = 3
    TAKEN_OVER = 4
    FAULT = 5


class Command(enum.IntEnum):
    """As in ``msg/OrbitCommand.msg``."""

    STOP = 0
    START = 1
    ADJUST = 2
    ENGAGE = 3


class Action(enum.Enum):
    """What may be sent now."""

    NOTHING = "nothing"
    ORBIT = "setpoints of the orbit"
    HOLD = "a position setpoint at the latched place"
    HALT = "velocity zero, where no place is known"


class ModeRequest(enum.Enum):
    """The mode to ask the autopilot for now."""

    NONE = ""
    CONTROL = "control"
    HOLD = "hold"


@dataclass(frozen=True)
class Observed:
    """What is known at one instant; ages in s, infinite = never.

    in_control, in_hold : the mode is GUIDED or OFFBOARD; it is the autopilot's hold mode
    position_age_s : since the reported position last changed: frozen telemetry ages too
    position, velocity : (3,) ENU; the position is carried on over the age of the state
    height_m : above the subject's ground
    subject_distance_m : horizontal
    closing_m_s, approach_m_s : how fast the vehicle moves towards the subject, and the subject towards the vehicle
    round_trip_s : since the sending of what was answered last; NaN = nothing yet
    disturbance : something that ends motion and that no other field tells, in words
    heeded : whether the autopilot follows our setpoints; if not, only a mode can stop it
    settings_problem : what in the autopilot's own settings forbids to fly, in words
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
    echo_age_s: float = math.nan
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
    disturbance: str = ""
    heeded: bool = True
    settings_problem: str = ""


class Limits(NamedTuple):
    """The parameters of the conditions, of both classes that hold them."""

    safety: SafetyConfig
    orbit: OrbitConfig
    warm_up_s: float = 0.0  # how long the autopilot must see setpoints before it grants control


@dataclass(frozen=True)
class SafetyState:
    """State of the machine.

    since_s : of the state
    reason : why it is in it
    hold_position, hold_yaw : latched place
    gives_way : whether that place goes before a subject who walks up to it:
        where nearness ended the orbit, and nothing else is wrong
    moved_s : when it last did
    fence_centre : (2,) where the orbit began
    modes : modes that are no take-over at present; empty = any
    engaging_s : since when control is being asked for; NaN = it is not
    rest_s : when the hold mode was first asked for; NaN = not yet
    blind : whether the hold began without a trustworthy vehicle state
    """

    state: State = State.IDLE
    since_s: float = 0.0
    reason: str = "nothing known yet"
    hold_position: np.ndarray | None = None
    hold_yaw: float = math.nan
    gives_way: bool = False
    moved_s: float = -math.inf
    fence_centre: np.ndarray | None = None
    modes: frozenset[str] = frozenset()
    engaging_s: float = math.nan
    rest_s: float = math.nan
    blind: bool = False


class Decision(NamedTuple):
    """What may be sent now, and the answer to a command ("" without one)."""

    action: Action
    mode_request: ModeRequest
    answer: str


def vehicle_problem(seen: Observed, limits: Limits) -> str:
    """Why the vehicle may not be commanded; "" = it may."""
    safety = limits.safety
    if not safety.commands_enabled:
        return "no motion is commanded: commands are disabled; set commands_enabled to true to allow it"
    if seen.disturbance:
        return seen.disturbance
    if seen.link_age_s > safety.max_state_age_s:
        return f"nothing heard from the autopilot {_ago(seen.link_age_s)}"
    if seen.autopilot not in ("ardupilot", "px4"):
        return f"the autopilot is {seen.autopilot!r}: only ArduPilot and PX4 are commanded"
    if seen.settings_problem:
        return seen.settings_problem
    if seen.heartbeat_age_s > safety.max_heartbeat_age_s:
        return f"flight mode last told {_ago(seen.heartbeat_age_s)}"
    if seen.state_age_s > safety.max_state_age_s:
        return f"the vehicle's attitude is {seen.state_age_s:.1f} s old"
    if seen.position_age_s > safety.max_state_age_s:
        return f"the vehicle's position has not changed for {seen.position_age_s:.1f} s: telemetry lost or frozen"
    if seen.round_trip_s > safety.max_round_trip_s:
        return f"the autopilot has answered nothing that was sent within the last {seen.round_trip_s:.1f} s"
    if not (np.isfinite(seen.position).all() and np.isfinite(seen.velocity).all() and math.isfinite(seen.yaw)):
        return "the vehicle's position, velocity or heading is unknown"
    if not seen.armed:
        return "the motors are not armed"
    if seen.landed_state in _LANDED_BAD:
        return f"the vehicle is {_LANDED_BAD[seen.landed_state]}"
    if seen.gps_fix_type < 3:
        return f"no 3D satellite fix (type {seen.gps_fix_type})"
    if not seen.position_ok:
        return "the autopilot's estimator reports no usable position"
    if seen.status_age_s > safety.max_status_age_s:
        return f"GPS, estimator or battery last told {_ago(seen.status_age_s)}"
    if math.isnan(seen.battery_fraction):
        return "the battery's charge is unknown"
    if seen.battery_fraction < safety.min_battery_fraction:
        return f"the battery is at {100 * seen.battery_fraction:.0f} %"
    return ""


def limit_problem(seen: Observed, fence_centre: np.ndarray | None, limits: Limits) -> str:
    """Which limit of place or speed is reached, counting what it takes to brake; "" = none.

    The vehicle's state must be known.
    """
    safety = limits.safety
    speed = float(np.linalg.norm(seen.velocity))
    if speed > safety.speed_margin * limits.orbit.max_speed_m_s:
        return f"speed of {speed:.1f} m/s above the limit"
    climb = float(seen.velocity[2])
    margin = _braking(climb, safety)
    if seen.height_m + (margin if climb > 0 else 0.0) > safety.max_height_m:
        return f"height of {seen.height_m:.1f} m at the limit of {safety.max_height_m:g} m"
    if seen.height_m - (margin if climb < 0 else 0.0) < safety.min_height_m:
        return f"height of {seen.height_m:.1f} m at the limit of {safety.min_height_m:g} m"
    if fence_centre is not None:
        offset = seen.position[:2] - fence_centre
        distance = float(np.hypot(*offset))
        outward = max(float(offset @ seen.velocity[:2]) / max(distance, 1e-6), 0.0)
        if distance + _braking(outward, safety) > safety.fence_radius_m:
            return f"{distance:.1f} m from where the orbit began: at the fence of {safety.fence_radius_m:g} m"
    return ""


def subject_problem(seen: Observed, limits: Limits) -> str:
    """Why the subject's position does not allow motion; "" = it does."""
    safety = limits.safety
    if seen.subject is None:
        return "no subject is tracked"
    speed = float(np.linalg.norm(np.nan_to_num(seen.velocity)))
    oldest_s = min(safety.max_subject_age_s, max(safety.max_blind_m / max(speed, 1e-3), _LEAST_SUBJECT_AGE_S))
    if not -0.2 < seen.subject_age_s <= oldest_s:
        return f"the subject was last located {_ago(seen.subject_age_s)}"
    if not seen.subject_sd_m <= safety.max_subject_sd_m:
        return f"the subject's position is uncertain by {seen.subject_sd_m:.1f} m"
    if near := nearness_problem(seen, limits):
        return near
    if seen.subject_distance_m > limits.orbit.max_distance_m:
        return f"the subject is {seen.subject_distance_m:.1f} m away: farther than {limits.orbit.max_distance_m:g} m"
    return ""


def nearness_problem(seen: Observed, limits: Limits) -> str:
    """Why a subject whose place is known is too near, counting what it takes to brake; "" = it is not."""
    # Braking takes the speed at which the distance shrinks.  A subject that walks towards the vehicle cannot be
    # stopped: its steps until a hold has begun count.  One that is followed may stop dead: its speed counts too.
    chase, approach = max(-seen.approach_m_s, 0.0), max(seen.approach_m_s, 0.0)
    own = max(seen.closing_m_s - chase, 0.0)
    room = _braking(own, limits.safety) + _braking(chase, limits.safety) + _REACTION_S * approach
    # The subject may be nearer than it seems.
    if not seen.subject_distance_m - room - seen.subject_sd_m >= limits.orbit.min_distance_m:
        return (
            f"the subject is {seen.subject_distance_m:.1f} m away, give or take {seen.subject_sd_m:.1f} m: at the "
            f"limit of {limits.orbit.min_distance_m:g} m"
        )
    return ""


def reduce(
    state: SafetyState, seen: Observed, now_s: float, command: Command | None, limits: Limits
) -> tuple[SafetyState, Decision]:
    """One step of the machine.

    Parameters
    ----------
    now_s : monotonic
    command : the operator's, or None

    Returns
    -------
    The next state, and what may be sent until the step after it.
    """
    vehicle = vehicle_problem(seen, limits)
    place = "" if vehicle else limit_problem(seen, state.fence_centre, limits)
    problem = vehicle or place or subject_problem(seen, limits)
    known_mode = seen.link_age_s <= limits.safety.max_state_age_s
    if state.modes and seen.mode not in state.modes and seen.mode and known_mode:
        reason = f"the mode became {seen.mode} by another hand: the pilot has taken over; silent until told otherwise"
        state = _enter(State.TAKEN_OVER, reason, now_s)
    elif state.state in _ACTIVE and known_mode and not seen.armed and seen.mode:
        state = _enter(State.IDLE, "the motors were disarmed", now_s)
    elif state.modes and seen.in_hold:
        # Once the autopilot holds, any other mode is somebody's choice.
        state = dataclasses.replace(state, modes=frozenset({seen.mode}))
    state, answer = _obey(state, seen, now_s, command, problem, limits)
    if state.state == State.ORBITING:
        if problem:
            near = problem == nearness_problem(seen, limits)
            state = _hold(state, problem, seen, now_s, bool(vehicle), gives_way=near)
    elif state.state in (State.IDLE, State.READY):
        state = _await(state, seen, now_s, problem, limits)
    elif state.state in (State.HOLDING, State.FAULT):
        state = _settle(state, seen, now_s, bool(vehicle))
        gave_way = state if vehicle or place else _give_way(state, seen, now_s, limits)
        state = gave_way if gave_way is not state else _at_rest(state, seen, now_s, limits.safety)
    return state, Decision(*_what_to_send(state, seen, now_s, limits), answer)


_ACTIVE = frozenset({State.ORBITING, State.HOLDING, State.FAULT})


def _obey(
    state: SafetyState, seen: Observed, now_s: float, command: Command | None, problem: str, limits: Limits
) -> tuple[SafetyState, str]:
    if command is None:
        return state, ""
    if command == Command.STOP:
        return _stop(state, seen, now_s, limits)
    if command == Command.ADJUST:
        if state.state == State.ORBITING:
            return state, "adjusted"
        return state, f"refused: adjust needs a running orbit, the state is {state.state.name.lower()}"
    if state.state == State.ORBITING:
        return state, "already orbiting"
    if state.state == State.TAKEN_OVER:
        return state, "refused: the pilot has taken over; send stop to acknowledge it, then start"
    if state.state == State.FAULT:
        return state, f"refused: {state.reason}; send stop to acknowledge it, then start"
    if problem:
        return state, f"refused: {problem}"
    if not math.isnan(state.engaging_s):
        return state, "already asking the autopilot for control"
    if seen.in_control:
        return _orbit(seen, now_s), "orbiting"
    if command == Command.START:
        return state, f"refused: the mode is {seen.mode}; switch to GUIDED or OFFBOARD, or send engage"
    if not limits.safety.mode_change_allowed:
        return state, f"refused: the mode is {seen.mode} and mode_change_allowed is false; switch it by hand"
    state = _enter(
        State.READY, "asking the autopilot for control", now_s, modes=frozenset({seen.mode}), engaging_s=now_s,
        hold_position=seen.position.copy(), hold_yaw=seen.yaw,
    )  # fmt: skip
    return state, "asking the autopilot for control"


def _stop(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> tuple[SafetyState, str]:
    if state.state == State.ORBITING:
        return _hold(state, "stopped by the operator", seen, now_s, bool(vehicle_problem(seen, limits))), "holding"
    if state.state in (State.TAKEN_OVER, State.FAULT):
        return _enter(State.IDLE, "acknowledged by the operator", now_s), "acknowledged"
    if not math.isnan(state.engaging_s):
        return _enter(State.IDLE, "stopped by the operator", now_s), "no longer asking for control"
    if state.state == State.HOLDING:
        return state, "already holding"
    return state, "not orbiting"


def _await(state: SafetyState, seen: Observed, now_s: float, problem: str, limits: Limits) -> SafetyState:
    """Idle and ready, and while control is asked for."""
    if not math.isnan(state.engaging_s):
        if problem:
            return _enter(State.IDLE, f"no longer asking for control: {problem}", now_s)
        if seen.in_control:
            return _orbit(seen, now_s)
        if now_s - state.engaging_s > limits.safety.engage_timeout_s + limits.warm_up_s:
            return _enter(State.READY, "the autopilot did not grant control", now_s)
        return state
    wanted = State.IDLE if problem else State.READY
    if state.state == wanted and state.reason == (problem or state.reason):
        return state
    return _enter(wanted, problem or "all conditions for motion hold", now_s)


def _settle(state: SafetyState, seen: Observed, now_s: float, blind: bool) -> SafetyState:
    """Holding: what was unknown at its beginning may become known, and the hold mode may fail to come."""
    if state.blind and not blind:
        state = dataclasses.replace(state, blind=False, since_s=now_s, rest_s=math.nan)
        if state.hold_position is None:
            state = dataclasses.replace(state, hold_position=seen.position.copy(), hold_yaw=seen.yaw)
    late = not math.isnan(state.rest_s) and now_s - state.rest_s > _HOLD_MODE_PATIENCE_S
    if state.state == State.HOLDING and late and not seen.in_hold:
        reason = f"{state.reason}; the autopilot's hold mode does not come: take over by hand"
        return dataclasses.replace(state, state=State.FAULT, since_s=now_s, reason=reason)
    return state


def _what_to_send(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> tuple[Action, ModeRequest]:
    if state.state == State.ORBITING:
        return Action.ORBIT, ModeRequest.NONE
    if state.state == State.READY and not math.isnan(state.engaging_s):
        warm = now_s - state.engaging_s >= limits.warm_up_s
        return Action.HOLD, ModeRequest.CONTROL if warm else ModeRequest.NONE
    if state.state not in (State.HOLDING, State.FAULT) or seen.in_hold:
        return Action.NOTHING, ModeRequest.NONE
    if state.blind:
        since = now_s - state.since_s
        # Not at once: the autopilot's brake takes longer than velocity zero.  And not without seeing the mode: the
        # pilot may have taken over unseen; setpoints are ignored then, a request for a mode would not be.
        seen_mode = seen.link_age_s <= limits.safety.max_state_age_s and seen.in_control
        asked = ModeRequest.HOLD if since > _BLIND_MODE_REQUEST_S and seen_mode else ModeRequest.NONE
        action = Action.HALT if state.hold_position is None else Action.HOLD
        return (action if since < _BLIND_STOP_S else Action.NOTHING), asked
    return Action.HOLD, ModeRequest.NONE if math.isnan(state.rest_s) else ModeRequest.HOLD


def _at_rest(state: SafetyState, seen: Observed, now_s: float, config: SafetyConfig) -> SafetyState:
    """Note that the place has been reached, or waited for long enough, so that the hold mode may be asked for."""
    if state.state != State.HOLDING or not math.isnan(state.rest_s) or state.blind:
        return state
    held_s = now_s - max(state.since_s, state.moved_s)
    still = bool(np.linalg.norm(seen.velocity) < _AT_REST_M_S) and held_s > 0.5
    if still or held_s > config.hold_s:
        return dataclasses.replace(state, rest_s=now_s)
    return state


def permit_mode(state: SafetyState, mode: str) -> SafetyState:
    """The bridge has just asked for this mode: its coming is no take-over."""
    return dataclasses.replace(state, modes=state.modes | {mode}) if state.modes else state


def _orbit(seen: Observed, now_s: float) -> SafetyState:
    assert seen.subject is not None
    return _enter(
        State.ORBITING, "orbiting the subject", now_s, modes=frozenset({seen.mode}),
        fence_centre=seen.subject[:2].copy(), hold_position=seen.position.copy(), hold_yaw=seen.yaw,
    )  # fmt: skip


def _hold(
    state: SafetyState, reason: str, seen: Observed, now_s: float, blind: bool, gives_way: bool = False
) -> SafetyState:
    # Something may be wrong while the place is still known, or was until a moment ago: then a place is held, the
    # one that the last known velocity leads to.  A position setpoint stops sooner than velocity zero.
    age_s = max(seen.position_age_s, seen.state_age_s)
    finite = bool(np.isfinite(seen.position).all() and np.isfinite(seen.velocity).all()) and math.isfinite(seen.yaw)
    known = finite and seen.position_ok and seen.gps_fix_type >= 3 and age_s <= _DEAD_RECKONING_S
    fresh = known and max(seen.link_age_s, age_s) <= 0.25
    behind_s = 0.0 if fresh else max(seen.position_age_s - seen.state_age_s, 0.0)
    place = seen.position + seen.velocity * behind_s if known else None
    if place is not None and seen.subject is not None and seen.subject_distance_m < _NEAR_M and seen.closing_m_s < 0:
        # On its way out from a subject that is near, and may come nearer, it does not come back to where it was.
        outward = (seen.position - seen.subject)[:2] / max(seen.subject_distance_m, 1e-3)
        way = min((max(seen.approach_m_s, 0.0) - seen.closing_m_s) * _STOPPING_S, _MAX_WAY_OUT_M)
        aside = seen.velocity[:2] - (seen.velocity[:2] @ outward) * outward
        place = place + np.append(way * outward + 0.5 * _STOPPING_S * aside, 0.0)
    return dataclasses.replace(
        state, state=State.HOLDING, since_s=now_s, reason=reason, blind=blind and not fresh,
        rest_s=math.nan if seen.heeded else now_s, hold_position=place, hold_yaw=seen.yaw,
        gives_way=gives_way, moved_s=-math.inf,
    )  # fmt: skip


def _give_way(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> SafetyState:
    """Holding, and the subject walks up to the vehicle: the place that is held goes before it, up to the fence.

    Only what is known of the subject counts, and only until the autopilot's own hold mode has been asked for.
    """
    place, subject, safety = state.hold_position, seen.subject, limits.safety
    settled = state.blind or not math.isnan(state.rest_s) or seen.in_hold
    if settled or not state.gives_way or place is None or subject is None or state.fence_centre is None:
        return state
    if not -0.2 < seen.subject_age_s <= safety.max_subject_age_s or not seen.subject_sd_m <= safety.max_subject_sd_m:
        return state
    wanted = limits.orbit.min_distance_m + seen.subject_sd_m + _LEAD_S * max(seen.approach_m_s, 0.0) + _CLEAR_M
    if not seen.subject_distance_m < wanted or np.hypot(*(place - subject)[:2]) >= wanted:
        return state
    outward = (seen.position - subject)[:2] / max(seen.subject_distance_m, 1e-3)
    target = subject[:2] + wanted * outward
    step = target - seen.position[:2]
    target = seen.position[:2] + step * min(1.0, _MAX_LEAD_M / max(float(np.hypot(*step)), 1e-6))
    offset = target - state.fence_centre
    room = safety.fence_radius_m - _braking(limits.orbit.max_speed_m_s, safety)
    target = state.fence_centre + offset * min(1.0, room / max(float(np.hypot(*offset)), 1e-6))
    return dataclasses.replace(state, hold_position=np.append(target, place[2]), moved_s=now_s)


def _enter(state: State, reason: str, now_s: float, **values: object) -> SafetyState:
    return SafetyState(state=state, since_s=now_s, reason=reason, **values)  # type: ignore[arg-type]


def _braking(speed: float, config: SafetyConfig) -> float:
    return speed * speed / (2 * config.braking_m_s2)


def _ago(age_s: float) -> str:
    return f"{age_s:.1f} s ago" if math.isfinite(age_s) else "never"
