"""Errors of reported positions and velocities of recorded flights, fitted as an autoregressive process.

    python -m lab.studies.report_errors FOLDER px4 [ardupilot ...]

FOLDER holds ``t3_AUTOPILOT_*.npz`` with the true and the reported motion.  It prints the numbers of
``ReportErrors`` for each autopilot, and sizes of the recorded errors beside those of the process.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from drocap_ros.flight.autopilot.autopilot import ReportErrors
from drocap_ros.simulation.vehicle.copter_reports import EstimateError

STEP_S = 0.1
#: Flights with a cut link have few reports, those without satellites other errors.
LEFT_OUT = ("cut", "SIGSTOP", "gps_lost", "asis")


def recorded_errors(path: Path) -> np.ndarray:
    """(T, 3, 2) position (m) and velocity (m/s) as reported less the truth, ENU, every 0.1 s."""
    with np.load(path) as flight:
        time, reported = flight["time_s"], flight["reported_time_s"]
        grid = np.arange(reported[0] + 0.5, reported[-1] - 0.5, STEP_S)

        def on_grid(at: np.ndarray, values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(grid, at, values[:, axis]) for axis in range(3)], axis=1)

        return np.stack(
            [
                on_grid(reported, flight[f"reported_{name}"]) - on_grid(time, flight[name])
                for name in ("position_m", "velocity_m_s")
            ],
            axis=-1,
        )


def fit(series: list[np.ndarray]) -> ReportErrors:
    """The process of errors (T, 2) of several flights; their common mean is left out."""
    mean = np.concatenate(series).mean(axis=0)
    before = np.concatenate([np.hstack([s[1:-1], s[:-2]]) - np.tile(mean, 2) for s in series])
    after = np.concatenate([s[2:] - mean for s in series])
    solved = np.linalg.lstsq(before, after, rcond=None)[0].T
    left = np.cov((after - before @ solved.T).T)
    noise = np.sqrt(np.diag(left))
    rows = solved.round(4).tolist()
    return ReportErrors(
        first=(tuple(rows[0][:2]), tuple(rows[1][:2])),
        second=(tuple(rows[0][2:]), tuple(rows[1][2:])),
        noise=(round(float(noise[0]), 5), round(float(noise[1]), 5)),
        correlation=round(float(left[0, 1] / noise.prod()), 2),
    )


def sizes(series: list[np.ndarray]) -> str:
    """Standard deviations of the errors (T, 2), and of their changes within 1 s."""
    spread = np.concatenate(series).std(axis=0)
    change = np.concatenate([s[10:] - s[:-10] for s in series if len(s) > 10]).std(axis=0)
    return (
        f"position {spread[0]:.2f} m, velocity {spread[1]:.2f} m/s;"
        f" within 1 s they change by {change[0]:.2f} m, {change[1]:.2f} m/s"
    )


def simulated_errors(horizontal: ReportErrors, vertical: ReportErrors, seconds: float, seed: int) -> np.ndarray:
    """(T, 3, 2) of the simulated vehicle, every 0.1 s."""
    error = EstimateError(horizontal, vertical, 1.0, seed)
    rows = []
    for _ in range(round(seconds / STEP_S)):
        error.step(False, STEP_S)
        rows.append(np.stack([error.position, error.velocity], axis=-1))
    return np.array(rows)


def main(folder: Path, autopilots: list[str]) -> None:
    """Print the fits."""
    for autopilot in autopilots:
        paths = [p for p in sorted(folder.glob(f"t3_{autopilot}_*.npz")) if not any(w in p.name for w in LEFT_OUT)]
        flights = [flight for path in paths if len(flight := recorded_errors(path)) > 30]
        fits = [fit([flight[:, axis] for flight in flights for axis in axes]) for axes in ((0, 1), (2,))]
        simulated = [simulated_errors(fits[0], fits[1], 50.0, seed) for seed in range(20)]
        for name, axes, found in (("horizontal", (0, 1), fits[0]), ("vertical", (2,), fits[1])):
            print(f"{autopilot} {name}: {found}")
            for kind, errors in (("recorded", flights), ("simulated", simulated)):
                print(f"  {kind}: {sizes([flight[:, axis] for flight in errors for axis in axes])}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
