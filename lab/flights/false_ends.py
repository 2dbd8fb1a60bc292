"""Ends of the orbit that nothing causes: healthy flights about one who stands, with reports as recorded.

    python -m lab.flights.false_ends --autopilot px4 --hours 10 [--first 0] [--wind 8] [--mount fixed]

Each flight lasts ten minutes; the operator starts again what has ended.  Every flight prints a line: its seed, the ends
with their codes, and how far the believed place of the subject moves within a minute: in the autopilot's map, beyond
the error of that map, and so in means of 5 s, without what the estimate of a moment errs by.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.orbit.states import Command, State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

FLIGHT_S = 600.0
_SETTLE_S = 4.0  # as the other benchmarks: link and filters
_AGAIN_S = 3.0  # after an end, until the operator starts again
_DRIFT_S = 60.0
_PLACE_S = 1.0  # between the places that are compared
_MEAN_S = 5.0  # of the means


class Flight(NamedTuple):
    """Ends of the orbit by their codes, time in it in s, drifts in m of the believed place, one for each minute.

    own_m : beyond the error of the autopilot's position
    mean_m : as ``own_m``, of means
    """

    ends: list[str]
    orbiting_s: float
    drifts_m: list[float]
    own_m: list[float]
    mean_m: list[float]


def drifts(places: np.ndarray) -> list[float]:
    """Greatest distance (m) from the place at the beginning of each minute, of places (N, 2) m, one a second."""
    size = round(_DRIFT_S / _PLACE_S)
    minutes = (places[i : i + size + 1] for i in range(0, len(places) - size, size))
    return [float(np.nanmax(np.hypot(*(minute - minute[0]).T))) for minute in minutes]


def fly(settings: LoopSettings) -> Flight:
    """One flight, from the start of the orbit on."""
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04))
    places: list[np.ndarray] = []  # (2, 2) m: of the subject as believed, error of the autopilot's position
    waits_since = [_SETTLE_S]

    def operate(flown: OrbitLoop) -> None:
        if flown.t >= _SETTLE_S + len(places) * _PLACE_S and flown.status is not None:
            places.append(np.stack([flown.status.subject_position, flown.copter.error.position])[:, :2])
        if flown.controller.safety.state == State.ORBITING:
            waits_since[0] = flown.t
        elif flown.t - waits_since[0] > _AGAIN_S:
            waits_since[0] = flown.t
            control = flown.copter.mode == flown.copter.kind.control_mode
            flown.command(Command.START if control else Command.ENGAGE)

    loop.start(_SETTLE_S)
    loop.run(settings.seconds, operate)
    ends = [
        f"{condition.code.name} at {t:.0f} s"
        for (_, before, _), (t, state, condition) in itertools.pairwise(loop.reasons)
        if before == "ORBITING" and state != "ORBITING"
    ]
    orbiting = sum(row.state == State.ORBITING for row in loop.rows) / settings.config.control_hz
    believed, error = np.array(places).transpose(1, 0, 2)
    own, kernel = believed - error, np.full(round(_MEAN_S / _PLACE_S), _PLACE_S / _MEAN_S)
    means = np.stack([np.convolve(axis, kernel, "valid") for axis in own.T], axis=1)
    return Flight(ends, orbiting, drifts(believed), drifts(own), drifts(means))


def _words(drifts_m: list[float]) -> str:
    return f"median {np.median(drifts_m):.2f} m, most {max(drifts_m):.2f} m"


def main() -> int:
    """Fly for so many hours; status 1 where an orbit ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"), required=True)
    parser.add_argument("--hours", type=float, default=1.0, help="of flight")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--wind", type=float, default=0.0, help="m/s")
    parser.add_argument("--load", type=float, default=0.0, help="processes that want to run beside the bridge")
    parser.add_argument("--mount", default="gimbal", choices=("gimbal", "servo", "fixed"))
    args = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    flights: list[Flight] = []
    for seed in range(args.first, args.first + math.ceil(args.hours * 3600 / FLIGHT_S)):
        settings = LoopSettings(
            autopilot=args.autopilot,
            seed=seed,
            wind_m_s=(args.wind, 0.0, 0.0),
            mount=args.mount,
            seconds=FLIGHT_S,
            load=args.load,
        )
        flight = fly(settings)
        flights.append(flight)
        print(seed, ", ".join(flight.ends) or "no end", *map(_words, flight[2:]), sep="  ")
    ends = sum(len(flight.ends) for flight in flights)
    hours = sum(flight.orbiting_s for flight in flights) / 3600
    moved, own, mean = ([m for part in parts for m in part] for parts in list(zip(*flights, strict=True))[2:])
    print(f"{args.autopilot}: {ends} ends in {hours:.2f} h of orbit; moved {_words(moved)}; by itself {_words(own)}")
    print(f"means of {_MEAN_S:g} s: {_words(mean)}")
    return 1 if ends else 0


if __name__ == "__main__":
    raise SystemExit(main())
