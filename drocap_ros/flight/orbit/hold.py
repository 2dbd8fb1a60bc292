"""The hold: which position is latched, when it retreats from the subject, when the hold mode is requested."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.bridge_config import SafetyConfig
from drocap_ros.flight.conditions import PICTURE_CODES, Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.mode_reports import MAX_LOSS
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.motion_checks import subject_located
from drocap_ros.flight.orbit.sight import UNSEEN_S
from drocap_ros.flight.orbit.states import Limits, SafetyState, State

_AT_REST_M_S = 0.35  # below it a vehicle stands, by a velocity that errs by as much
_SETTLED_S = 0.3  # slow for so long: a vehicle that springs back is slow for a moment where it turns
_LEAST_S = 0.5  # of a hold before its mode is requested, and of reports without a jump before their place is latched
_DEAD_RECKONING_S = 0.6  # of a position by the last velocity: 0.15 m at its recorded error
_NEAR_M = 5.0  # distance of the subject, below which the hold lies on the way out
_FAST_M_S = 1.0  # speed away from him, above which it does anyway
_STOPPING_S = 1.2  # from 1.5 m/s at braking_m_s2, 1.3
_MAX_WAY_OUT_M = 1.5  # as max_lead_m
_LEAD_S = 1.5  # of his way, by which a retreat is ahead of one who comes
_CLEAR_M = 0.3  # of a retreat, beyond min_distance_m
_MAX_LEAD_M = 3.0  # of the retreat's place from the vehicle: its speed is bounded by it
_HOLD_MODE_PATIENCE_S = 5.0  # as engage_timeout_s
#: Causes that pass by themselves.  A silent link is none of them: motion does not resume because a link returns.
_HARMLESS = PICTURE_CODES | {ConditionCode.ATTITUDE_OUTDATED, ConditionCode.POSITION_FROZEN}


def begin_hold(
    state: SafetyState,
    reason: Condition,
    seen: Observed,
    now_s: float,
    fence_radius_m: float,
    *,
    blind: bool,
    retreats: bool = False,
) -> SafetyState:
    """Enter HOLDING at the present position.

    A position that was known a moment ago is extrapolated by the last velocity and held: a position setpoint stops the
    vehicle sooner than velocity zero.

    fence_radius_m : no way out leads beyond it
    blind : whether the vehicle's state is not to be trusted
    retreats : see :class:`SafetyState`
    """
    vehicle = seen.vehicle
    age_s = max(vehicle.position_age_s, vehicle.age_s)
    known = located(seen) and age_s <= _DEAD_RECKONING_S
    fresh = known and max(seen.link.age_s, age_s) <= UNSEEN_S
    place = None
    if known:
        stood = state.pace.value == 0.0 and reason.code in _HARMLESS
        place = state.pace.place if stood else _stopping_place(seen, fresh, state.fence_centre, fence_radius_m)
    return dataclasses.replace(
        state,
        state=State.HOLDING,
        since_s=now_s,
        condition=reason,
        blind=blind and not fresh,
        hold_mode_s=math.nan if seen.course.followed else now_s,
        hold_position=place,
        hold_yaw=vehicle.yaw,
        retreats=retreats,
        retreated_s=-math.inf,
        slow_s=math.nan,
        jumped_s=now_s if seen.jumped else -math.inf,
        resumable=reason.code in _HARMLESS,
        clear_s=math.nan,
    )


def located(seen: Observed) -> bool:
    """Whether the vehicle's place is known, and is the place that the last steps meant."""
    return seen.vehicle.known and seen.health.located and not seen.jumped


def _stopping_place(seen: Observed, fresh: bool, fence: np.ndarray | None, radius_m: float) -> np.ndarray:
    """(3,) m, where a vehicle is to stop whose position is as old as reported."""
    vehicle = seen.vehicle
    behind_s = 0.0 if fresh else max(vehicle.position_age_s - vehicle.age_s, 0.0)
    here: np.ndarray = vehicle.position + vehicle.velocity * behind_s
    way = _way_out(seen)
    return here + _share_inside(here, way, fence, radius_m) * way


def _share_inside(here: np.ndarray, way: np.ndarray, fence: np.ndarray | None, radius_m: float) -> float:
    """Share of a way (3,) m from a place (3,) m until it leaves the fence; 0 for one that leads on outside of it.

    fence : (2,) m, its centre; None = there is none
    """
    if fence is None:
        return 1.0
    offset, step = here[:2] - fence, way[:2]
    if np.hypot(*(offset + step)) <= radius_m:
        return 1.0
    room = radius_m**2 - float(offset @ offset)
    if room <= 0.0:
        return 0.0
    along, length = float(offset @ step), float(step @ step)
    return (math.sqrt(along**2 + length * room) - along) / length


def _way_out(seen: Observed) -> np.ndarray:
    """(3,) m, on the way out for a vehicle that moves away from a near subject, or fast: he may follow.

    It does not return to where it was: it would come back fast.
    """
    subject, velocity = seen.subject, seen.vehicle.velocity
    moves_away = subject.closing_m_s < (0.0 if subject.distance_m < _NEAR_M else -_FAST_M_S)
    if subject.position is None or not moves_away:
        return np.zeros(3)
    outward = (seen.vehicle.position - subject.position)[:2] / max(subject.distance_m, 1e-3)
    way = min((max(subject.approach_m_s, 0.0) - subject.closing_m_s) * _STOPPING_S, _MAX_WAY_OUT_M)
    aside = velocity[:2] - (velocity[:2] @ outward) * outward
    return np.append(way * outward + 0.5 * _STOPPING_S * aside, 0.0)


def update_hold(state: SafetyState, seen: Observed, now_s: float, blind: bool) -> SafetyState:
    """Latch a position that has become known or has jumped, and enter FAULT when the hold mode is not granted.

    After a jump of the reported position (a glitch that comes back, a reset of the autopilot's estimator) the latched
    one names another place, and the vehicle would fly there.
    """
    if seen.jumped:  # no place is known, not even the new one: the reports may be two vehicles'
        state = dataclasses.replace(state, hold_position=None, blind=True, since_s=now_s, jumped_s=now_s)
    settled = now_s - state.jumped_s > _LEAST_S
    if state.blind and not blind and settled:
        state = dataclasses.replace(state, blind=False, since_s=now_s, hold_mode_s=math.nan)
        if state.hold_position is None:
            state = dataclasses.replace(state, hold_position=seen.vehicle.position.copy(), hold_yaw=seen.vehicle.yaw)
    late = now_s - state.hold_mode_s > _HOLD_MODE_PATIENCE_S  # NaN: it was not requested
    if not late or state.state != State.HOLDING or seen.mode.in_hold or not math.isnan(state.lost_s):
        return state
    reason = condition(ConditionCode.HOLD_MODE_MISSING, cause=state.condition)
    return dataclasses.replace(state, state=State.FAULT, since_s=now_s, condition=reason)


def resumption(
    state: SafetyState, seen: Observed, now_s: float, problem: Condition | None, config: SafetyConfig
) -> SafetyState:
    """Note since when all is clear in a hold that may end by itself; any other cause takes this permission away."""
    if not state.resumable:
        return state
    over = now_s - state.since_s > config.resume_after_hold_s or seen.mode.in_hold or not seen.mode.in_control
    if over or (problem is not None and problem.code not in _HARMLESS):
        return dataclasses.replace(state, resumable=False, clear_s=math.nan)
    if problem is not None:
        return dataclasses.replace(state, clear_s=math.nan)
    return state if not math.isnan(state.clear_s) else dataclasses.replace(state, clear_s=now_s)


def retreat(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> SafetyState:
    """Move the hold position away from an approaching subject, at most to the fence, and never nearer to the subject.

    Only a subject that is located counts, and only until the autopilot's hold mode has been requested.
    """
    place, subject, fence, safety = state.hold_position, seen.subject.position, state.fence_centre, limits.safety
    if place is None or subject is None or fence is None or not _may_retreat(state, seen, safety):
        return state
    wanted = limits.orbit.min_distance_m + seen.subject.sd_m + _LEAD_S * max(seen.subject.approach_m_s, 0.0) + _CLEAR_M
    if not seen.subject.distance_m < wanted or np.hypot(*(place - subject)[:2]) >= wanted:
        return state
    outward = (seen.vehicle.position - subject)[:2] / max(seen.subject.distance_m, 1e-3)
    here = seen.vehicle.position
    step = subject[:2] + wanted * outward - here[:2]
    step *= min(1.0, _MAX_LEAD_M / max(float(np.hypot(*step)), 1e-6))
    target = here[:2] + _share_inside(here, step, fence, safety.fence_radius_m) * step
    return dataclasses.replace(state, hold_position=np.append(target, place[2]), retreated_s=now_s)


def _may_retreat(state: SafetyState, seen: Observed, safety: SafetyConfig) -> bool:
    settled = state.blind or not math.isnan(state.hold_mode_s) or seen.mode.in_hold
    return state.retreats and not settled and subject_located(seen, safety)


def request_hold_mode(state: SafetyState, seen: Observed, now_s: float, config: SafetyConfig) -> SafetyState:
    """Allow the request of the hold mode once the vehicle is at rest, or after ``hold_s``; not on a lossy link."""
    if not _awaits_hold_mode(state) or state.blind or seen.link.packet_loss > MAX_LOSS:
        return state
    if state.resumable and now_s - state.since_s <= config.resume_after_hold_s:
        return state
    slow = bool(np.linalg.norm(seen.vehicle.velocity) < _AT_REST_M_S)
    if slow == math.isnan(state.slow_s):
        state = dataclasses.replace(state, slow_s=now_s if slow else math.nan)
    held_s = now_s - max(state.since_s, state.retreated_s)
    still = now_s - state.slow_s >= _SETTLED_S and held_s > _LEAST_S
    return dataclasses.replace(state, hold_mode_s=now_s) if still or held_s > config.hold_s else state


def _awaits_hold_mode(state: SafetyState) -> bool:
    return state.state == State.HOLDING and math.isnan(state.hold_mode_s) and math.isnan(state.lost_s)
