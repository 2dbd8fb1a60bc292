"""Orbits by reported heights that err: the lowest true height that the vehicle reaches by its own motion.

``python -m lab.flights.heights [--step M] [--jobs N]``: errors from -5 to 5 m, of both autopilots, a gimbal and a fixed
camera, with and without the ground plane; from the beginning, and growing by 0.25 m/s in flight.
"""

from __future__ import annotations

import argparse
import itertools
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.orbit.states import Action, State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

LEAST_M = 1.2
_START_S, _SECONDS, _DRIFT_M_S = 4.0, 30.0, 0.25


class Case(NamedTuple):
    """One flight; ``drifts``: the error grows in flight."""

    error_m: float
    autopilot: str = "ardupilot"
    mount: str = "gimbal"
    ground_plane: bool = True
    drifts: bool = False
    height_m: float = 3.0


class Outcome(NamedTuple):
    """Lowest true height while motion was sent, whether an orbit was flown, how the flight ended."""

    case: Case
    lowest_m: float
    flown: bool
    words: str


def fly(case: Case) -> Outcome:
    """Fly a case."""
    settings = LoopSettings(case.autopilot, seed=4, mount=case.mount, seconds=_SECONDS, height_m=case.height_m)
    first_m = 0.0 if case.drifts else case.error_m
    changes = {"use_ground_plane": case.ground_plane, "max_height_m": 12.0}
    loop = OrbitLoop(with_config(settings, ground_height_m=-first_m, **changes))

    def drift(loop: OrbitLoop) -> None:
        grown = np.sign(case.error_m) * min(abs(case.error_m), _DRIFT_M_S * max(loop.t - 8.0, 0.0))
        loop.copter.gps_error = np.array([*loop.copter.gps_error[:2], grown])

    loop.start(_START_S)
    loop.run(_SECONDS, drift if case.drifts else None)
    orbits = [row.t_s for row in loop.rows if row.state == State.ORBITING]
    moved_s = max((row.t_s for row in loop.rows if row.action == Action.ORBIT), default=0.0) + 0.5  # the rest is a hold
    heights = [row.position[2] for row in loop.rows if _START_S < row.t_s <= moved_s]
    words = f"{loop.controller.safety.state.name}: {loop.controller.safety.condition}"
    words = words if orbits else f"refused: {loop.answers[-1][1].condition}"
    return Outcome(case, float(min(heights, default=case.height_m)), bool(orbits), words)


def main() -> None:
    """Fly the grid and print what was lowest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=float, default=0.25, help="between errors, m")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    errors = np.arange(-5.0, 5.0 + 1e-9, args.step).tolist()
    grid = itertools.product(errors, ("ardupilot", "px4"), ("gimbal", "fixed"), (True, False), (False, True))
    with ProcessPoolExecutor(args.jobs) as pool:
        outcomes = list(pool.map(fly, itertools.starmap(Case, grid)))
    for outcome in sorted(outcomes, key=lambda row: row.lowest_m)[:20]:
        print(f"{outcome.lowest_m:6.2f} m  {outcome.case}  {outcome.words}")
    low = [outcome for outcome in outcomes if outcome.lowest_m < LEAST_M]
    flown = sum(outcome.flown for outcome in outcomes)
    print(f"{len(outcomes)} flights, {flown} with an orbit, {len(low)} lower than {LEAST_M:g} m")


if __name__ == "__main__":
    main()
