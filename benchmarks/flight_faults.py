"""Table of faults in flight, for both dialects: `python benchmarks/flight_faults.py [--planned] [--seeds N] [WORDS]`.

`--planned`: orbits by a plan whose wishes are drawn, as in `flight_orbits.py --planned`; only faults in an orbit.

`python benchmarks/flight_faults.py processes` flies the real `mavlink_bridge` process in real time instead, and kills
and stops it and its perception.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from figures import table, write_figures

from drocap_ros.flight.orbit.states import State
from drocap_ros.flight.orbit_config import ACCURACY
from drocap_ros.flight.orbit_goal import Wish
from lab.flights.branches import over_processes
from lab.flights.fault_flight import (
    EXCURSION_M,
    FAULT_S,
    MOTION_S,
    Fault,
    FaultResult,
    failures,
    fly_fault,
    within_protocol,
)
from lab.flights.fault_table import FAULTS
from lab.flights.orbit_loop import OrbitLoop, with_config

HEAD = [
    "", "dialect", "fault", "motion, s", "bound, s", "away, m", "bound, m", "speed, m/s", "state", "cause or condition",
]  # fmt: skip


def wish(loop: OrbitLoop) -> None:
    """Worse than any plan: anywhere, at heights beyond the limits too; it lasts until the flight is judged."""
    chance = np.random.default_rng([loop.settings.seed, round(loop.t)])
    drawn = Wish(chance.uniform(-4.0, 4.0), chance.uniform(-2.0, 25.0), loop.t + 2 * FAULT_S, "drawn")
    loop.controller.on_wish(drawn)


def planned(fault: Fault) -> Fault:
    """The same fault in an orbit by a plan, with a wish a second until it occurs."""
    wishes = [(float(at_s), wish) for at_s in range(1, int(FAULT_S))]
    return replace(
        fault,
        change=lambda settings: with_config(fault.change(settings), plan=ACCURACY),
        before=tuple(sorted([*fault.before, *wishes], key=lambda act: act[0])),
    )


def row(fault: Fault, autopilot: str, result: FaultResult) -> list[str]:
    """Cells of a case; first: + within the protocol's bounds, c within those of the cause, h harmless, - not kept."""
    bad = failures(fault, autopilot, result)
    mark = "-" if bad else "h" if fault.harmless else "+" if within_protocol(result) else "c"
    going = fault.harmless and result.state.name == "ORBITING"
    motion_bound, away_bound = "-", "-"
    if not fault.harmless:
        limits = fault.bounds(autopilot, result.speed_m_s)
        motion_bound, away_bound = f"{limits.motion_s:.2f}", f"{limits.excursion_m:.2f}"
    motion = "continues" if going else f"{result.motion_s:.2f}"
    note = (
        f"NOT KEPT: {'; '.join(bad)}. "
        if bad
        else f"[{fault.cause.description}] "
        if mark == "c" and fault.cause
        else ""
    )
    return [
        mark, autopilot, fault.name, motion, motion_bound, f"{result.excursion_m:.2f}", away_bound,
        f"{result.speed_m_s:.2f}", result.state.name, f"{note}{result.condition}",
    ]  # fmt: skip


def flown(case: tuple[str, int, int, bool]) -> list[str]:
    """Cells of the worst flight of a case: its dialect, its number in the table, how many flights, whether planned."""
    autopilot, number, seeds, by_plan = case
    fault = planned(FAULTS[number]) if by_plan else FAULTS[number]
    try:
        results = [fly_fault(fault, autopilot, 4 + i) for i in range(seeds)]
    except AssertionError as error:  # the flight did not come to where the fault begins
        return ["-", autopilot, fault.name, *[""] * 6, f"NOT FLOWN: {error}"]
    rows = [row(fault, autopilot, result) for result in results]
    return rows[max(range(seeds), key=lambda i: ("+hc-".index(rows[i][0]), results[i].excursion_m))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only cases whose names hold one of these; or `processes`")
    parser.add_argument("--seeds", type=int, default=1, help="flights of each case; the worst is printed")
    parser.add_argument("--planned", action="store_true", help="orbits by a plan with drawn wishes")
    parser.add_argument("--part", default="1/1", metavar="I/N", help="only the I-th of N parts of the cases")
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"))
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    args = parser.parse_args()
    if args.words == ["processes"]:
        from flight_processes import main as fly_processes

        return fly_processes()
    worst: list[list[str]] = []
    faults = [number for number, fault in enumerate(FAULTS) if not args.planned or fault.state == State.ORBITING]
    part, parts = (int(number) for number in args.part.split("/"))
    cases = [
        (autopilot, number, args.seeds, args.planned)
        for autopilot in ((args.autopilot,) if args.autopilot else ("ardupilot", "px4"))
        for number in faults[part - 1 :: parts]
        if not args.words or any(word in FAULTS[number].name for word in args.words)
    ]
    for cells in over_processes(flown, cases, args.jobs):
        worst.append(cells)
        print("  ".join(cells), flush=True)
    counts = {mark: sum(cells[0] == mark for cells in worst) for mark in "+ch-"}
    summary = (
        f"{len(worst)} cases, {args.seeds} flight(s) each, the worst of each: {counts['+']} within {MOTION_S:g} s and"
        f" {EXCURSION_M:g} m (+), {counts['c']} within the bounds of a cause stated beforehand (c), {counts['h']}"
        f" harmless (h), {counts['-']} not kept (-)."
    )
    print(summary)
    if len(worst) == 2 * len(faults):  # a selection of cases must not replace the page
        page = (
            ("flight_faults_planned", "Faults in planned flight")
            if args.planned
            else ("flight_faults", "Faults in flight")
        )
        write_figures(*page, f"{summary}\n\n{table(HEAD, worst)}")
    return 1 if counts["-"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
