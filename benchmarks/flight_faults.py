"""Table of faults in flight, for both dialects: `python benchmarks/flight_faults.py [--seeds N] [WORDS]`.

`python benchmarks/flight_faults.py processes` flies the real `mavlink_bridge` process in real time instead, and kills
and stops it and its perception.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

from drocap_ros.simulation.closed_loop.fault_flight import (  # noqa: E402
    EXCURSION_M,
    MOTION_S,
    Fault,
    FaultResult,
    failures,
    fly_fault,
    within_protocol,
)
from drocap_ros.simulation.closed_loop.fault_table import FAULTS  # noqa: E402


def row(fault: Fault, autopilot: str, result: FaultResult) -> tuple[str, str]:
    """Mark and line of a case: + bounds of the protocol kept, c those of the stated cause, h harmless, - not kept."""
    bad = failures(fault, autopilot, result)
    mark = "-" if bad else "h" if fault.harmless else "+" if within_protocol(result) else "c"
    going = fault.harmless and result.state.name == "ORBITING"
    bounds = "     -      -"
    if not fault.harmless:
        limits = fault.bounds(autopilot, result.speed_m_s)
        bounds = f"{limits.motion_s:6.2f} {limits.excursion_m:6.2f}"
    motion = "goes on" if going else f"{result.motion_s:7.2f}"
    note = (
        f"NOT KEPT: {'; '.join(bad)}. "
        if bad
        else f"[{fault.cause.description}] "
        if mark == "c" and fault.cause
        else ""
    )
    return mark, (
        f"{mark} {autopilot:9} {fault.name:40} {motion} {result.excursion_m:6.2f} {bounds} {result.speed_m_s:5.2f} "
        f"{result.state.name:10} {note}{result.condition}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only cases whose names hold one of these; or `processes`")
    parser.add_argument("--seeds", type=int, default=1, help="flights of each case; the worst is printed")
    parser.add_argument("--part", default="1/1", metavar="I/N", help="only the I-th of N parts of the cases")
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"))
    args = parser.parse_args()
    if args.words == ["processes"]:
        from flight_processes import main as fly_processes

        return fly_processes()
    print(f"  {'dialect':9} {'fault':40} {'motion':>7} {'away':>6} {'bound':>6} {'bound':>6} {'speed':>5}")
    print(f"  {'':9} {'':40} {'s':>7} {'m':>6} {'s':>6} {'m':>6} {'m/s':>5} state      reason, or cause", flush=True)
    marks: list[str] = []
    part, parts = (int(number) for number in args.part.split("/"))
    for autopilot in (args.autopilot,) if args.autopilot else ("ardupilot", "px4"):
        for fault in FAULTS[part - 1 :: parts]:
            if args.words and not any(word in fault.name for word in args.words):
                continue
            results = [fly_fault(fault, autopilot, 4 + i) for i in range(args.seeds)]
            rows = [row(fault, autopilot, result) for result in results]
            worst = max(range(args.seeds), key=lambda i: ("+hc-".index(rows[i][0]), results[i].excursion_m))
            marks.append(rows[worst][0])
            print(rows[worst][1], flush=True)
    counts = {mark: marks.count(mark) for mark in "+ch-"}
    print(
        f"{len(marks)} cases, {args.seeds} flight(s) each, the worst shown: {counts['+']} within "
        f"{MOTION_S:g} s and {EXCURSION_M:g} m; {counts['c']} within the bounds of a cause stated beforehand; "
        f"{counts['h']} harmless; {counts['-']} not kept"
    )
    return 1 if counts["-"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
