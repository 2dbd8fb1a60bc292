"""What the autopilot reports of itself: an emergency, a critical state, a position that jumps or creeps by steps."""

import math

import numpy as np
import pytest
from orbit_observations import GOOD, LIMITS, changed, orbiting

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.telemetry_request import LinkStatus
from drocap_ros.flight.orbit.observer import PositionJumps
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, Command, SafetyState, State
from drocap_ros.flight.vehicle_state import VehicleState

CRITICAL = 5
S = 1_000_000_000


def test_every_state_of_emergency_holds_and_forbids_a_start():
    for status in (6, 7, 8):
        seen = changed(GOOD, system_status=status)
        state, decision = reduce(orbiting(), seen, 1.0, None, LIMITS)
        assert (state.state, state.condition.code) == (State.HOLDING, ConditionCode.AUTOPILOT_EMERGENCY)
        assert decision.action == Action.HOLD
        _, decision = reduce(SafetyState(), seen, 1.0, Command.START, LIMITS)
        assert (decision.answer.accepted, decision.answer.condition.code) == (False, state.condition.code)


def test_a_critical_state_forbids_a_start_and_ends_no_orbit():
    seen = changed(GOOD, system_status=CRITICAL)
    state, decision = reduce(orbiting(), seen, 1.0, None, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    for command in (Command.START, Command.ENGAGE):
        state, decision = reduce(SafetyState(), seen, 1.0, command, LIMITS)
        assert (state.state, decision.answer.accepted) == (State.IDLE, False)
        assert decision.answer.condition.code == ConditionCode.AUTOPILOT_CRITICAL
    assert reduce(SafetyState(), changed(seen, system_status=4), 1.0, None, LIMITS)[0].state == State.READY


def test_several_vehicles_forbid_a_start_and_end_no_orbit():
    seen = changed(GOOD, vehicles=frozenset({1, 42}))
    assert reduce(orbiting(), seen, 1.0, None, LIMITS)[0].state == State.ORBITING
    answer = reduce(SafetyState(), seen, 1.0, Command.START, LIMITS)[1].answer
    assert (answer.accepted, answer.condition.code) == (False, ConditionCode.SEVERAL_VEHICLES)
    assert "systems 1, 42" in str(answer)


def test_diagnostics_warn_of_what_a_link_lacks():
    good = LinkStatus(True, 0.0, 0.02, {}, {}, 0)
    assert good.warning() == ""
    assert "time synchronization" in good._replace(round_trip_s=math.nan).warning()
    assert "refuses to send ATTITUDE" in good._replace(refused={"ATTITUDE": 2}, round_trip_s=math.nan).warning()
    assert "critical" in good._replace(critical=True).warning()


def jumps_of(steps, velocity=(1.0, 0.0, 0.0), period_s=0.05):
    """(time, m) of the jumps in ten seconds of flight; ``steps``: time -> (3,) m added to the position from then on."""
    jumps, found = PositionJumps(), []
    for i in range(200):
        t = i * period_s
        place = np.array(velocity) * t + sum((np.array(step) for at, step in steps.items() if t >= at), np.zeros(3))
        jumps.take(VehicleState(stamp_ns=round(t * S), position_enu_m=place, velocity_enu_m_s=np.array(velocity)))
        if (jump_m := jumps.pop()) > 0:
            found.append((round(t, 2), round(jump_m, 1)))
    return found


def test_one_small_step_is_no_jump_and_several_add_up():
    assert jumps_of({2.0: (0.9, 0, 0)}) == []
    assert jumps_of({2.0: (0.0, 1.1, 0)}) == [(2.0, 1.1)]
    assert jumps_of({2.0: (0.9, 0, 0), 3.0: (0.9, 0, 0)}) == [(3.0, pytest.approx(1.6, abs=0.1))]
    assert jumps_of({2.0: (0.9, 0, 0), 3.0: (-0.9, 0, 0)}) == []  # there and back
    assert jumps_of({1.0: (0.5, 0, 0), 9.0: (0.9, 0, 0)}) == []  # the first has faded


def test_no_recorded_flight_has_a_position_that_jumps(shared):
    judged = 0
    for path in sorted((shared / "flight").glob("*.npz")):
        flight, jumps = np.load(path), PositionJumps()
        for t, place, velocity in zip(flight["time_s"], flight["position_m"], flight["velocity_m_s"], strict=True):
            jumps.take(VehicleState(stamp_ns=round(t * S), position_enu_m=place, velocity_enu_m_s=velocity))
            judged += 1
        assert jumps.pop() == 0.0, path.name
    assert judged > 3000
