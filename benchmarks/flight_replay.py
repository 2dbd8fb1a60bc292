"""Recorded flights of ArduPilot Copter and PX4 against the simulated vehicle: `python benchmarks/flight_replay.py DIR`.

The same setpoints, from the same state, for 4 s: greatest distance between both, and how far both went.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from figures import ROOT, table, write_figures

from drocap_ros.simulation.vehicle.replay import load_recorded, recorded_cases, replay

HEAD = ["recording", "autopilot", "from, s", "off after 1, 2, 3 s, m", "most, m", "went, simulated, m", "recorded, m"]
BOUND_M = 0.3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT.parent / "shared" / "flight")
    args = parser.parse_args()
    rows, missed, count = [], 0, 0
    for path in sorted(args.folder.glob("*.npz")):
        flight, autopilot = load_recorded(path), "px4" if path.name.startswith("px4") else "ardupilot"
        for case in recorded_cases(flight, path.stem):
            got = replay(flight, case, autopilot)
            error = got.error_m
            count += 1
            missed += error.max() > BOUND_M
            after = ", ".join(f"{error[min(100 * s, len(error) - 1)]:.2f}" for s in (1, 2, 3))
            rows.append([
                path.stem, autopilot, f"{case.start_s:.1f}", after, f"{error.max():.2f}",
                f"{got.farthest_m(True):.2f}", f"{got.farthest_m(False):.2f}",
            ])  # fmt: skip
            print("  ".join(rows[-1]), flush=True)
    most = np.array([float(row[4]) for row in rows])
    summary = f"{count} comparisons of 4 s: {count - missed} within {BOUND_M:g} m; median {np.median(most):.2f} m."
    print(summary)
    write_figures(
        "flight_replay", "Recorded flights against the simulated vehicle", f"{summary}\n\n{table(HEAD, rows)}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
