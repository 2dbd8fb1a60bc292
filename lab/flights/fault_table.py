"""Table of the faults in flight, by the part that fails; ``benchmarks/flight_faults.py`` flies all of them."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.conditions import PICTURE_CODES, ConditionCode
from drocap_ros.flight.orbit.states import Command, State
from lab.flights.fault_causes import (
    DELAY_S,
    DELAYED,
    ECHO_S,
    FRAME_S,
    HEARTBEAT_PX4_S,
    HEARTBEAT_S,
    JUMPED,
    LINK_S,
    LOSSY,
    MODE,
    PILOT,
    TAKEN_S,
    TIMEOUT,
)
from lab.flights.fault_flight import FAULT_S, Fault, Injection, start
from lab.flights.fault_injections import (
    answer_time_sync,
    assign,
    begins,
    both,
    busy_machine,
    command,
    drop_setpoints,
    foreign_system,
    freeze,
    gust,
    in_wind,
    inside_fence,
    invalid_commands,
    jump,
    kept,
    late_stamps,
    longer,
    lose_half,
    move_stick,
    near_fence,
    no_orbit,
    old_commands,
    orbits_again,
    perceived,
    pilot,
    ready_late,
    reset_position,
    restart,
    restart_clock,
    same_radius,
    scaled,
    second_vehicle,
    shadow,
    shifted,
    shipped_timeouts,
    short_timeouts,
    stick_mode,
    storm,
    swinging,
    walk_east,
    walk_to_vehicle,
    wrong_ground,
)
from lab.flights.report_injections import (
    CRITICAL,
    ECHO,
    EMERGENCY,
    TIME_SYNC,
    at_least,
    never_sends,
    reports_state,
    small_steps,
    unknown_mount,
    zoomed,
)

_C = ConditionCode
_LOCATED = tuple(PICTURE_CODES)
_TELEMETRY = (
    _C.POSITION_FROZEN, _C.ATTITUDE_OUTDATED, _C.LINK_SILENT, _C.ROUND_TRIP_TOO_LONG, _C.SETPOINTS_NOT_FOLLOWED,
)  # fmt: skip
_TAKEN = (_C.PILOT_TOOK_OVER,)
_STALLED = _C.CONTROL_LOOP_STALLED
_RESTARTED = (_C.ALL_CLEAR, _C.TIMEOUT_UNKNOWN)
_LANDING = mavlink.MAV_LANDED_STATE_LANDING


_ASIDE = perceived(lambda seen: {"keypoints": shifted(seen, 370)})
_LOSE_SUBJECT = assign(perceive=lambda seen: None)
_DENY_HOLD = assign("copter", denied_modes=frozenset({"BRAKE", "LOITER"}))
_DENY_CONTROL = assign("copter", denied_modes=frozenset({"GUIDED", "OFFBOARD"}))
_TO_CONTROL, _TO_POSITION = pilot("GUIDED", "OFFBOARD"), pilot("LOITER", "POSCTL")
_STOPPED, _CONTINUES = assign(stopped=True), (3.0, assign(stopped=False))
_STOP, _ENGAGE = command(Command.STOP), command(Command.ENGAGE)


def _perception(name: str, inject: Injection, code: ConditionCode = _C.SUBJECT_OUTDATED) -> Fault:
    return Fault(name, inject, FRAME_S, codes=(code,))


def _computer(name: str, **values: Any) -> Fault:
    """It dies: only the autopilot's time-out can end the motion."""
    return Fault(name, assign(stopped=True, dead=True), LINK_S, cause=TIMEOUT, **values)


def _link(name: str, owner: str, fault: dict[str, Any], **values: Any) -> Fault:
    return Fault(name, assign(owner, **fault), LINK_S, **{"codes": _TELEMETRY, **values})


def _taking_over(name: str, inject: Injection, **values: Any) -> Fault:
    return Fault(name, inject, HEARTBEAT_S, cause=MODE, codes=_TAKEN, **values)


def _in_state(name: str, inject: Injection, state: State, *before: tuple[float, Injection], **values: Any) -> Fault:
    """A mode change by the pilot in another state: the bridge must not move the vehicle afterwards."""
    values = {"codes": _TAKEN, **values}
    return Fault(name, inject, HEARTBEAT_S, before=before, state=state, check=no_orbit, **values)


_PERCEPTION = (
    _perception("perception stops", _LOSE_SUBJECT, _C.PICTURES_LOST),
    _perception("perception finds no subject", perceived(lambda seen: {"track_id": 0})),
    _perception(
        "keypoints jump by 400 px", perceived(lambda seen: {"keypoints": shifted(seen, 400)}), _C.OTHER_SUBJECT
    ),
    _perception("keypoints are NaN", perceived(lambda seen: {"keypoints": seen.keypoints * np.float32(np.nan)})),
    _perception("image frozen, stamps continue", freeze, _C.PICTURES_FROZEN),
    _perception(
        "another person, by its track",
        perceived(lambda seen: {"keypoints": shifted(seen, 150), "track_id": 2}),
        _C.OTHER_SUBJECT,
    ),
    _perception(
        "another person 2 m aside, same track",
        perceived(lambda seen: {"keypoints": shifted(seen, 370)}),
        _C.OTHER_SUBJECT,
    ),
    _perception("perception 1 s late", perceived(lambda seen: {"stamp_ns": seen.stamp_ns - 10**9}), _C.PICTURES_LATE),
    _perception("stamps 5 s in the future", perceived(lambda seen: {"stamp_ns": seen.stamp_ns + 5 * 10**9})),
    Fault("every other image lost", lose_half, harmless=True),
)
_PROCESS = (
    Fault("process killed (SIGKILL)", _STOPPED, LINK_S),
    Fault("process killed, time-outs as shipped", _STOPPED, LINK_S, change=shipped_timeouts),
    Fault("process stopped for 3 s (SIGSTOP)", _STOPPED, LINK_S, later=_CONTINUES, codes=(_STALLED, *_TAKEN)),
    Fault("process restarts after 1 s", _STOPPED, LINK_S, later=(1.0, restart), check=no_orbit, codes=_RESTARTED),
    Fault("process restarts at once", restart, LINK_S, check=no_orbit),
    _computer("computer dies"),
    _computer("computer dies, time-outs of 0.3 s", change=short_timeouts),
    _computer("computer dies, time-outs as shipped", change=shipped_timeouts),
    Fault("control loop hangs", assign(hung=True)),
    Fault("control loop hangs for 1 s", assign(hung=True), later=(1.0, assign(hung=False)), codes=(_STALLED,)),
    Fault("clock jumps 3 s ahead", assign(clock_jump_s=3.0), LINK_S, codes=(_C.CLOCK_JUMPED,)),
    Fault("clock jumps 3 s back", assign(clock_jump_s=-3.0), LINK_S, codes=(_C.CLOCK_JUMPED,)),
    *(
        Fault(
            f"clock steps {abs(step):g} s {'ahead' if step > 0 else 'back'}, then the operator starts again",
            assign(clock_jump_s=step), harmless=True, change=longer, watch_s=4.0, check=orbits_again,
        ) for step in (0.3, -0.3, 0.8, -0.8)
    ),
)  # fmt: skip
_LINK = (
    _link("link lost", "link", {"cut": True}, cause=TIMEOUT),
    _link("link lost for 2 s", "link", {"cut": True}, cause=TIMEOUT, later=(2.0, assign("link", cut=False)), codes=()),
    _link("downlink lost", "down", {"cut": True}),
    _link("uplink lost", "up", {"cut": True}, cause=TIMEOUT, codes=(*_TELEMETRY, *_TAKEN)),
    _link("link delayed by 1 s", "link", {"delay_s": DELAY_S}, cause=DELAYED, codes=(*_TELEMETRY, *_TAKEN)),
    _link("downlink delayed by 1 s", "down", {"delay_s": DELAY_S}),
    _link("uplink delayed by 1 s", "up", {"delay_s": DELAY_S}, cause=DELAYED, codes=(*_TELEMETRY, *_TAKEN)),
    Fault("30 % loss", assign("link", loss=0.3), harmless=True),
    _link("80 % loss", "link", {"loss": 0.8}, cause=LOSSY, codes=(*_TELEMETRY, *_LOCATED, *_TAKEN)),
    Fault(
        "another vehicle on the link, and none is chosen", _ENGAGE, harmless=True, state=State.IDLE,
        before=((2.0, foreign_system),), codes=(_C.SEVERAL_VEHICLES,), check=no_orbit,
    ),
    Fault("every packet twice", assign("link", duplicate=1.0), harmless=True),
    Fault("packets out of order", assign("link", jitter_s=0.08), harmless=True),
    Fault("a foreign system on the link", foreign_system, harmless=True),
    _link("telemetry frozen, clock continues", "copter", {"frozen": True}),
    _link("telemetry frozen with its clock", "copter", {"frozen": True, "frozen_clock": True}),
)  # fmt: skip
_VEHICLE = (
    Fault("GPS lost", begins("gps_lost_s"), 0.4 + HEARTBEAT_S, codes=(_C.NO_SATELLITE_FIX,)),
    Fault("estimator fails", begins("ekf_failed_s"), HEARTBEAT_S, codes=(_C.ESTIMATOR_UNHEALTHY, *_TAKEN)),
    Fault("battery at 10 %", assign("copter", battery=10), HEARTBEAT_S, codes=(_C.BATTERY_LOW,)),
    Fault("battery unknown", assign("copter", battery=-1), HEARTBEAT_S, codes=(_C.BATTERY_UNKNOWN,)),
    Fault("landing reported", assign("copter", landed_state=_LANDING), HEARTBEAT_S, codes=(_C.NOT_FLYING,)),
    _taking_over("the autopilot's own fence is breached", assign("copter", fence_m=0.5)),
    Fault("the autopilot's clock restarts", restart_clock, harmless=True),
    Fault("the autopilot's position jumps by 15 m", jump, LINK_S, cause=JUMPED, codes=(_C.POSITION_JUMPED,)),
    Fault(
        "the autopilot's position jumps by 5 m and back", reset_position(-5.0), LINK_S, cause=JUMPED,
        codes=(_C.POSITION_JUMPED,), later=(0.5, reset_position(5.0)),
    ),
    Fault(
        "the autopilot's position jumps during a hold", reset_position(5.0), LINK_S, cause=JUMPED,
        before=((4.0, start), (FAULT_S - 0.4, _STOP)), state=State.HOLDING,
    ),
    Fault(
        "the autopilot's clock goes back and its position jumps during a hold", _STOP, LINK_S,
        later=(0.3, both(restart_clock, reset_position(5.0))),
    ),
    Fault(
        "another vehicle with the same ids is heard", second_vehicle, LINK_S, cause=TIMEOUT,
        codes=(_C.POSITION_JUMPED, *_TAKEN),
    ),
    Fault(
        "another vehicle with the same ids is heard during a hold", second_vehicle, LINK_S, cause=JUMPED,
        before=((4.0, start), (FAULT_S - 0.4, _STOP)), state=State.HOLDING,
    ),
    Fault(
        "the autopilot's position jumps while the control loop hangs", assign(hung=True), cause=JUMPED,
        codes=(_STALLED, _C.POSITION_JUMPED), later=(0.6, both(reset_position(5.0), assign(hung=False))),
    ),
    _link(
        "the autopilot's position jumps while the downlink is lost", "down", {"cut": True},
        later=(1.0, both(reset_position(5.0), assign("down", cut=False))),
    ),
    Fault("setpoints ignored", assign("copter", deaf=True), ECHO_S, codes=(_C.SETPOINTS_NOT_FOLLOWED, *_TAKEN)),
    Fault(
        "hold mode denied", _LOSE_SUBJECT, FRAME_S, before=((0.0, _DENY_HOLD), (4.0, start)),
        codes=(_C.HOLD_MODE_MISSING,), watch_s=12.0,  # the orbit slows down for a second, holds, and asks for 5 s
    ),
)  # fmt: skip
_PILOT = (
    _taking_over("pilot takes LOITER (POSCTL)", _TO_POSITION),
    _taking_over("pilot takes ALT_HOLD (ALTCTL)", pilot("ALT_HOLD", "ALTCTL")),
    _taking_over("pilot takes LAND", pilot("LAND")),
    _taking_over("pilot takes RTL", pilot("RTL")),
    _taking_over("pilot takes over and gives back", _TO_POSITION, later=(2.0, _TO_CONTROL)),
    Fault(
        "pilot takes over during a hold", _LOSE_SUBJECT, FRAME_S, cause=PILOT, codes=_TAKEN,
        later=(TAKEN_S, _TO_POSITION),
    ),
    _in_state("pilot takes control while idle", _TO_CONTROL, State.IDLE, (0.0, _LOSE_SUBJECT), codes=(_C.NO_SUBJECT,)),
    _in_state("pilot takes position while ready", _TO_POSITION, State.READY, codes=()),
    _in_state(
        "pilot takes position while engaging", _TO_POSITION, State.READY, (0.0, _DENY_CONTROL),
        (FAULT_S - 1.6, _ENGAGE), change=stick_mode,
    ),
    _in_state(
        "pilot takes position while holding", _TO_POSITION, State.HOLDING, (4.0, start), (FAULT_S - 1.5, _STOP)
    ),
    _in_state(
        "pilot takes position while in fault", _TO_POSITION, State.FAULT, (0.0, _DENY_HOLD), (3.0, start), (5.5, _STOP)
    ),
    _in_state(
        "pilot takes control while taken over", _TO_CONTROL, State.TAKEN_OVER, (4.0, start),
        (FAULT_S - 3.0, _TO_POSITION),
    ),
)  # fmt: skip
_OPERATOR = (
    Fault("storm of 500 commands", storm, codes=(_C.STOPPED,)),
    Fault("commands of the past", old_commands, harmless=True, check=same_radius),
    Fault("invalid commands", invalid_commands, harmless=True, check=same_radius),
)
_SUBJECT = (
    Fault("subject walks towards the vehicle", walk_to_vehicle, harmless=True),
    *(
        Fault(
            name, partial(walk_east, way_m=way_m), harmless=True, codes=(_C.AT_FENCE,), check=inside_fence,
            watch_s=14.0, change=near_fence(bearing_deg),
        ) for name, bearing_deg, way_m in (
            ("subject leaves the fence", 0.0, 40.0), ("subject drives it out", 180.0, 5.0)
        )
    ),
)  # fmt: skip

_CUT, _RETURN = assign("down", cut=True), assign("down", cut=False, delay_s=0.01)
_NOT_FOLLOWED = (_C.SETPOINTS_NOT_FOLLOWED, *_TAKEN)
#: What flights under the real autopilots showed.
_REAL = (
    Fault("the person appears 40 % larger", scaled(1.4), harmless=True),
    Fault("the person appears 40 % smaller", scaled(1 / 1.4), harmless=True),
    Fault("the person's size swings by 20 %", swinging, harmless=True),
    Fault("a shadow is taken for the person", shadow, harmless=True),
    Fault("another person for 2 s, same track", _ASIDE, harmless=True, later=(2.0, assign(perceive=lambda seen: seen))),
    Fault("the ground is 2 m lower than configured", lambda loop: None, harmless=True, change=wrong_ground(2.0)),
    Fault("the ground is 2 m higher than configured", lambda loop: None, harmless=True, change=wrong_ground(-2.0)),
    Fault("pictures are stamped 100 ms late", lambda loop: None, harmless=True, change=late_stamps),
    Fault("telemetry of a busy machine pauses", lambda loop: None, harmless=True, change=busy_machine),
    Fault("a wind of 12 m/s begins", gust, harmless=True),
    Fault("setpoints alone are lost", drop_setpoints, LINK_S, cause=TIMEOUT, codes=_NOT_FOLLOWED),
    Fault(
        "setpoints alone are lost for 2 s", drop_setpoints, LINK_S, cause=TIMEOUT,
        later=(2.0, assign("up", drops=lambda packet: False)),
    ),
    _computer("computer dies in a wind of 8 m/s", change=in_wind),
    Fault(
        "process stopped for 3 s, pilot takes RTL meanwhile", both(_STOPPED, pilot("RTL")), LINK_S,
        cause=MODE, later=_CONTINUES, check=kept("RTL"),
    ),
    Fault("downlink lost, then the pilot takes RTL", _CUT, LINK_S, later=(1.0, pilot("RTL")), check=kept("RTL")),
    Fault("downlink lost, then the pilot takes LAND", _CUT, LINK_S, later=(1.0, pilot("LAND")), check=kept("LAND")),
    Fault(
        "downlink late, and the pilot takes RTL", both(assign("down", delay_s=1.0), pilot("RTL")), LINK_S, cause=MODE,
        later=(4.0, _RETURN), check=kept("RTL"),
    ),
    Fault(
        "a companion answers TIMESYNC, the downlink is late, then the pilot takes RTL", assign("down", delay_s=1.0),
        LINK_S, later=(3.4, pilot("RTL")), check=kept("RTL"), before=((0.0, answer_time_sync), (4.0, start)),
    ),
    Fault("pilot moves a stick that does not count", move_stick(1), harmless=True),
    _in_state(
        "the vehicle is ready later than the start", lambda loop: None, State.READY, (4.0, start), change=ready_late,
        codes=(),
    ),
)  # fmt: skip

#: Reports that are wrong, missing or alarming.
_REPORTS = (
    Fault(
        "setpoints alone are lost for 4 s, and no echo ever came", drop_setpoints, LINK_S, cause=TIMEOUT,
        codes=_NOT_FOLLOWED, before=((0.0, never_sends(ECHO)), (4.0, start)),
        later=(4.0, assign("up", drops=lambda packet: False)),
    ),
    Fault(
        "the autopilot's position steps by 0.9 m again and again", small_steps(0.9), harmless=True,
        codes=(_C.POSITION_JUMPED,), check=at_least(4.5),
    ),
    Fault(
        "the autopilot reports an emergency", reports_state(EMERGENCY), HEARTBEAT_PX4_S,
        codes=(_C.AUTOPILOT_EMERGENCY,),
    ),
    Fault("the autopilot reports a critical state", reports_state(CRITICAL), harmless=True),
    Fault(
        "the autopilot reports a critical state while idle", _ENGAGE, harmless=True, state=State.IDLE,
        before=((2.0, reports_state(CRITICAL)),), codes=(_C.AUTOPILOT_CRITICAL,), check=no_orbit,
    ),
    Fault(
        "TIMESYNC is never answered", lambda loop: None, harmless=True,
        before=((0.0, never_sends(TIME_SYNC)), (4.0, start)),
    ),
    Fault("camera_info changes as by a zoom", zoomed(42.0), LINK_S, codes=(_C.CAMERA_CHANGED,)),
    Fault("the mount reports no angles", unknown_mount, 0.5 + FRAME_S, codes=(_C.MOUNT_OUTDATED, *_LOCATED)),
)  # fmt: skip

FAULTS: tuple[Fault, ...] = (
    *_PERCEPTION, *_PROCESS, *_LINK, *_VEHICLE, *_PILOT, *_OPERATOR, *_SUBJECT, *_REAL, *_REPORTS,
)  # fmt: skip
