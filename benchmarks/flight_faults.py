"""Table of faults in flight, for both dialects: `python benchmarks/flight_faults.py [--seeds N] [WORDS]`.

`python benchmarks/flight_faults.py processes` flies the real `mavlink_bridge` process in real time instead, and kills
and stops it and its perception.
"""

from __future__ import annotations

import argparse

from figures import table, write_figures

from lab.flights.branches import over_processes
from lab.flights.fault_flight import (
    EXCURSION_M,
    MOTION_S,
    Fault,
    FaultResult,
    failures,
    fly_fault,
    within_protocol,
)
from lab.flights.fault_table import FAULTS

HEAD = [
    "", "dialect", "fault", "motion, s", "bound, s", "away, m", "bound, m", "speed, m/s", "state", "cause or condition",
]  # fmt: skip


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


def flown(case: tuple[str, int, int]) -> list[str]:
    """Cells of the worst flight of a case: its dialect, its number in the table, how many flights."""
    autopilot, number, seeds = case
    fault = FAULTS[number]
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
    parser.add_argument("--part", default="1/1", metavar="I/N", help="only the I-th of N parts of the cases")
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"))
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    args = parser.parse_args()
    if args.words == ["processes"]:
        from flight_processes import main as fly_processes

        return fly_processes()
    worst: list[list[str]] = []
    part, parts = (int(number) for number in args.part.split("/"))
    cases = [
        (autopilot, number, args.seeds)
        for autopilot in ((args.autopilot,) if args.autopilot else ("ardupilot", "px4"))
        for number in range(part - 1, len(FAULTS), parts)
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
    if len(worst) == 2 * len(FAULTS):  # a selection of cases must not replace the page
        write_figures("flight_faults", "Faults in flight", f"{summary}\n\n{table(HEAD, worst)}")
    return 1 if counts["-"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
