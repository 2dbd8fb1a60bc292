"""Orbits by what is seen in rendered pictures, in simulated time: ``python benchmarks/flight_pixels.py``.

Person, wind and orbit of the requirement: radius 6 m, 2 m/s, wind 8 m/s, standing or walking at 1.4 m/s and turning.
Bounds: mean radius error 0.3 m, mean yaw error 3 deg after the ramp, person in the middle third 95 % of the time.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from figures import table, write_figures

from drocap_ros.cli.demo.operator import Operator
from drocap_ros.flight.orbit.states import State
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, orbit_quality, with_config
from lab.flights.pixel_loop import PixelOrbitLoop

_RADIUS_M, _SETTLED_S = 6.0, 13.0


def main() -> None:
    """Fly and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--autopilots", nargs="+", default=["ardupilot", "px4"])
    parser.add_argument("--actions", nargs="+", default=["stand", "walk"])
    parser.add_argument("--seconds", type=float, default=31.0, help="of each flight")
    parser.add_argument("--models", default="simulation")
    args = parser.parse_args()
    rows = []
    for autopilot in args.autopilots:
        for action in args.actions:
            for seed in args.seeds:
                rows.append(flown(autopilot, action, seed, args.seconds, args.models))
                print("  ".join(rows[-1]), flush=True)
    head = [
        "autopilot", "person", "seed", "radius error, m", "yaw error, deg", "middle third", "orbiting", "holds",
        "nearest, m", "with subject", "keypoint error / height", "machine s",
    ]  # fmt: skip
    write_figures(
        "flight_pixels", "Orbits by rendered images", "Radius 6 m, 2 m/s, wind 8 m/s.\n\n" + table(head, rows)
    )


def flown(autopilot: str, action: str, seed: int, seconds: float, models: str) -> list[str]:
    """A row of the table."""
    begin = time.process_time()
    settings = with_config(
        LoopSettings(
            autopilot=autopilot, action=action, seed=seed, wind_m_s=(8.0, 0.0, 0.0), seconds=seconds,
            bearing_deg=37.0 * seed,
        ),
        body_height_m=1.75,
    )  # fmt: skip
    loop = PixelOrbitLoop(settings, PoseEstimator(models_folder(models), PoseEstimatorConfig()))
    operator = Operator(seconds, restarts=100, requests_control=autopilot == "px4")

    def operate(flying: OrbitLoop) -> None:
        safety = flying.controller.safety
        if flying.answers and flying.t - flying.answers[-1][0] < 0.1:
            accepted, condition = flying.answers[-1][1]
            operator.on_answer(accepted, condition.code, str(condition), flying.t)
        command = operator.on_status(safety.state, safety.condition.code, safety.reason, flying.t)
        if command is not None:
            flying.command(command)

    loop.run(seconds, operate)
    share = np.array(loop.errors) / np.array(loop.heights_px)[:, None]
    first = [autopilot, action, str(seed)]
    rows = [row for row in loop.rows if row.t_s >= _SETTLED_S]
    if not any(row.state == State.ORBITING for row in rows):
        return [*first, f"no orbit: {'; '.join(operator.holds) or loop.reasons[-1]}", *["-"] * 8]
    q = orbit_quality(loop, _RADIUS_M, _SETTLED_S)
    seen = np.isfinite(share).any(axis=1).mean()
    return [
        *first, f"{q.radius_error_m:.2f}", f"{q.yaw_error_deg:.1f}", f"{100 * q.in_middle_third:.0f} %",
        f"{100 * q.orbiting:.0f} %", str(len(operator.holds)), f"{q.least_distance_m:.1f}", f"{100 * seen:.0f} %",
        f"{np.nanmean(share):.3f}", f"{time.process_time() - begin:.0f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
