"""The pilot's mode is kept whatever happens to the downlink."""

import random
from functools import partial

import pytest

from drocap_ros.flight.orbit.states import Action, State
from lab.flights.branches import branch
from lab.flights.orbit_loop import LoopSettings, OrbitLoop

MODES = {"ardupilot": ("LOITER", "RTL", "LAND"), "px4": ("RTL", "LOITER", "POSCTL")}
FAULTS = ("lost", "late", "lossy", "shuffled")
MOMENTS, FLOWN = 2, 5  # orbits and ends of each autopilot; ``benchmarks/flight_kills.py pilot`` flies 200
WATCHED_S, RETURNED_S = 5.0, 2.5


def damage(loop, fault, chance):
    if fault == "lost":
        loop.down.cut = True
    elif fault == "late":
        loop.down.delay_s = chance.uniform(0.3, 1.0)
    elif fault == "lossy":
        loop.down.loss = chance.uniform(0.5, 0.95)
    else:
        loop.down.jitter_s, loop.down.duplicate = chance.uniform(0.1, 0.8), 0.1


def repair(loop):
    """New packets may arrive before old ones that were late."""
    loop.down.cut, loop.down.delay_s, loop.down.loss = False, 0.01, 0.0
    loop.down.jitter_s = loop.down.duplicate = 0.0


def chosen(loop, fault, moment):
    """The downlink fails, the pilot chooses a mode, the downlink returns: modes that replaced the pilot's."""
    chance = random.Random(f"{loop.settings.autopilot} {fault} {moment}")
    damage(loop, fault, chance)
    damaged_s = loop.t
    loop.run(loop.t + chance.uniform(0.2, 5.0))
    mode, chosen_s = chance.choice(MODES[loop.settings.autopilot]), loop.t
    loop.copter.set_mode(mode, "pilot")
    loop.run(loop.t + WATCHED_S)
    repair(loop)
    loop.run(loop.t + RETURNED_S)
    if fault == "lossy":  # a request could reach the vehicle a moment after the pilot's choice
        assert [entry for entry in loop.copter.mode_log if entry[0] > damaged_s and entry[2] == "command"] == []
    if loop.copter.mode != mode:
        return (
            fault,
            moment,
            mode,
            round(chosen_s, 2),
            [entry for entry in loop.copter.mode_log if entry[0] > chosen_s],
        )
    # PX4's LOITER is the bridge's own hold mode too: it may not tell them apart, but it sends nothing.
    assert loop.controller.safety.state in (State.TAKEN_OVER, State.HOLDING), loop.reasons
    assert all(row.action == Action.NOTHING for row in loop.rows if row.t_s > loop.t - RETURNED_S + 0.3)
    assert loop.controller.safety.state == State.TAKEN_OVER or mode == "LOITER"
    return None


@pytest.mark.parametrize("autopilot", MODES)
def test_mode_of_the_pilot_is_kept_when_the_downlink_fails(autopilot):
    taken, flown = [], 0
    for moment in range(MOMENTS):
        loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=moment, seconds=24, perception_hz=10.0))
        loop.start(2.0)
        loop.run(random.Random(f"{autopilot} {moment}").uniform(5.0, 9.0))
        if loop.controller.safety.state != State.ORBITING:
            continue
        flown += len(FAULTS)
        taken += [branch(partial(chosen, loop, fault, moment)) for fault in FAULTS]
    assert [case for case in taken if case] == []
    assert flown >= FLOWN
