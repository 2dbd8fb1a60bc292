"""Recorded flights of ArduPilot Copter and PX4 against the simulated vehicle: `python benchmarks/flight_replay.py DIR`.

The same setpoints, from the same state, for 4 s: greatest distance between both, and how far both went.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from figures import ROOT, table, write_figures

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.vehicle import VehicleFilter
from lab.flights.replay import WIND_M_S, Case, RecordedFlight, load_recorded, recorded_cases, replay

HEAD = ["recording", "autopilot", "from, s", "off after 1, 2, 3 s, m", "most, m", "went, simulated, m", "recorded, m"]
REPORTED = [
    "recording", "setpoints for, s", "reports doubted now", "position reported, off by m", "believed",
    "velocity reported, off by m/s", "believed",
]  # fmt: skip
BOUND_M = 0.3
#: Whole orbits, from their setpoints alone: wind, and from when on they are flown freely.
ORBITS, FREE_FROM_S = {"orbit_standing_wind_8": WIND_M_S}, 6.0
ORBITS |= dict.fromkeys(("orbit_standing_calm", "px4_stand_calm", "px4_walk_calm"), (0.0, 0.0))
RESTED_S, MOVE_S = 7.5, 3.0  # 4.5 s after the fault


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT.parent / "shared" / "flight")
    args = parser.parse_args()
    rows, greatest, orbits, moves, reports = [], [], [], [], []
    for path in sorted(args.folder.glob("*.npz")):
        flight, autopilot = load_recorded(path), "px4" if "px4" in path.stem else "ardupilot"
        if path.stem.startswith("t3_"):
            reports.append(reported(path, autopilot))
            continue
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
    answers = f"Reports of recorded flights into the bridge's filter of them:\n\n{table(REPORTED, reports)}"
    write_figures(
        "flight_replay",
        "Recorded flights against the simulated vehicle",
        f"{summary}\n\n{table(HEAD, rows)}\n{answers}",
    )
    return 0


def reported(path: Path, autopilot: str) -> list[str]:
    """Cells of a flight whose reports are recorded: the orbit then, the answers to the same reports now."""
    with np.load(path) as data:
        flight = {name: np.asarray(data[name], float) for name in data.files}
    times, places, speeds = (flight[f"reported_{name}"] for name in ("time_s", "position_m", "velocity_m_s"))
    true, moved = (
        np.stack([np.interp(times, flight["time_s"], flight[name][:, i]) for i in range(3)], axis=1)
        for name in ("position_m", "velocity_m_s")
    )
    own, believed, doubts = VehicleFilter(autopilot_of(autopilot).velocity_sd_m_s), [], []
    for t, place, speed in zip(times, places, speeds, strict=True):
        doubts.append(own.take(t, place, speed))
        believed.append((own.position, own.velocity))
    found, velocities = np.array(believed).transpose(1, 0, 2)

    def off(value: np.ndarray, truth: np.ndarray) -> str:
        error = (value - truth)[len(times) // 4 :, :2]  # the filter has begun; a constant difference of maps is none
        return f"{np.sqrt(((error - error.mean(axis=0)) ** 2).sum(axis=1).mean()):.2f}"

    setpoints = flight.get("setpoint_time_s", np.zeros(0))
    flown = f"{np.ptp(setpoints):.0f}" if len(setpoints) else "-"
    doubted = sum(any(doubt) for doubt in doubts)
    return [
        path.stem, flown, str(doubted), off(places, true), off(found, true), off(speeds, moved), off(velocities, moved)
    ]  # fmt: skip


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
