"""Random moments of orbits: the bridge or its computer dies, or the downlink fails and the pilot chooses a mode.

    python benchmarks/flight_kills.py [--moments 200] [--jobs 2]         time-outs of 0.5 s
    python benchmarks/flight_kills.py pilot [--moments 200] [--jobs 2]   the pilot's mode is kept
    python benchmarks/flight_kills.py choices [--moments 24] [--jobs 2]  what a lab may choose about one who walks

Orbits of 4, 6 and 10 m, calm and in 8 m/s, standing and walking person.  Required after a death: horizontal motion of
2.5 m at most in 95 %, 3.0 m always; where the bridge alone dies, so that its guardian holds, never more than 1 m nearer
to the subject by the vehicle's own motion.
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from figures import table, write_figures

from drocap_ros.flight.orbit.states import Action, State
from lab.flights.branches import branch, over_processes
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

AUTOPILOTS = ("ardupilot", "px4")
RADII_M, WINDS_M_S, ACTIONS = (4.0, 6.0, 10.0), (0.0, 8.0), ("stand", "walk")
SPEED_M_S, SPEED_DEG_S = 2.0, 19.0
FIRST_S, LAST_S, TAIL_S = 6.0, 20.0, 5.0  # an orbit is long enough to be settled, and ends before most holds
_ORBITS = 6  # at most, for the moments of one kind
OFTEN_M, ALWAYS_M, NEARER_M = 2.5, 3.0, 1.0
MODES = {"ardupilot": ("LOITER", "RTL", "LAND"), "px4": ("RTL", "LOITER", "POSCTL")}
DIES = ("computer", "bridge")
DOWNLINKS = ("lost", "late", "lossy")
WATCHED_S, RETURNED_S = 5.0, 2.5
Result = TypeVar("Result")


class World(NamedTuple):
    """One kind of orbit."""

    autopilot: str
    radius_m: float
    wind_m_s: float
    action: str
    moments: int

    def loop(self, seed: int) -> OrbitLoop:
        settings = LoopSettings(
            autopilot=self.autopilot, seed=seed + 10 * int(self.radius_m + self.wind_m_s), action=self.action,
            wind_m_s=(self.wind_m_s, 0.0, 0.0), distance_m=self.radius_m + 1.0, seconds=LAST_S + 20.0,
        )  # fmt: skip
        omega = min(SPEED_DEG_S, math.degrees(SPEED_M_S / self.radius_m))
        return OrbitLoop(with_config(settings, radius_m=self.radius_m, angular_speed_deg_s=omega, fence_radius_m=60.0))

    def branches(self, end: Callable[[OrbitLoop, int, float], Result]) -> list[Result]:
        """Ends of orbits at random moments, from their number and a random number."""
        found: list[Result] = []
        chance = random.Random(f"{self.autopilot} {self.radius_m} {self.wind_m_s} {self.action}")
        for seed in range(_ORBITS):
            loop = self.loop(seed)
            loop.start()
            least = max(1, self.moments // 2)
            for at_s in sorted(chance.uniform(FIRST_S, LAST_S) for _ in range(least)):
                loop.run(at_s)
                if len(found) == self.moments:
                    return found
                if loop.controller.safety.state != State.ORBITING:
                    break
                number = chance.random()
                found.append(branch(lambda loop=loop, number=number: end(loop, len(found), number)))
        print(f"{self}: {len(found)} moments only: {loop.controller.safety.reason}")
        return found


class Kill(NamedTuple):
    """One death: greatest horizontal distance from there, m; speeds, m/s.

    nearer_m, own_m : how much nearer to the subject, m; so much of it by the vehicle's motion, not by his
    """

    world: World
    dies: str
    at_s: float
    moved_m: float
    nearer_m: float
    own_m: float
    speed_m_s: float
    top_m_s: float


def killed(world: World, loop: OrbitLoop, dies: str = "computer") -> Kill:
    """The bridge commands nothing from now on; where the computer dies, its guardian does not either."""
    first, place = len(loop.rows), loop.copter.body.position.copy()
    at_s, speed = loop.t, float(np.linalg.norm(loop.copter.body.velocity))
    distance = float(np.hypot(*(loop.pelvis()[:2] - place[:2])))
    if dies == "computer":
        loop.stopped = loop.dead = True
    else:  # the new process commands nothing
        loop.restart()
    loop.run(loop.t + TAIL_S)
    rows = loop.rows[first:]
    stood = [float(np.hypot(*(loop.pelvis(row.t_s)[:2] - place[:2]))) for row in rows]
    return Kill(
        world, dies, at_s, max(float(np.hypot(*(row.position - place)[:2])) for row in rows),
        distance - min(nearness(row, loop) for row in rows),
        max(min(distance, alone) - row.distance_m for row, alone in zip(rows, stood, strict=True)), speed,
        max(float(np.linalg.norm(row.velocity)) for row in rows),
    )  # fmt: skip


def nearness(row: Any, loop: OrbitLoop) -> float:
    """Distance from the person, m; a person who walks up to a vehicle that stands does not count."""
    return float(row.distance_m) if np.linalg.norm(row.velocity) > 0.3 else math.inf


def kills_of(world: World) -> list[Kill]:
    """Each moment twice."""
    pairs = world.branches(
        lambda loop, count, number: [branch(lambda dies=dies: killed(world, loop, dies)) for dies in DIES]
    )
    return [kill for pair in pairs for kill in pair]


class Choice(NamedTuple):
    """One mode of the pilot: whether it was kept, and whether the bridge sent nothing at the end."""

    world: World
    downlink: str
    mode: str
    kept: bool
    silent: bool
    later: list[tuple[float, str, str]]


def chosen(world: World, loop: OrbitLoop, downlink: str, seed: float) -> Choice:
    """The downlink fails, the pilot chooses a mode, the downlink returns."""
    chance = random.Random(seed)
    if downlink == "lost":
        loop.down.cut = True
    elif downlink == "late":
        loop.down.delay_s = chance.uniform(0.3, 1.0)
    else:
        loop.down.loss = chance.uniform(0.5, 0.95)
    loop.run(loop.t + chance.uniform(0.2, 5.0))
    mode, chosen_s = chance.choice(MODES[world.autopilot]), loop.t
    loop.copter.set_mode(mode, "pilot")
    loop.run(loop.t + WATCHED_S)
    loop.down.cut, loop.down.delay_s, loop.down.loss = False, 0.01, 0.0
    loop.run(loop.t + RETURNED_S)
    silent = all(row.action == Action.NOTHING for row in loop.rows if row.t_s > loop.t - RETURNED_S + 0.3)
    later = [entry for entry in loop.copter.mode_log if entry[0] > chosen_s]
    return Choice(world, downlink, mode, loop.copter.mode == mode and not later, silent, later)


def choices_of(world: World) -> list[Choice]:
    return world.branches(lambda loop, count, number: chosen(world, loop, DOWNLINKS[count % 3], number))


def worlds(moments: int) -> list[World]:
    """All of them, so that each autopilot has at least so many moments."""
    kinds = list(itertools.product(RADII_M, WINDS_M_S, ACTIONS))
    each = math.ceil(moments / len(kinds))
    return [World(autopilot, *kind, each) for autopilot in AUTOPILOTS for kind in kinds]


def kills(moments: int, jobs: int) -> int:
    """Distribution of the motion after kills."""
    rows, lines, bad = [], [], 0
    for part in over_processes(kills_of, worlds(moments), jobs):
        rows += part
        for dies in DIES if part else ():
            lines.append([*part[0].world[:4], dies, *figures_of([kill for kill in part if kill.dies == dies])])
            print("  ".join(str(cell) for cell in lines[-1]), flush=True)
    for autopilot, dies in itertools.product(AUTOPILOTS, DIES):
        part = [kill for kill in rows if (kill.world.autopilot, kill.dies) == (autopilot, dies)]
        moved = np.array([kill.moved_m for kill in part])
        bad += bool(np.mean(moved <= OFTEN_M) < 0.95 or moved.max() > ALWAYS_M)
        bad += dies == "bridge" and max(kill.own_m for kill in part) > NEARER_M
        lines.append([autopilot, "all", "", "", dies, *figures_of(part)])
        print("  ".join(str(cell) for cell in lines[-1]), flush=True)
    head = [
        "autopilot", "radius, m", "wind, m/s", "person", "what dies", "moments", "moved: median, m", "95 %", "most",
        "share <= 2.5 m, %", "nearer by, most, m", "by its own motion, m", "top speed / at the kill, m/s",
    ]  # fmt: skip
    write_figures("flight_kills", "Death of the bridge, and of its computer, at random moments", table(head, lines))
    return bad


def figures_of(part: list[Kill]) -> list[str]:
    """Cells of a row."""
    moved = np.array([kill.moved_m for kill in part])
    worst = max(part, key=lambda kill: kill.top_m_s - kill.speed_m_s)
    return [
        str(len(part)), f"{np.median(moved):.2f}", f"{np.quantile(moved, 0.95):.2f}", f"{moved.max():.2f}",
        f"{100 * np.mean(moved <= OFTEN_M):.0f}", f"{max(kill.nearer_m for kill in part):.2f}",
        f"{max(kill.own_m for kill in part):.2f}",
        f"{worst.top_m_s:.2f} / {worst.speed_m_s:.2f}",
    ]  # fmt: skip


def pilot(moments: int, jobs: int) -> int:
    """Modes that the pilot chose while the downlink failed."""
    found = [choice for part in over_processes(choices_of, worlds(moments), jobs) for choice in part]
    lines = []
    for autopilot, downlink in itertools.product(AUTOPILOTS, DOWNLINKS):
        part = [c for c in found if (c.world.autopilot, c.downlink) == (autopilot, downlink)]
        kept, silent = sum(c.kept for c in part), sum(c.silent for c in part)
        lines.append([autopilot, downlink, len(part), kept, silent])
        print("  ".join(str(cell) for cell in lines[-1]), flush=True)
        for c in [c for c in part if not c.kept][:3]:
            print(f"    {c.mode} became {c.later}")
    head = ["autopilot", "downlink", "moments", "mode kept", "nothing sent after its return"]
    write_figures("flight_pilot", "The pilot's mode while the downlink fails", table(head, lines))
    return sum(not (c.kept and c.silent) for c in found)


CHOICES: tuple[dict[str, float], ...] = ({}, {"max_closing_m_s": 1.5}, {"max_closing_m_s": 1.5, "max_coast_m": 4.0})
CHOICE_S, RAMPED_S = 64.0, 17.0
DEATHS_S = (17.0, 25.0, 33.0, 41.0, 49.0, 57.0)


class Chosen(NamedTuple):
    """A walker's orbit by a choice: radius errors, m, and angular speeds, deg/s, of its steps; deaths of the bridge."""

    errors_m: np.ndarray
    speeds_deg_s: np.ndarray
    deaths: list[Kill]


def walked_about(job: tuple[dict[str, float], int]) -> Chosen:
    """PX4 about one who walks, calm, at 6 m; the computer dies every 8 s, in a branch."""
    choice, seed = job
    settings = LoopSettings(autopilot="px4", action="walk", seed=seed, seconds=CHOICE_S + TAIL_S + 1)
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04, **choice))
    loop.start()
    world, deaths = World("px4", 6.0, 0.0, "walk", 0), []
    for at_s in DEATHS_S:
        loop.run(at_s)
        if loop.controller.safety.state == State.ORBITING:
            deaths.append(branch(lambda: killed(world, loop)))
    loop.run(CHOICE_S)
    rows = [row for row in loop.rows if row.t_s >= RAMPED_S and row.state == State.ORBITING]
    offsets = np.array([row.position[:2] - loop.pelvis(row.t_s)[:2] for row in rows])
    times, bearing = np.array([row.t_s for row in rows]), np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    speeds = np.degrees(np.abs(np.interp(times + 1.0, times, bearing) - bearing))[times < times[-1] - 1.0]
    return Chosen(np.abs(np.hypot(*offsets.T) - 6.0), speeds, deaths)


def choices(moments: int, jobs: int) -> int:
    """The table of choices, each with so many deaths at most."""
    seeds = range(math.ceil(moments / len(DEATHS_S)))
    found, lines = over_processes(walked_about, list(itertools.product(CHOICES, seeds)), jobs), []
    for choice, parts in itertools.groupby(
        zip(itertools.product(CHOICES, seeds), found, strict=True), lambda p: p[0][0]
    ):
        part = [chosen for _, chosen in parts]
        errors, deaths = np.concatenate([c.errors_m for c in part]), [kill for c in part for kill in c.deaths]
        lines.append([
            ", ".join(f"{name} {value:g}" for name, value in choice.items()) or "as delivered",
            f"{errors.mean():.2f} ({errors.max():.2f})", f"{np.concatenate([c.speeds_deg_s for c in part]).mean():.1f}",
            len(deaths), f"{max(kill.moved_m for kill in deaths):.2f}", f"{max(kill.own_m for kill in deaths):.2f}",
        ])  # fmt: skip
        print("  ".join(str(cell) for cell in lines[-1]), flush=True)
    text = (
        f"PX4 about one who walks at 1.4 m/s, calm, gimbal, 6 m, {len(seeds)} seeds of {CHOICE_S:g} s, each choice the"
        " same; the computer dies every 8 s.\n\n"
    )
    head = [
        "choice",
        "radius error, m: mean (worst)",
        "deg/s",
        "deaths",
        "moved, m: most",
        "nearer by own motion, m: most",
    ]
    write_figures("flight_choices", "What a lab may choose about one who walks", text + table(head, lines))
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="kills", choices=["kills", "pilot", "choices"])
    parser.add_argument("--moments", type=int, default=200, help="of each autopilot")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    args = parser.parse_args()
    run = {"kills": kills, "pilot": pilot, "choices": choices}[args.what]
    return 1 if run(args.moments, args.jobs) else 0


if __name__ == "__main__":
    raise SystemExit(main())
