"""What is sent while the vehicle, or the mode that the pilot may have changed, cannot be seen."""

import numpy as np
import pytest
from orbit_observations import GOOD, LIMITS, LOITER, changed, orbiting

from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, Command, Idle, ModeRequest, State


def lost(link_age_s, **values):
    return changed(GOOD, link_age_s=link_age_s, state_age_s=link_age_s, **values)


def test_no_mode_is_requested_while_the_mode_cannot_be_seen_and_the_hold_ends_after_its_time():
    # The hold begins on telemetry that is 0.5 s old, and the vehicle is at rest: a position is known.
    state, decision = reduce(orbiting(), lost(0.5, heartbeat_age_s=0.6), 1.0, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.NONE, None)
    for i in range(1, 400):
        after_s = 0.05 * i
        unseen = lost(0.5 + after_s, heartbeat_age_s=0.6 + after_s)
        state, decision = reduce(state, unseen, 1.0 + after_s, None, LIMITS)
        assert decision.mode_request == ModeRequest.NONE
        assert decision.action == (Action.HOLD if after_s <= 3.5 else Action.NOTHING) or abs(after_s - 3.5) < 0.06


@pytest.mark.parametrize("silent_s", [2.0, 6.0])
def test_the_mode_after_a_loss_is_known_by_a_heartbeat_since_the_loss(silent_s):
    state, _ = reduce(orbiting(), lost(0.5, heartbeat_age_s=0.6), 1.0, None, LIMITS)
    state, before = reduce(state, lost(silent_s, heartbeat_age_s=silent_s), 1.0 + silent_s, None, LIMITS)
    # Attitude is heard first; the mode is still that of before the loss.
    early = changed(GOOD, heartbeat_age_s=silent_s + 0.1, position=GOOD.vehicle.position + 1.0)
    state, decision = reduce(state, early, 1.1 + silent_s, None, LIMITS)
    assert decision[:2] == (before.action, ModeRequest.NONE)
    pilot, decision = reduce(state, changed(LOITER, mode="RTL"), 1.2 + silent_s, None, LIMITS)
    assert (pilot.state, decision.action) == (State.TAKEN_OVER, Action.NOTHING)
    # Our own mode: the hold goes on where the vehicle is now, because its position may have been reset unseen, and the
    # hold mode waits for steadiness.
    for i in range(80):
        t = 1.2 + silent_s + 0.05 * i
        state, decision = reduce(state, early if i == 0 else changed(early, heartbeat_age_s=0.05), t, None, LIMITS)
        assert decision.mode_request == ModeRequest.NONE or i * 0.05 >= 1.3
    assert decision == (Action.HOLD, ModeRequest.HOLD, None)
    assert np.array_equal(state.position, early.vehicle.position)


def test_a_mode_of_somebody_else_is_a_take_over_however_late_it_is_heard():
    late = lost(0.9, mode="RTL", in_control=False)
    assert reduce(orbiting(), late, 1.0, None, LIMITS)[0].state == State.TAKEN_OVER


def test_a_mode_is_requested_only_right_after_a_heartbeat_and_with_a_short_round_trip():
    state, _ = reduce(orbiting(), GOOD, 10.0, Command.STOP, LIMITS)
    state, decision = reduce(state, GOOD, 11.0, None, LIMITS)
    assert decision.mode_request == ModeRequest.HOLD
    old = changed(GOOD, heartbeat_age_s=0.15)
    assert reduce(state, old, 11.1, None, LIMITS)[1] == (Action.HOLD, ModeRequest.NONE, None)
    slow = changed(GOOD, round_trip_s=0.6)
    assert reduce(state, slow, 11.1, None, LIMITS)[1] == (Action.HOLD, ModeRequest.NONE, None)
    engaging, _ = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    unseen = changed(LOITER, heartbeat_age_s=0.15)
    assert reduce(engaging, unseen, 0.2, None, LIMITS)[1].mode_request == ModeRequest.NONE


def test_no_mode_is_requested_while_many_packets_are_lost_and_the_hold_waits_for_a_better_link():
    lossy = changed(GOOD, packet_loss=0.5)
    state, _ = reduce(orbiting(), lossy, 10.0, Command.STOP, LIMITS)
    for i in range(1, 200):
        state, decision = reduce(state, lossy, 10.0 + 0.05 * i, None, LIMITS)
        assert (state.state, decision[:2]) == (State.HOLDING, (Action.HOLD, ModeRequest.NONE))
    assert reduce(state, GOOD, 20.0, None, LIMITS)[1].mode_request == ModeRequest.HOLD
    engaging, _ = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    unseen = changed(LOITER, packet_loss=0.5)
    assert reduce(engaging, unseen, 0.2, None, LIMITS)[1].mode_request == ModeRequest.NONE


def test_a_link_that_becomes_lossy_after_the_request_ends_the_requests():
    state, _ = reduce(orbiting(), GOOD, 10.0, Command.STOP, LIMITS)
    state, decision = reduce(state, GOOD, 11.0, None, LIMITS)
    assert decision.mode_request == ModeRequest.HOLD
    lossy = changed(GOOD, packet_loss=0.3)
    assert reduce(state, lossy, 11.1, None, LIMITS)[1] == (Action.HOLD, ModeRequest.NONE, None)
