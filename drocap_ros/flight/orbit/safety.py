"""The orbit's state machine: a pure function of state, observation, time and command.  ``docs/flight.md`` draws it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.reports import MAX_LOSS
from drocap_ros.flight.mavlink.telemetry_request import CURRENT_MODE_HZ
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.hold import (
    begin_hold,
    foreign_mode,
    mode_visible,
    request_hold_mode,
    retreat,
    stream_ended,
    update_hold,
    watch,
)
from drocap_ros.flight.orbit.motion_checks import (
    keeping_condition,
    limit_condition,
    start_condition,
    subject_condition,
    vehicle_condition,
)
from drocap_ros.flight.orbit.speed import allowed_pace, next_pace
from drocap_ros.flight.orbit.states import (
    Action,
    Command,
    CommandAnswer,
    Commanding,
    Decision,
    Fault,
    Holding,
    Idle,
    ModeRequest,
    Orbiting,
    Pace,
    Ready,
    Requesting,
    SafetyState,
    TakenOver,
)
from drocap_ros.flight.orbit.watchdog import GIVE_UP_S

_C = ConditionCode
_INTENTION_S = 2.0 / CURRENT_MODE_HZ  # two periods of CURRENT_MODE, which says what is intended


def reduce(
    state: SafetyState, seen: Observed, now_s: float, command: Command | None, config: MavlinkBridgeConfig
) -> tuple[SafetyState, Decision]:
    """One step of the machine.

    now_s : monotonic
    command : the operator's, or None
    returns : the next state, and what may be sent until the step after it
    """
    state = watch(state, seen, now_s, config)
    sight = state.sight
    state = _by_mode(state, seen, now_s)
    vehicle, place, problem = _problems(state, seen, config)
    answer = None
    if command is not None:
        state, answer = _execute(state, seen, now_s, command, problem, config)
    if isinstance(state, Orbiting):
        state = _orbit(state, seen, now_s, vehicle is not None, config)
    elif isinstance(state, Requesting):
        state = _request(state, seen, now_s, problem, config)
    elif isinstance(state, Idle):
        state = _wait(state, seen, now_s, problem, config)
    elif isinstance(state, Holding) and not stream_ended(seen):
        state = update_hold(state, seen, now_s, vehicle is not None)
        moved = state if vehicle or place else retreat(state, seen, now_s, config)
        state = moved if moved is not state else request_hold_mode(state, seen, now_s, config)
    state = dataclasses.replace(state, sight=sight)
    return state, Decision(*_permitted(state, seen, now_s, config), answer)


def _problems(
    state: SafetyState, seen: Observed, config: MavlinkBridgeConfig
) -> tuple[Condition | None, Condition | None, Condition | None]:
    """Why vehicle and place forbid motion, and the first cause of all that no orbit may begin."""
    vehicle = vehicle_condition(seen, config)
    place = None if vehicle else limit_condition(seen, _fence(state), config)
    problem = vehicle or place or subject_condition(seen, config) or start_condition(seen)
    if problem is None and seen.subject.position is not None:  # the fence of the next orbit is around him
        problem = limit_condition(seen, seen.subject.position[:2], config)
    return vehicle, place, problem


def _fence(state: SafetyState) -> np.ndarray | None:
    """(2,) m, centre of the fence; None = there is none."""
    return state.fence_centre if isinstance(state, Orbiting | Holding) else None


def _by_mode(state: SafetyState, seen: Observed, now_s: float) -> SafetyState:
    """The state that the reported mode leaves; however late it is heard, a mode of somebody else is a take-over."""
    if _returned(state, seen):
        return Idle(now_s, condition(_C.ALL_CLEAR))
    if foreign := foreign_mode(state, seen) or _misjudged(state, seen, now_s):
        return _yield(state, seen, foreign, now_s)
    if not isinstance(state, Orbiting | Holding):
        return state
    if not state.sight.lost and not seen.health.armed and seen.mode.name:
        return Idle(now_s, condition(_C.DISARMED))
    if seen.mode.in_hold:
        # Once the autopilot holds, any other mode is somebody's choice, and the next orbit has a fence of its own.
        fence = None if isinstance(state, Holding) else state.fence_centre
        return dataclasses.replace(state, modes=frozenset({seen.mode.name}), fence_centre=fence)
    return state


def _returned(state: SafetyState, seen: Observed) -> bool:
    """Whether the pilot gives control back after our own hold mode: nothing is sent, but a start is enough then."""
    return (
        isinstance(state, Holding)
        and not isinstance(state, Fault)
        and bool(state.modes)
        and seen.mode.in_control
        and seen.mode.name not in state.modes
    )


def _orbit(state: Orbiting, seen: Observed, now_s: float, blind: bool, config: MavlinkBridgeConfig) -> SafetyState:
    """Slow the orbit down by the age of the data, or end it."""
    problem = _ending(state, seen, config) or keeping_condition(seen, config)
    if 0.0 < (limit_s := config.max_orbit_s) < now_s - state.since_s:
        problem = problem or condition(_C.ORBIT_TIME_OVER, limit_s=limit_s)
    if problem:
        near = problem.code == _C.SUBJECT_NEAR
        return begin_hold(state, problem, seen, now_s, config.fence_radius_m, blind=blind, retreats=near)
    allowed, cause = allowed_pace(seen, config)
    pace = next_pace(state.pace, allowed, now_s, seen.vehicle.position, contradicted=seen.subject.contradicted)
    reason = state.condition
    if cause is not None:
        reason = condition(_C.DEGRADED, cause=cause)
    elif pace.value == 1.0:
        reason = condition(_C.ORBITING)
    return dataclasses.replace(state, pace=pace, condition=reason)


def _ending(state: SafetyState, seen: Observed, config: MavlinkBridgeConfig) -> Condition | None:
    """Why an orbit that is flown or requested must end; gaps of the data end it later than they forbid its start."""
    vehicle = vehicle_condition(seen, config, patient=True)
    place = None if vehicle else limit_condition(seen, _fence(state), config)
    return vehicle or place or subject_condition(seen, config, patient=True)


def _yield(state: SafetyState, seen: Observed, mode: str, now_s: float) -> SafetyState:
    """End all commands: the mode is not ours."""
    if not (seen.mode.left_by_itself and mode == seen.mode.name):
        return TakenOver(now_s, condition(_C.PILOT_TOOK_OVER, mode=mode))
    evidence = f"the autopilot has left its control mode for {mode} by itself, as where setpoints do not arrive"
    reason = seen.disturbance or condition(_C.SETPOINTS_NOT_FOLLOWED, evidence=evidence)
    if not seen.mode.in_hold:
        return TakenOver(now_s, reason)
    # Its hold is the one in which a stop ends; nothing is sent in it.
    return Holding(now_s, state.condition if isinstance(state, Holding) else reason, modes=frozenset({mode}))


def _misjudged(state: SafetyState, seen: Observed, now_s: float) -> str:
    """The mode that was taken for the pilot's because a heartbeat came before the report of what is intended."""
    taken = isinstance(state, TakenOver) and state.condition.code == _C.PILOT_TOOK_OVER
    if taken and seen.mode.left_by_itself and now_s - state.since_s < _INTENTION_S:
        return seen.mode.name if state.condition.values.get("mode") == seen.mode.name else ""
    return ""


def permit_mode(state: SafetyState, mode: str) -> SafetyState:
    """Note that the bridge has requested this mode: its arrival is no take-over."""
    if not isinstance(state, Commanding) or not state.modes:
        return state
    return dataclasses.replace(state, modes=state.modes | {mode})


def _execute(
    state: SafetyState,
    seen: Observed,
    now_s: float,
    command: Command,
    problem: Condition | None,
    config: MavlinkBridgeConfig,
) -> tuple[SafetyState, CommandAnswer]:
    if command == Command.PRESENT:
        return state, _accepted(_C.NONE)
    state = dataclasses.replace(state, failed=None, asked_s=-math.inf) if isinstance(state, Idle) else state
    if command == Command.STOP:
        return _stop(state, seen, now_s, config)
    if command == Command.ADJUST:
        if isinstance(state, Orbiting):
            return state, _accepted(_C.ADJUSTED)
        return state, _refused(_C.NO_ORBIT_TO_ADJUST, state=state.state.name.lower())
    if isinstance(state, Orbiting):
        return state, _accepted(_C.ALREADY_ORBITING)
    if (refused := _start_refusal(state, seen, problem)) is not None:
        return state, refused
    if isinstance(state, Requesting):
        return state, _accepted(_C.ALREADY_REQUESTING_CONTROL)
    if seen.mode.in_control:
        return _begin_orbit(seen, now_s), _accepted(_C.ORBITING)
    if (refused := _request_refusal(seen, command, config)) is not None:
        return state, refused
    answer = _accepted(_C.REQUESTING_CONTROL)
    place, modes = seen.vehicle.position.copy(), frozenset({seen.mode.name})
    return Requesting(now_s, answer.condition, modes=modes, position=place, yaw=seen.vehicle.yaw), answer


def _start_refusal(state: SafetyState, seen: Observed, problem: Condition | None) -> CommandAnswer | None:
    """Why no orbit may begin by a command."""
    if isinstance(state, TakenOver):
        return _refused(_C.PILOT_IN_COMMAND)
    if isinstance(state, Fault):
        return _refused(_C.FAULT_NOT_ACKNOWLEDGED, cause=state.condition)
    if problem:
        return CommandAnswer(False, problem)
    pending = isinstance(state, Holding) and state.hold_mode_s is not None and state.modes > {seen.mode.name}
    if pending and seen.mode.in_control:
        # The hold mode has been requested: it would arrive during the orbit, and count as the pilot's.
        return _refused(_C.HOLD_MODE_PENDING, by_hand=by_hand(seen))
    return None


def _request_refusal(seen: Observed, command: Command, config: MavlinkBridgeConfig) -> CommandAnswer | None:
    """Why control may not be requested from the autopilot."""
    if not config.mode_change_allowed:
        engaged = f" ({seen.autopilot.hints.engaged})" if seen.autopilot.hints.engaged else ""
        return _refused(_C.MODE_CHANGE_FORBIDDEN, mode=seen.mode.name, engaged=engaged, by_hand=by_hand(seen))
    if command == Command.START:
        return _refused(_C.NOT_IN_CONTROL_MODE, mode=seen.mode.name, by_hand=by_hand(seen))
    if seen.link.packet_loss > MAX_LOSS:
        return _refused(_C.PACKETS_LOST, lost_percent=100 * seen.link.packet_loss, most_percent=100 * MAX_LOSS)
    return None


def _stop(
    state: SafetyState, seen: Observed, now_s: float, config: MavlinkBridgeConfig
) -> tuple[SafetyState, CommandAnswer]:
    if isinstance(state, Orbiting) or (isinstance(state, Holding) and state.retreats and not isinstance(state, Fault)):
        answer = _accepted(_C.STOPPED)
        blind = vehicle_condition(seen, config) is not None
        return begin_hold(state, answer.condition, seen, now_s, config.fence_radius_m, blind=blind), answer
    if isinstance(state, TakenOver | Fault | Requesting):
        requested = isinstance(state, Requesting)
        answer = _accepted(_C.STOPPED if requested else _C.ACKNOWLEDGED)
        return Idle(now_s, answer.condition, asked_s=now_s if requested else -math.inf), answer
    if isinstance(state, Holding):
        return state, _accepted(_C.ALREADY_HOLDING)
    return state, _accepted(_C.NOT_ORBITING)


def _request(
    state: Requesting, seen: Observed, now_s: float, problem: Condition | None, config: MavlinkBridgeConfig
) -> SafetyState:
    """While control is requested; a short gap of the data delays the orbit.

    The vehicle is held where it is, not where it was when control was asked for: the pilot flies it until the
    autopilot grants control, and that is seen late.
    """
    cause = _ending(state, seen, config)
    if cause is None:
        state = dataclasses.replace(state, position=seen.vehicle.position.copy(), yaw=seen.vehicle.yaw)
        if seen.mode.in_control and not problem:
            return _begin_orbit(seen, now_s)
        if now_s - state.since_s <= config.engage_timeout_s + seen.autopilot.warm_up_s:
            return state
        cause = problem if seen.mode.in_control else None  # with the mode granted, it has delayed the orbit so long
    failed = condition(_C.REQUEST_ENDED, cause=cause) if cause else _not_granted(seen)
    ended = (Idle if problem else Ready)(now_s, failed, failed=failed, asked_s=now_s)
    return _wait(ended, seen, now_s, problem, config)


def _wait(
    state: Idle, seen: Observed, now_s: float, problem: Condition | None, config: MavlinkBridgeConfig
) -> SafetyState:
    """Idle and ready; control that is granted when nobody asks for it any more is held, and handed on."""
    if seen.mode.in_control and now_s - state.asked_s <= config.engage_timeout_s:
        blind = vehicle_condition(seen, config) is not None
        granted = Requesting(now_s, modes=frozenset({seen.mode.name}))
        reason = state.failed or state.condition
        return begin_hold(granted, reason, seen, now_s, config.fence_radius_m, blind=blind)
    reason = problem or state.failed or condition(_C.ALL_CLEAR)
    wanted = Idle if problem else Ready
    if (type(state), state.condition) == (wanted, reason):
        return state
    return wanted(now_s, reason, failed=state.failed, asked_s=state.asked_s)


def _not_granted(seen: Observed) -> Condition:
    answer = seen.refusal
    if seen.mode.left_by_itself:
        answer = "it holds although setpoints arrive: another failsafe of it acts, which its pilot has to end"
    return condition(_C.CONTROL_NOT_GRANTED, answer=f" ({answer})" if answer else "")


def _permitted(
    state: SafetyState, seen: Observed, now_s: float, config: MavlinkBridgeConfig
) -> tuple[Action, ModeRequest]:
    if isinstance(state, Orbiting):
        return Action.ORBIT, ModeRequest.NONE
    if isinstance(state, Requesting):
        # Where the autopilot still intends the control mode, setpoints alone end the failsafe for their loss.  A
        # request would end any other failsafe, too: the autopilot takes it for a pilot who takes over.
        own_loss, warm = seen.mode.left_by_itself, now_s - state.since_s >= seen.autopilot.warm_up_s
        wanted = warm and not own_loss and start_condition(seen) is None and mode_visible(state, seen, now_s, config)
        return Action.HOLD, ModeRequest.CONTROL if wanted else ModeRequest.NONE
    unseen_s = 0.0 if state.sight.lost_s is None else now_s - state.sight.lost_s
    silent = not seen.mode.in_control or unseen_s > config.blind_hold_s or stream_ended(seen)
    if isinstance(state, Holding) and not silent:
        return _permitted_in_hold(state, seen, now_s, config)
    return Action.NOTHING, ModeRequest.NONE


def _permitted_in_hold(
    state: Holding, seen: Observed, now_s: float, config: MavlinkBridgeConfig
) -> tuple[Action, ModeRequest]:
    action, since = Action.HALT if state.position is None else Action.HOLD, now_s - state.since_s
    if state.blind and since >= GIVE_UP_S:
        action = Action.NOTHING
    # Not at once: the autopilot's brake takes longer than velocity zero.  And not without a visible mode: the pilot
    # may have taken over unseen; setpoints are ignored then, a request for a mode would not be.
    # At velocity zero for 2 s, from 2.5 m/s at braking_m_s2: a brake by the mode takes longer.
    wanted = since > 2.0 if state.blind else state.hold_mode_s is not None
    return action, ModeRequest.HOLD if wanted and mode_visible(state, seen, now_s, config) else ModeRequest.NONE


def _begin_orbit(seen: Observed, now_s: float) -> Orbiting:
    assert seen.subject.position is not None
    centre, modes = seen.subject.position[:2].copy(), frozenset({seen.mode.name})
    return Orbiting(now_s, condition(_C.ORBITING), modes=modes, fence_centre=centre, pace=Pace(at_s=now_s))


def _accepted(code: ConditionCode) -> CommandAnswer:
    return CommandAnswer(True, condition(code))


def _refused(code: ConditionCode, **values: object) -> CommandAnswer:
    return CommandAnswer(False, condition(code, **values))


def by_hand(seen: Observed) -> str:
    """How the pilot enters the control mode, as the end of a sentence."""
    return f", or {seen.autopilot.hints.by_hand}" if seen.autopilot.hints.by_hand else ""


def way_out(state: SafetyState, seen: Observed, config: MavlinkBridgeConfig) -> str:
    """What the operator may do next, as a sentence; "" = nothing leads out, or the condition says it.

    A command that it names is accepted now.
    """
    if isinstance(state, TakenOver | Fault):
        return "`drocap orbit stop` acknowledges it, and nothing begins before"
    if not isinstance(state, Ready | Holding):
        return ""
    command = Command.START if seen.mode.in_control else Command.ENGAGE
    refused = _start_refusal(state, seen, _problems(state, seen, config)[2])
    if refused is None and command == Command.ENGAGE:
        refused = _request_refusal(seen, command, config)
    if refused is not None:
        return "" if refused.condition.code == state.condition.code else str(refused.condition)
    if command == Command.ENGAGE:
        return f"`drocap orbit engage` requests control and begins an orbit{by_hand(seen)}"
    silent = isinstance(state, Holding) and stream_ended(seen)
    return ("nothing is sent any more; " if silent else "") + "`drocap orbit start` begins an orbit"
