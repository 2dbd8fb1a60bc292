"""The hold: which place is latched, when it retreats, when the hold mode is requested, and what is seen meanwhile."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import PICTURE_CODES, Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.reports import MAX_LOSS
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.motion_checks import subject_located
from drocap_ros.flight.orbit.states import (
    Commanding,
    Fault,
    Holding,
    Orbiting,
    Requesting,
    SafetyState,
    Sight,
)

_LEAST_S = 0.5  # of a hold before its mode is requested, and of reports without a jump before their place is latched
_STOPPING_S = 1.2  # from 1.5 m/s at braking_m_s2, 1.3
#: Out of sight for longer, the reported position may have jumped unseen (``vehicle_filter.py``).
UNSEEN_S = 0.25
#: Causes that pass by themselves.  A silent link is none of them: motion does not resume because a link returns.
_HARMLESS = PICTURE_CODES | {ConditionCode.ATTITUDE_OUTDATED, ConditionCode.POSITION_FROZEN}


def begin_hold(
    state: Orbiting | Holding | Requesting,
    reason: Condition,
    seen: Observed,
    now_s: float,
    fence_radius_m: float,
    *,
    blind: bool,
    retreats: bool = False,
) -> Holding:
    """A hold at the present position.

    A position that was known a moment ago is extrapolated by the last velocity and held: a position setpoint stops the
    vehicle sooner than velocity zero.

    fence_radius_m : no way out leads beyond it
    blind : whether the vehicle's state is not to be trusted
    retreats : see :class:`Holding`
    """
    vehicle = seen.vehicle
    age_s = max(vehicle.position_age_s, vehicle.age_s)
    # A place continued by the last velocity then errs by 0.15 m at its recorded error.
    known = located(seen) and age_s <= 0.6
    fresh = known and max(seen.link.age_s, age_s) <= UNSEEN_S
    place, fence = None, None if isinstance(state, Requesting) else state.fence_centre
    if known:
        if isinstance(state, Orbiting) and state.pace.value == 0.0 and reason.code in _HARMLESS:
            place = state.pace.place  # it stands there
        else:
            place = _stopping_place(seen, fresh, fence, fence_radius_m)
    return Holding(
        now_s,
        reason,
        modes=state.modes,
        position=place,
        yaw=vehicle.yaw,
        fence_centre=fence,
        blind=blind and not fresh,
        retreats=retreats,
        hold_mode_s=None if seen.course.followed else now_s,
        jumped_s=now_s if seen.jumped else -math.inf,
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
    # Within 5 m of him it always lies on the way out, farther off only from 1 m/s on.
    moves_away = subject.closing_m_s < (0.0 if subject.distance_m < 5.0 else -1.0)
    if subject.position is None or not moves_away:
        return np.zeros(3)
    outward = (seen.vehicle.position - subject.position)[:2] / max(subject.distance_m, 1e-3)
    # At most max_lead_m.
    way = min((max(subject.approach_m_s, 0.0) - subject.closing_m_s) * _STOPPING_S, 1.5)
    aside = velocity[:2] - (velocity[:2] @ outward) * outward
    return np.append(way * outward + 0.5 * _STOPPING_S * aside, 0.0)


def update_hold(state: Holding, seen: Observed, now_s: float, blind: bool) -> Holding:
    """Latch a position that has become known or has jumped, and enter FAULT when the hold mode is not granted.

    After a jump of the reported position (a glitch that comes back, a reset of the autopilot's estimator) the latched
    one names another place, and the vehicle would fly there.
    """
    if seen.jumped:  # no place is known, not even the new one: the reports may be two vehicles'
        state = dataclasses.replace(state, position=None, blind=True, since_s=now_s, jumped_s=now_s)
    settled = now_s - state.jumped_s > _LEAST_S
    if state.blind and not blind and settled:
        state = dataclasses.replace(state, blind=False, since_s=now_s, hold_mode_s=None)
        if state.position is None:
            state = dataclasses.replace(state, position=seen.vehicle.position.copy(), yaw=seen.vehicle.yaw)
    # As engage_timeout_s.
    late = state.hold_mode_s is not None and now_s - state.hold_mode_s > 5.0
    if not late or isinstance(state, Fault) or seen.mode.in_hold or state.sight.lost:
        return state
    reason = condition(ConditionCode.HOLD_MODE_MISSING, cause=state.condition)
    return Fault(**{**vars(state), "since_s": now_s, "condition": reason})


def retreat(state: Holding, seen: Observed, now_s: float, config: MavlinkBridgeConfig) -> Holding:
    """Move the hold position away from an approaching subject, at most to the fence, and never nearer to the subject.

    Only a subject that is located counts, and only until the autopilot's hold mode has been requested.
    """
    place, subject, fence = state.position, seen.subject.position, state.fence_centre
    settled = not state.retreats or state.blind or state.hold_mode_s is not None or seen.mode.in_hold
    if place is None or subject is None or fence is None or settled or not subject_located(seen, config):
        return state
    # Ahead of one who comes by 1.5 s of his way, and 0.3 m beyond the minimum distance.
    wanted = config.min_distance_m + seen.subject.sd_m + 1.5 * max(seen.subject.approach_m_s, 0.0) + 0.3
    if not seen.subject.distance_m < wanted or np.hypot(*(place - subject)[:2]) >= wanted:
        return state
    outward = (seen.vehicle.position - subject)[:2] / max(seen.subject.distance_m, 1e-3)
    here = seen.vehicle.position
    step = subject[:2] + wanted * outward - here[:2]
    # The speed of the retreat is bounded by its lead.
    step *= min(1.0, 3.0 / max(float(np.hypot(*step)), 1e-6))
    target = here[:2] + _share_inside(here, step, fence, config.fence_radius_m) * step
    return dataclasses.replace(state, position=np.append(target, place[2]), retreated_s=now_s)


def request_hold_mode(state: Holding, seen: Observed, now_s: float, config: MavlinkBridgeConfig) -> Holding:
    """Allow the request of the hold mode once the vehicle is at rest, or after ``hold_s``; not on a lossy link."""
    awaited = not isinstance(state, Fault) and state.hold_mode_s is None and not state.sight.lost
    if not awaited or state.blind or seen.link.packet_loss > MAX_LOSS:
        return state
    # A velocity at rest errs by as much.
    slow = bool(np.linalg.norm(seen.vehicle.velocity) < 0.35)
    if slow == (state.slow_s is None):
        state = dataclasses.replace(state, slow_s=now_s if slow else None)
    held_s = now_s - max(state.since_s, state.retreated_s)
    # A vehicle that springs back is slow for a moment where it turns.
    settled = state.slow_s is not None and now_s - state.slow_s >= 0.3
    ready = (settled and held_s > _LEAST_S) or held_s > config.hold_s
    return dataclasses.replace(state, hold_mode_s=now_s) if ready else state


def watch(state: SafetyState, seen: Observed, now_s: float, config: MavlinkBridgeConfig) -> SafetyState:
    """Note when the vehicle is lost from sight, and when it is in sight again.

    In sight again means that a heartbeat has arrived since the loss: fresh attitude with the mode of before the loss
    shows nothing of what the pilot has chosen meanwhile.
    """
    lost_s, seen_s = state.sight
    if not _telemetry_fresh(seen, config):
        return state if lost_s is not None else dataclasses.replace(state, sight=Sight(now_s, seen_s))
    if lost_s is None or seen.link.heartbeat_age_s >= now_s - lost_s:
        return state
    state = dataclasses.replace(state, sight=Sight(None, now_s))
    if not isinstance(state, Holding):
        return state
    state = dataclasses.replace(state, since_s=now_s, hold_mode_s=None)
    if now_s - lost_s <= UNSEEN_S:
        return state
    # The vehicle is held where it is now, and not led back: setpoints may have ended, or its position been reset.
    known = bool(np.isfinite(seen.vehicle.position).all()) and seen.health.located
    return dataclasses.replace(state, position=seen.vehicle.position.copy() if known else None, yaw=seen.vehicle.yaw)


def mode_visible(state: SafetyState, seen: Observed, now_s: float, config: MavlinkBridgeConfig) -> bool:
    """Whether a mode may be requested now: the present one has just been reported, by a link that works both ways.

    The pilot's choice within the age of this report is the only one that a request can override.  Where many packets
    are lost none is requested: such a link ends orbits, and the pilot takes over just then.
    """
    # Longer than the 1 s between two heartbeats, and than packets that were late and arrive after newer ones.
    steady = now_s - state.sight.seen_s >= 1.3 and not state.sight.lost
    late = seen.link.round_trip_s > config.max_round_trip_s  # the request would arrive late too
    return (
        steady and not late and seen.link.packet_loss <= MAX_LOSS and seen.link.heartbeat_age_s <= config.max_mode_age_s
    )


def foreign_mode(state: SafetyState, seen: Observed) -> str:
    """A mode that was reported and is not ours; "" = none.

    While the operator's request is pending the control mode is ours, whoever restores it: an autopilot may keep it
    as its intention after a loss, and then the first setpoint is enough.
    """
    if not isinstance(state, Commanding) or not state.modes:
        return ""
    requested = isinstance(state, Requesting) and seen.mode.in_control
    own = state.modes | ({seen.mode.name} if requested else frozenset())
    foreign = (seen.mode.heard | {seen.mode.name}) - own - {""}
    return seen.mode.name if seen.mode.name in foreign else min(foreign, default="")


def stream_ended(seen: Observed) -> bool:
    """Whether no setpoint was sent for longer than the autopilot's time-out: none may follow by itself.

    A process that was stopped and continues, or a link that returns, would take control back: some autopilots restore
    their control mode with the first setpoint.
    """
    settings = seen.loss_settings
    timeout_s = math.nan if settings is None else settings.timeout_s
    # As max_control_timeout_s, where the autopilot reports none.
    return seen.link.stream_gap_s > (0.5 if math.isnan(timeout_s) else timeout_s)


def _telemetry_fresh(seen: Observed, config: MavlinkBridgeConfig) -> bool:
    # The attitude's stamp shows packets that arrive late; a heartbeat has no stamp.
    newest = max(seen.link.age_s, seen.vehicle.age_s)
    return newest <= config.max_state_age_s and seen.link.heartbeat_age_s <= config.max_heartbeat_age_s
