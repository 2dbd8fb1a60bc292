"""The pilot's mode is kept whatever happens to the downlink."""

import random

import pytest

from drocap_ros.flight.orbit.states import Action, State
from drocap_ros.simulation.closed_loop.orbit_loop import LoopSettings, OrbitLoop

MODES = {"ardupilot": ("LOITER", "RTL", "LAND"), "px4": ("RTL", "LOITER", "POSCTL")}
FAULTS = ("lost", "late", "lossy", "shuffled")
MOMENTS, FLOWN = 18, 17  # of each fault and autopilot: at least 51 orbits for each autopilot
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


@pytest.mark.parametrize("autopilot", MODES)
@pytest.mark.parametrize("fault", FAULTS)
def test_mode_of_the_pilot_is_kept_when_the_downlink_fails(autopilot, fault):
    taken, flown = [], 0
    for moment in range(MOMENTS):
        chance = random.Random(f"{autopilot} {fault} {moment}")
        loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=moment, seconds=24, perception_hz=10.0))
        loop.start(2.0)
        loop.run(chance.uniform(5.0, 9.0))
        if loop.controller.safety.state != State.ORBITING:
            continue
        flown += 1
        damage(loop, fault, chance)
        loop.run(loop.t + chance.uniform(0.2, 5.0))
        mode, chosen_s = chance.choice(MODES[autopilot]), loop.t
        loop.copter.set_mode(mode, "pilot")
        loop.run(loop.t + WATCHED_S)
        repair(loop)
        loop.run(loop.t + RETURNED_S)
        if loop.copter.mode != mode:
            later = [entry for entry in loop.copter.mode_log if entry[0] > chosen_s]
            taken.append((moment, mode, round(chosen_s, 2), later))
            continue
        # PX4's LOITER is the bridge's own hold mode too: it may not tell them apart, but it sends nothing.
        assert loop.controller.safety.state in (State.TAKEN_OVER, State.HOLDING), loop.reasons
        assert all(row.action == Action.NOTHING for row in loop.rows if row.t_s > loop.t - RETURNED_S + 0.3)
        assert loop.controller.safety.state == State.TAKEN_OVER or mode == "LOITER"
    assert taken == []
    assert flown >= FLOWN
