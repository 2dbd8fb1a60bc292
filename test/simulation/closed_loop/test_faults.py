"""A part of the table of faults: the whole of it is ``benchmarks/flight_faults.py``."""

import pytest

from drocap_ros.flight.orbit.safety import State
from drocap_ros.simulation.closed_loop.faults import FAULTS, failures, fly_fault, keeps

SUBSET = {
    ("perception stops", "ardupilot"),
    ("picture freezes, stamps go on", "px4"),
    ("process killed (SIGKILL)", "px4"),
    ("process restarts after 1 s", "ardupilot"),
    ("control loop hangs for 1 s", "ardupilot"),
    ("uplink delayed by 1 s", "ardupilot"),
    ("pilot takes over and gives back", "ardupilot"),
    ("pilot takes position while engaging", "px4"),
    ("the autopilot's position jumps by 15 m", "px4"),
    ("telemetry frozen with its clock", "ardupilot"),
    ("autopilot follows no more, says nothing", "px4"),
    ("a foreign system on the link", "px4"),
}


@pytest.mark.parametrize(("name", "autopilot"), sorted(SUBSET))
def test_what_a_case_states_holds(name, autopilot):
    fault = next(f for f in FAULTS if f.name == name)
    result = fly_fault(fault, autopilot)
    assert failures(fault, autopilot, result) == [], result
    if not fault.harmless and fault.cause is None:
        assert keeps(result)
    if fault.harmless:
        assert result.state == State.ORBITING


def test_there_are_sixty_cases_for_the_table():
    assert 2 * len(FAULTS) >= 60
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def test_a_case_that_does_not_hold_is_said_in_words():
    fault = next(f for f in FAULTS if f.name == "process killed (SIGKILL)")
    result = fly_fault(fault, "ardupilot")
    worse = result._replace(motion_s=0.6, excursion_m=9.0, resumed=True, evident=False, least_distance_m=2.0)
    told = " ".join(failures(fault, "ardupilot", worse))
    for words in ("motion for 0.60 s", "excursion of 9.00 m", "without the operator", "not at work", "2.00 m"):
        assert words in told
    silent = next(f for f in FAULTS if f.name == "perception stops")
    assert "does not say" in failures(silent, "px4", result)[0]
