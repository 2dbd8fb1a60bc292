"""What leads out of a state of the machine, in words for the operator."""

from __future__ import annotations

from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.sight import stream_ended
from drocap_ros.flight.orbit.states import SafetyState, State


def by_hand(seen: Observed) -> str:
    """How the pilot enters the control mode, as the end of a sentence."""
    return f", or {seen.autopilot.hints.by_hand}" if seen.autopilot.hints.by_hand else ""


def way_out(state: SafetyState, seen: Observed, *, mode_change_allowed: bool) -> str:
    """What the operator may do next, as a sentence; "" = nothing leads out, or the condition says it."""
    if state.state in (State.TAKEN_OVER, State.FAULT):
        return "`drocap orbit stop` acknowledges it, and nothing begins before"
    if state.requesting or state.state not in (State.READY, State.HOLDING):
        return ""
    if not seen.mode.in_control:
        hand = by_hand(seen).removeprefix(", or ")
        if mode_change_allowed:
            return f"`drocap orbit engage` requests control and begins an orbit{by_hand(seen)}"
        return f"{hand}, then `drocap orbit start`" if hand else "engage needs mode_change_allowed"
    silent = state.state == State.HOLDING and stream_ended(seen)
    return ("nothing is sent any more; " if silent else "") + "`drocap orbit start` begins an orbit"
