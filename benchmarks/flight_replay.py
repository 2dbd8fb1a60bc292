"""Recorded flights of ArduPilot Copter and PX4 against the simulated vehicle: `python benchmarks/flight_replay.py DIR`.

The same setpoints, from the same state, for 4 s: greatest distance between both, and how far both went.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from figures import ROOT, table, write_figures

from lab.flights.replay import WIND_M_S, Case, RecordedFlight, load_recorded, recorded_cases, replay

HEAD = ["recording", "autopilot", "from, s", "off after 1, 2, 3 s, m", "most, m", "went, simulated, m", "recorded, m"]
BOUND_M = 0.3
#: Whole orbits, from their setpoints alone: wind, and from when on they are flown freely.
ORBITS, FREE_FROM_S = {"orbit_standing_wind_8": WIND_M_S}, 6.0
ORBITS |= dict.fromkeys(("orbit_standing_calm", "px4_stand_calm", "px4_walk_calm"), (0.0, 0.0))
RESTED_S, MOVE_S = 7.5, 3.0  # 4.5 s after the fault


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT.parent / "shared" / "flight")
    args = parser.parse_args()
    rows, greatest, orbits, moves = [], [], [], []
    for path in sorted(args.folder.glob("*.npz")):
        flight, autopilot = load_recorded(path), "px4" if path.name.startswith("px4") else "ardupilot"
        if path.stem in ORBITS:
            orbits.append(whole_orbit(flight, path.stem, autopilot))
        if autopilot == "px4" and not any(word in path.stem for word in ("stand", "walk", "stick", "rtl")):
            moves.append(moved_at_rest(flight))
        for case in recorded_cases(flight, path.stem):
            got = replay(flight, case, autopilot)
            error = got.error_m
            greatest.append(error.max())
            after = ", ".join(f"{error[min(100 * s, len(error) - 1)]:.2f}" for s in (1, 2, 3))
            rows.append([
                path.stem, autopilot, f"{case.start_s:.1f}", after, f"{error.max():.2f}",
                f"{got.farthest_m(True):.2f}", f"{got.farthest_m(False):.2f}",
            ])  # fmt: skip
            print("  ".join(rows[-1]), flush=True)
    most = np.array(greatest)
    ardupilot = np.array([row[1] == "ardupilot" for row in rows])
    lines = [f"Comparisons of 4 s, within {BOUND_M:g} m:", ""]
    for name, chosen in (("both", np.full(len(rows), True)), ("ArduPilot", ardupilot), ("PX4", ~ardupilot)):
        part = most[chosen]
        within = f"{(part <= BOUND_M).sum()} of {len(part)}"
        lines.append(f"- {name}: {within}; median {np.median(part):.2f} m, {part.max(initial=0.0):.2f} m at most.")
    lines += ["", *(f"- {orbit}" for orbit in orbits)]
    if long := [move for move in moves if np.isfinite(move)]:
        lines += [
            "", f"PX4 that holds its place, 4.5 s and more after a stop, moved by {np.mean(long):.2f} m within 3 s in "
            f"the mean of {len(long)} recordings, by {max(long):.2f} m at most: no setpoint holds that motion.",
        ]  # fmt: skip
    summary = "\n".join(lines)
    print(summary)
    write_figures(
        "flight_replay", "Recorded flights against the simulated vehicle", f"{summary}\n\n{table(HEAD, rows)}"
    )
    return 0


def whole_orbit(flight: RecordedFlight, name: str, autopilot: str) -> str:
    """Distance between both, flown freely to the end of the recording."""
    seconds = float(flight.setpoint_s[-1]) - FREE_FROM_S
    error = replay(flight, Case(name, FREE_FROM_S, wind=ORBITS[name]), autopilot, seconds).error_m
    rms = float(np.sqrt(np.mean(error**2)))
    return f"{name}, {seconds:.0f} s from its setpoints alone: {rms:.2f} m (RMS), {error.max():.2f} m at most."


def moved_at_rest(flight: RecordedFlight) -> float:
    """Greatest horizontal move (m) within 3 s in a hold; NaN = the recording is too short."""
    times = np.arange(RESTED_S, float(flight.time_s[-1]), 0.01)
    path = np.stack([np.interp(times, flight.time_s, flight.position[:, i]) for i in (0, 1)], axis=1)
    step = round(MOVE_S / 0.01)
    return float(np.linalg.norm(path[step:] - path[:-step], axis=1).max()) if len(path) > step else float("nan")


if __name__ == "__main__":
    raise SystemExit(main())
