"""Setpoints that are lost on the way, a bridge that stood still: nothing follows until the operator commands."""

from functools import lru_cache

import numpy as np
import pytest
from branched import branched
from pymavlink.dialects.v20.ardupilotmega import MAV_STATE_CRITICAL as CRITICAL

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.guardian import has_left
from drocap_ros.flight.orbit.states import Action, Command, State
from lab.flights.fault_injections import pilot
from lab.flights.orbit_loop import LoopSettings, OrbitLoop

BOTH = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
_SET_POSITION_TARGET = 84


def orbit(autopilot):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=3, seconds=30, perception_hz=10.0))
    loop.start(2.0)
    loop.run(7.0)
    assert loop.controller.safety.state == State.ORBITING
    return loop


begun = lru_cache(orbit)


@pytest.fixture
def loop(autopilot):
    """An orbit that has begun, flown once of each autopilot."""
    return begun(autopilot)


def drop_setpoints(loop):
    """Returns a function that ends it."""
    write = loop.up.write
    loop.up.write = lambda data: None if data[7] == _SET_POSITION_TARGET and data[8] == 0 else write(data)

    def end():
        loop.up.write = write

    return end


def speed_at(loop, t_s):
    return next(float((row.velocity**2).sum() ** 0.5) for row in loop.rows if row.t_s >= t_s)


@BOTH
@branched
def test_a_control_loop_that_hangs_leaves_the_pilots_mode_to_him(loop):
    """Neither its watchdog nor the guardian sends anything more, nor does the loop when it goes on."""
    sent, write = [], loop.up.write

    def count(data):
        sent.extend([loop.t] if data[7] == _SET_POSITION_TARGET and data[8] == 0 else [])
        write(data)

    loop.up.write, loop.hung = count, True
    loop.run(7.8)
    assert max(sent) > 7.6  # it is held
    pilot("LOITER")(loop)
    loop.run(10.0)
    loop.hung = False
    loop.run(12.0)
    assert max(sent) < 8.1  # until the report has come
    assert loop.copter.mode == "LOITER"
    assert loop.controller.safety.state != State.ORBITING


@BOTH
@branched
def test_the_guardian_of_a_dead_bridge_would_see_the_pilots_mode_in_what_the_vehicle_sends(loop):
    heard, controls, write = [], [], loop.down.write

    def listen(data):
        heard.append((loop.t, bytes(data)))
        write(data)

    loop.down.write, loop.link.guardian = listen, lambda packets, control, _: controls.append(control)
    loop.run(8.0)
    control, other = controls[-1], (*controls[-1][:2], 77)
    assert not any(has_left(data, control) for _, data in heard)
    assert any(has_left(data, other) for _, data in heard)
    pilot("LOITER")(loop)
    loop.run(9.0)
    assert min(t for t, data in heard if has_left(data, control)) < 8.4  # two of its packets


@BOTH
@branched
def test_setpoints_alone_are_dropped_on_the_way(loop):
    end = drop_setpoints(loop)
    loop.run(12.0)
    noticed = [(t, cause) for t, state, cause in loop.reasons if state == "HOLDING"]
    assert noticed[0][0] <= 7.75  # the time-out of 0.5 s, and what the echo and PX4's look at it take
    assert noticed[0][1].code == ConditionCode.SETPOINTS_NOT_FOLLOWED
    end()
    loop.run(15.0)
    assert State.ORBITING not in {row.state for row in loop.rows if row.t_s > 8.0}
    assert all(speed_at(loop, 13.0 + 0.1 * i) < 0.5 for i in range(15))  # ArduPilot's spring back has ended
    loop.command(Command.ENGAGE)
    loop.run(18.0)
    assert loop.controller.safety.state == State.ORBITING


@BOTH
@branched
def test_a_bridge_that_was_stopped_and_continues_sends_nothing_until_it_is_engaged(loop, autopilot):
    loop.stopped = True
    loop.run(10.0)
    loop.stopped = False
    loop.run(14.0)
    assert {row.action for row in loop.rows if row.t_s > 7.05} == {Action.NOTHING}
    assert loop.controller.safety.condition.code == ConditionCode.CONTROL_LOOP_STALLED
    assert loop.copter.mode == ("LOITER" if autopilot == "px4" else "GUIDED")
    loop.command(Command.ENGAGE)
    loop.run(17.0)
    assert loop.controller.safety.state == State.ORBITING


@BOTH
@branched
def test_a_step_that_was_interrupted_sends_no_old_setpoint_and_says_that_it_stood_still(loop, autopilot):
    sent = loop.link.sent_setpoints()
    echo = loop.link.echo

    def stopped():
        loop.t += 3.0  # between the beginning of the step and the end of its observation
        return echo()

    loop.link.echo = stopped
    loop.controller.step(loop.clock_ns(), loop.t)
    assert loop.link.sent_setpoints() == sent
    assert loop.copter.mode == ("OFFBOARD" if autopilot == "px4" else "GUIDED")
    assert loop.controller.safety.state == State.HOLDING
    assert loop.controller.safety.condition.code == ConditionCode.CONTROL_LOOP_STALLED


def cut(*channels):
    """Cuts channels of a loop; the function that it returns mends them."""

    def change(loop):
        for name in channels:
            getattr(loop, name).cut = True
        return lambda: [setattr(getattr(loop, name), "cut", False) for name in channels]

    return change


def kill(loop):
    """Returns a function that starts the bridge again."""
    loop.stopped = True

    def end():
        loop.stopped = False
        loop.restart()

    return end


@pytest.mark.parametrize("lose", [drop_setpoints, cut("up"), cut("up", "down"), kill])
@pytest.mark.parametrize("autopilot", ["px4"])
@branched
def test_engage_is_granted_within_a_second_of_each_loss_of_setpoints(loop, lose):
    end = lose(loop)
    loop.run(9.5)
    assert loop.copter.mode_log[-1][1:] == ("LOITER", "failsafe: setpoints lost")
    assert loop.copter.system_status == CRITICAL  # for as long as this failsafe acts
    end()
    loop.run(14.0)
    assert loop.copter.mode == "LOITER"
    loop.command(Command.ENGAGE)
    loop.run(15.0)
    assert [answer.condition.code for _, answer in loop.answers][-1:] == [ConditionCode.REQUESTING_CONTROL]
    assert (loop.controller.safety.state, loop.copter.mode) == (State.ORBITING, "OFFBOARD")
    assert loop.copter.system_status != CRITICAL


@pytest.mark.parametrize("autopilot", ["px4"])
@branched
def test_engage_ends_no_failsafe_but_that_for_lost_setpoints(loop):
    """PX4 takes a requested mode for a pilot who takes over, and leaves the hold for a lost remote control."""
    loop.copter.set_mode("LOITER", "failsafe: remote control lost")
    loop.copter.system_status = CRITICAL
    loop.run(9.5)
    loop.command(Command.ENGAGE)
    loop.run(18.0)
    assert loop.copter.mode_log[-1][1:] == ("LOITER", "failsafe: remote control lost")
    assert loop.controller.safety.state != State.ORBITING
    assert "another failsafe" in str(loop.controller.safety.condition)


@pytest.mark.parametrize("autopilot", ["px4"])
@branched
def test_a_critical_state_with_another_cause_forbids_to_engage(loop):
    loop.command(Command.STOP)
    loop.run(10.0)
    loop.copter.system_status = CRITICAL  # in the hold mode that the bridge has requested
    loop.run(12.0)
    loop.command(Command.ENGAGE)
    loop.run(13.0)
    answer = loop.answers[-1][1]
    assert (answer.accepted, answer.condition.code) == (False, ConditionCode.AUTOPILOT_CRITICAL)
    assert "ends the failsafe" in str(answer)


@pytest.mark.parametrize("autopilot", ["px4"])
@branched
def test_with_the_downlink_lost_px4_ends_in_its_own_hold_and_offboard_does_not_return(loop):
    loop.down.cut = True
    loop.run(13.0)
    loop.down.cut = False
    loop.run(16.0)
    (t, mode, by) = loop.copter.mode_log[-1]
    assert (mode, by) == ("LOITER", "failsafe: setpoints lost")
    assert t <= 7.0 + 0.25 + loop.settings.config.blind_hold_s + 0.7
    assert loop.copter.mode == "LOITER"
    assert {row.action for row in loop.rows if row.t_s > t} == {Action.NOTHING}
    assert loop.controller.safety.state == State.HOLDING
    assert loop.controller.safety.condition.code == ConditionCode.SETPOINTS_NOT_FOLLOWED


@BOTH
@branched
def test_the_pilots_mode_is_noticed_within_a_fifth_of_a_second(loop, autopilot):
    late = []
    for i in range(3):
        loop.run(loop.t + 0.047 * i)
        assert loop.controller.safety.state == State.ORBITING
        chosen = loop.t
        loop.copter.set_mode("POSCTL" if autopilot == "px4" else "LOITER", "pilot")
        loop.run(loop.t + 0.4)
        late.append(next((t for t, state, _ in loop.reasons if t > chosen and state == "TAKEN_OVER"), 9e9) - chosen)
        loop.command(Command.STOP)
        loop.run(loop.t + 0.1)
        loop.command(Command.ENGAGE)
        loop.run(loop.t + 2.5)
    assert max(late) <= (0.2 if autopilot == "px4" else 0.3), late


@pytest.mark.parametrize("autopilot", ["ardupilot"])
@branched
def test_wind_that_is_stronger_than_the_vehicle_ends_the_orbit(loop):
    loop.copter.body.wind = np.array([0.0, 12.0, 0.0])
    loop.run(20.0)
    assert loop.controller.safety.state == State.HOLDING
    assert loop.controller.safety.condition.code == ConditionCode.ORBIT_NOT_KEPT
    assert "wind" in loop.controller.safety.reason
    flown = [row for row in loop.rows if row.action == Action.ORBIT]
    assert max(row.distance_m for row in flown) < 14.0
    degraded = [reason.values["cause"].code for _, _, reason in loop.reasons if reason.code == ConditionCode.DEGRADED]
    assert ConditionCode.ORBIT_NOT_KEPT in degraded


@BOTH
@branched
def test_the_autopilots_refusal_stays_on_the_status_until_the_next_command(loop):
    loop.command(Command.STOP)
    loop.run(12.0)
    loop.copter.denied_modes = frozenset({loop.copter.kind.control_mode})
    loop.command(Command.ENGAGE)
    loop.run(24.0)
    assert loop.status.state == State.READY
    mode = loop.copter.kind.control_mode
    words = f"the autopilot did not grant control (mode {mode}: rejected for now); `drocap orbit engage` requests"
    assert loop.status.reason.startswith(words)
    loop.command(Command.STOP)
    loop.run(25.0)
    assert loop.status.reason.startswith("all conditions for motion hold; `drocap orbit engage` requests")
