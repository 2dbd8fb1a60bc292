"""Table of faults in flight, for both dialects: `python benchmarks/flight_faults.py`."""

from __future__ import annotations

import sys

from drocap_ros.simulation.flight_faults import FAULTS, fly_fault, passes


def main() -> int:
    words = sys.argv[1:]
    print(f"{'':1} {'dialect':9} {'fault':42} {'motion s':>8} {'away m':>7} {'state':10} reason, or cause")
    bad = count = 0
    for autopilot in ("ardupilot", "px4"):
        for fault in FAULTS:
            if words and not any(word in fault.name for word in words):
                continue
            result = fly_fault(fault, autopilot)
            good = passes(fault, result)
            count += 1
            bad += not (good or fault.cause)
            mark = "+" if good else "c" if fault.cause else "-"
            motion = "goes on" if fault.harmless and result.state.name == "ORBITING" else f"{result.motion_s:8.2f}"
            note = f"[{fault.cause}] " if fault.cause and not good else ""
            print(
                f"{mark} {autopilot:9} {fault.name:42} {motion:>8} {result.excursion_m:7.2f} {result.state.name:10} "
                f"{'RESUMED ' if result.resumed else ''}{note}{result.reason}",
                flush=True,
            )
    print(f"{count} cases: + bound kept, c not kept for the cause given, - neither: {bad}")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
