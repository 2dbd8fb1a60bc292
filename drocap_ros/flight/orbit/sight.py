"""Whether the vehicle, and the mode that the pilot may have changed, can be seen, and whose mode it is."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.mavlink.mode_reports import MAX_LOSS
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.states import Limits, SafetyState, State

#: Telemetry must arrive for so long after a loss before a mode is requested: longer than the 1 s between two
#: heartbeats, and than packets that were late and arrive after newer ones.
_STEADY_S = 1.3
_DEFAULT_TIMEOUT_S = 0.5  # as max_control_timeout_s, where the autopilot reports none
#: Out of sight for longer, the reported position may have jumped unseen (``vehicle_filter.py``).
UNSEEN_S = 0.25


def watch(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> SafetyState:
    """Note when the vehicle is lost from sight, and when it is in sight again.

    In sight again means that a heartbeat has arrived since the loss: fresh attitude with the mode of before the loss
    shows nothing of what the pilot has chosen meanwhile.
    """
    lost = not math.isnan(state.lost_s)
    if not _telemetry_fresh(seen, limits):
        return state if lost else dataclasses.replace(state, lost_s=now_s)
    if not lost or seen.link.heartbeat_age_s >= now_s - state.lost_s:
        return state
    unseen = now_s - state.lost_s > UNSEEN_S
    state = dataclasses.replace(state, lost_s=math.nan, seen_s=now_s)
    if state.state not in (State.HOLDING, State.FAULT):
        return state
    state = dataclasses.replace(state, since_s=now_s, hold_mode_s=math.nan)
    if not unseen:
        return state
    # The vehicle is held where it is now, and not led back: setpoints may have ended, or its position been reset.
    known = bool(np.isfinite(seen.vehicle.position).all()) and seen.health.located
    place = seen.vehicle.position.copy() if known else None
    return dataclasses.replace(state, hold_position=place, hold_yaw=seen.vehicle.yaw)


def is_lost(state: SafetyState) -> bool:
    """Whether the vehicle is out of sight."""
    return not math.isnan(state.lost_s)


def is_silent(state: SafetyState, now_s: float, limits: Limits) -> bool:
    """Whether the vehicle has been out of sight for so long that nothing is sent any more."""
    return now_s - state.lost_s > limits.safety.blind_hold_s  # NaN: in sight


def mode_visible(state: SafetyState, seen: Observed, now_s: float, limits: Limits) -> bool:
    """Whether a mode may be requested now: the present one has just been reported, by a link that works both ways.

    The pilot's choice within the age of this report is the only one that a request can override.  Where many packets
    are lost none is requested: such a link ends orbits, and the pilot takes over just then.
    """
    steady = now_s - state.seen_s >= _STEADY_S and not is_lost(state)
    late = seen.link.round_trip_s > limits.safety.max_round_trip_s  # the request would arrive late too
    return (
        steady and not late and seen.link.packet_loss <= MAX_LOSS and seen.link.heartbeat_age_s <= limits.max_mode_age_s
    )


def foreign_mode(state: SafetyState, seen: Observed) -> str:
    """A mode that was reported and is not ours; "" = none.

    While the operator's request is pending the control mode is ours, whoever restores it: an autopilot may keep it
    as its intention after a loss, and then the first setpoint is enough.
    """
    if not state.modes:
        return ""
    own = state.modes | ({seen.mode.name} if state.requesting and seen.mode.in_control else frozenset())
    foreign = (seen.mode.heard | {seen.mode.name}) - own - {""}
    return seen.mode.name if seen.mode.name in foreign else min(foreign, default="")


def stream_ended(seen: Observed) -> bool:
    """Whether no setpoint was sent for longer than the autopilot's time-out: none may follow by itself.

    A process that was stopped and continues, or a link that returns, would take control back: some autopilots restore
    their control mode with the first setpoint.
    """
    settings = seen.loss_settings
    timeout_s = math.nan if settings is None else settings.timeout_s
    return seen.link.stream_gap_s > (_DEFAULT_TIMEOUT_S if math.isnan(timeout_s) else timeout_s)


def _telemetry_fresh(seen: Observed, limits: Limits) -> bool:
    # The attitude's stamp shows packets that arrive late; a heartbeat has no stamp.
    safety = limits.safety
    newest = max(seen.link.age_s, seen.vehicle.age_s)
    return newest <= safety.max_state_age_s and seen.link.heartbeat_age_s <= safety.max_heartbeat_age_s
