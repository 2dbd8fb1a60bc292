"""Part of the table of faults; ``benchmarks/flight_faults.py`` flies all of it."""

import pytest

from drocap_ros.flight.orbit.states import State
from lab.flights.fault_flight import failures, fly_fault, within_protocol
from lab.flights.fault_table import FAULTS

SUBSET = {
    ("perception stops", "ardupilot"),
    ("image frozen, stamps continue", "px4"),
    ("stamps 5 s in the future", "ardupilot"),
    ("process killed (SIGKILL)", "px4"),
    ("process restarts after 1 s", "ardupilot"),
    ("computer dies", "px4"),
    ("control loop hangs for 1 s", "ardupilot"),
    ("clock steps 0.8 s ahead, then the operator starts again", "px4"),
    ("uplink delayed by 1 s", "ardupilot"),
    ("pilot takes over and gives back", "ardupilot"),
    ("pilot takes position while engaging", "px4"),
    ("the autopilot's position jumps by 15 m", "px4"),
    ("the autopilot's position jumps by 15 m", "ardupilot"),
    ("hold mode denied", "ardupilot"),
    ("telemetry frozen with its clock", "ardupilot"),
    ("setpoints ignored", "px4"),
    ("a foreign system on the link", "px4"),
    ("the person appears 40 % larger", "ardupilot"),
    ("setpoints alone are lost", "ardupilot"),
    ("process stopped for 3 s, pilot takes RTL meanwhile", "px4"),
    ("downlink lost, then the pilot takes RTL", "px4"),
    ("downlink lost, then the pilot takes LAND", "ardupilot"),
    ("estimator fails", "px4"),
    ("the ground is 2 m lower than configured", "ardupilot"),
    ("the ground is 2 m higher than configured", "px4"),
}


def fault_named(name):
    return next(fault for fault in FAULTS if fault.name == name)


@pytest.mark.parametrize(("name", "autopilot"), sorted(SUBSET))
def test_case_keeps_its_bounds(name, autopilot):
    fault = fault_named(name)
    result = fly_fault(fault, autopilot)
    assert failures(fault, autopilot, result) == [], result
    if not fault.harmless and fault.cause is None:
        assert within_protocol(result)
    if fault.harmless:
        assert result.state == State.ORBITING


def test_table_has_seventy_five_faults_with_distinct_names():
    assert len(FAULTS) >= 75
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def test_each_violated_requirement_is_reported():
    fault = fault_named("computer dies")
    result = fly_fault(fault, "ardupilot")
    worse = result._replace(
        motion_s=0.6, excursion_m=9.0, resumed=True, evident=False, least_distance_m=2.0, least_height_m=1.1
    )
    report = " ".join(failures(fault, "ardupilot", worse))
    for words in (
        "motion for 0.60 s",
        "excursion of 9.00 m",
        "without the operator",
        "no evidence",
        "2.00 m",
        "1.10 m",
    ):
        assert words in report
    other = fault_named("perception stops")
    assert "the condition is not PICTURES_LOST" in failures(other, "px4", result)[0]
