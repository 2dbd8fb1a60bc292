"""Orbits in closed loop: randomized ones, which must keep every limit, and the quality of the protocol's orbit.

    python benchmarks/flight_orbits.py                      the 300 randomized orbits, those not flown yet
    python benchmarks/flight_orbits.py --first 100 --count 50
    python benchmarks/flight_orbits.py table                summary of the orbits flown
    python benchmarks/flight_orbits.py quality              errors of radius, yaw and framing

Each randomized orbit is a line of `benchmarks/results/flight_orbits.jsonl`; `--again` repeats the recorded ones.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import math
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from figures import table as markdown_table
from figures import write_figures

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.states import Command, State
from drocap_ros.simulation.closed_loop.orbit_loop import LoopSettings, OrbitLoop, orbit_quality, with_config

SECONDS = 24.0
SETTLE_S = 4.0
RETRY_S = 3.0
RESULTS = Path(__file__).parent / "results" / "flight_orbits.jsonl"
_SOURCES = Path(__file__).parents[1] / "drocap_ros"


def _code_version() -> str:
    """Hash of the flight and simulation sources."""
    digest = hashlib.sha256()
    for path in sorted([*(_SOURCES / "flight").rglob("*.py"), *(_SOURCES / "simulation").rglob("*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


_CODE = _code_version()


def settings_of(seed: int) -> LoopSettings:
    """A flight that the parameters allow: person, place, wind, orbit and link drawn at random."""
    rng = np.random.default_rng(seed)
    while True:
        radius = rng.uniform(3.8, 12.0)
        try:
            config = MavlinkBridgeConfig(
                commands_enabled=True, mode_change_allowed=True, attitude_hz=25.0, position_hz=20.0,
                radius_m=radius, height_m=rng.uniform(1.8, 6.0),
                angular_speed_deg_s=float(rng.uniform(8, 40) * rng.choice([-1, 1])),
                body_height_m=rng.uniform(1.6, 1.9), fence_radius_m=rng.uniform(20, 40),
                gimbal_control=bool(np.random.default_rng([seed, 1]).random() < 0.5),
            )  # fmt: skip
            break
        except InputError:
            continue  # too fast for this radius
    wind = rng.uniform(0, 8) * np.array([math.cos(a := rng.uniform(0, 6.28)), math.sin(a), 0.0])
    return LoopSettings(
        autopilot=str(rng.choice(["ardupilot", "px4"])), seed=seed, config=config, seconds=SECONDS + 1,
        action=str(rng.choice(["stand", "walk", "walk", "mixed", "boxing", "kicking", "squats"])),
        walking_m_s=rng.uniform(0.5, 1.4), stature_m=rng.uniform(1.55, 1.95), bearing_deg=rng.uniform(-180, 180),
        distance_m=min(radius + rng.uniform(-0.5, 4.0), 14.0), height_m=rng.uniform(2.0, 5.0),
        wind_m_s=(float(wind[0]), float(wind[1]), 0.0), latency_s=rng.uniform(0.05, 0.15),
        moves_from_s=rng.uniform(4.0, 7.0),
    )  # fmt: skip


def fly(seed: int) -> tuple[LoopSettings, OrbitLoop]:
    """Fly one; the operator starts at ``SETTLE_S`` and tries again whenever it did not go on for ``RETRY_S``."""
    settings = settings_of(seed)
    loop = OrbitLoop(settings)
    loop.down.loss = loop.up.loss = float(np.random.default_rng(seed + 10**6).choice([0.0, 0.0, 0.05]))
    loop.start(SETTLE_S)
    waits_since = [SETTLE_S]

    def operate(loop: OrbitLoop) -> None:
        if loop.controller.safety.state == State.ORBITING:
            waits_since[0] = loop.t
        elif loop.t - waits_since[0] > RETRY_S:
            waits_since[0] = loop.t
            control = loop.copter.mode in ("GUIDED", "OFFBOARD")
            loop.command(Command.START if control else Command.ENGAGE)

    loop.run(SECONDS, operate)
    return settings, loop


def breaches(settings: LoopSettings, loop: OrbitLoop) -> list[str]:
    """Limits that the true vehicle broke after the start.

    Places in the map count with 0.6 m for the errors of the vehicle's own position; the distance from the person,
    which does not depend on it, with nothing.
    """
    config, rows = settings.config, [row for row in loop.rows if row.t_s > SETTLE_S]
    found = []
    nearest = least_distance(loop)
    if nearest < config.min_distance_m:
        found.append(f"distance {nearest:.2f} m")
    heights = [float(row.position[2]) for row in rows]
    if min(heights) < config.min_height_m - 0.6 or max(heights) > config.max_height_m + 0.6:
        found.append(f"height {min(heights):.2f} to {max(heights):.2f} m")
    speed = max(float(np.linalg.norm(row.velocity)) for row in rows)
    if speed > config.speed_margin * config.max_speed_m_s + 0.2:
        found.append(f"speed {speed:.2f} m/s")
    centre = loop.pelvis(SETTLE_S)[:2]
    away = max(float(np.linalg.norm(row.position[:2] - centre)) for row in rows)
    if away > config.fence_radius_m + 0.6:
        found.append(f"fence {away:.2f} m")
    return found


def least_distance(loop: OrbitLoop) -> float:
    """From the person, m: to a vehicle that hovers he may walk as close as he likes, what counts is while it moves."""
    moving = (row.distance_m for row in loop.rows if row.t_s > SETTLE_S and np.linalg.norm(row.velocity) > 0.5)
    return min(moving, default=math.inf)


def outcome(seed: int) -> dict[str, Any]:
    """One orbit, as a line of the results."""
    settings, loop = fly(seed)
    rows = [row for row in loop.rows if row.t_s > SETTLE_S]
    orbiting = [row.state == State.ORBITING for row in rows]
    settled = [row.distance_m - settings.config.radius_m for row in rows if row.t_s > 14.0]
    reasons = [(state, reason) for t, state, reason in loop.reasons if t > SETTLE_S]
    stops = [
        reason.code.name for (before, _), (state, reason) in itertools.pairwise(reasons)
        if before == "ORBITING" and state != "ORBITING"
    ]  # fmt: skip
    refusals = [answer.condition.code.name for _, answer in loop.answers if not answer.accepted]
    whole = all(row.state == State.ORBITING for row in rows if row.t_s > 14.0)
    return {
        "seed": seed, "code": _CODE, "autopilot": settings.autopilot, "action": settings.action,
        "breaches": breaches(settings, loop), "least_distance_m": round(least_distance(loop), 3),
        "orbiting": round(float(np.mean(orbiting)), 3), "flown": any(orbiting), "held": stops[:3],
        "refused": refusals[:1] if not any(orbiting) else [],
        "radius_error_m": round(float(np.mean(np.abs(settled))), 3) if whole else None,
    }  # fmt: skip


def randomized(first: int, count: int, again: bool, seconds: float) -> int:
    """Fly what has not been flown, for so long at most; the table of all of them."""
    done = {} if again else {row["seed"] for row in _read()}
    end_s = time.monotonic() + seconds
    RESULTS.parent.mkdir(exist_ok=True)
    for seed in range(first, first + count):
        if seed in done:
            continue
        if time.monotonic() > end_s:
            print(f"time is up before seed {seed}: run it again to go on")
            break
        row = outcome(seed)
        with RESULTS.open("a") as file:
            file.write(json.dumps(row) + "\n")
        if row["breaches"]:
            print(seed, row["autopilot"], row["action"], "; ".join(row["breaches"]), row["held"], flush=True)
    return table(first, count)


def table(first: int, count: int) -> int:
    """Sum up the results of these seeds."""
    rows = list({row["seed"]: row for row in _read() if first <= row["seed"] < first + count}.values())
    if not rows:
        raise SystemExit("no results yet: fly first")
    bad = [row for row in rows if row["breaches"]]
    flown = [row for row in rows if row["flown"]]
    errors = [row["radius_error_m"] for row in rows if row["radius_error_m"] is not None]
    near = sorted(row["least_distance_m"] for row in flown)
    lines = [
        ["orbits", f"{len(rows)} of {count}, {len({row['code'] for row in rows})} version(s) of the code"],
        ["with a breach", f"{len(bad)} " + "; ".join(f"seed {r['seed']}: {', '.join(r['breaches'])}" for r in bad)],
        ["flown", len(flown)],
        ["orbited without a stop from 14 s to the end", len(errors)],
        ["time in ORBITING after the first start, %", f"{100 * np.mean([row['orbiting'] for row in rows]):.0f}"],
    ]
    if errors:
        lines.append(["radius error of those, m: mean, worst", f"{np.mean(errors):.2f}, {max(errors):.2f}"])
    if near:
        lines.append(["least true distances, m", ", ".join(f"{value:.2f}" for value in near[:3])])
    for title, key in (("held", "held"), ("never flown", "refused")):
        counts = Counter(reason for row in rows for reason in row[key])
        lines += [[f"{title}: {reason}", number] for reason, number in counts.most_common()]
    for line in lines:
        print(*line, sep=": ")
    write_figures("flight_orbits", "Randomized orbits", markdown_table(["what", "count"], lines))
    return 1 if bad else 0


def _read() -> list[dict[str, Any]]:
    return [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []


def quality(first: int, count: int) -> int:
    """Orbit of 6 m at 2 m/s, 8 m/s wind, body height known, from 13 to 31 s: means over seeds, and the worst."""
    missed, lines = 0, []
    for autopilot in ("ardupilot", "px4"):
        for action in ("stand", "walk"):
            rows = np.array([quality_of(autopilot, action, seed) for seed in range(first, first + count)])
            (radius, yaw, middle, orbiting), worst = rows.mean(axis=0), rows.max(axis=0)
            least = rows.min(axis=0)
            lines.append([
                autopilot, action, f"{radius:.2f} ({worst[0]:.2f})", f"{yaw:.2f} ({worst[1]:.2f})",
                f"{100 * middle:.1f} ({100 * least[2]:.1f})", f"{100 * orbiting:.1f} ({100 * least[3]:.0f})",
            ])  # fmt: skip
            print("  ".join(lines[-1]), flush=True)
            missed += radius > 0.3 or yaw > 3.0 or middle < 0.95
    head = ["autopilot", "person", "radius error, m", "yaw error, deg", "in the middle third, %", "orbiting, %"]
    text = (
        f"Orbit of 6 m at 2 m/s in 8 m/s wind, body height known, from 13 to 31 s: mean over {count} seeds (worst"
        " seed). Required: 0.3 m, 3 deg, 95 %.\n\n"
    )
    write_figures("flight_quality", "Quality of the orbit", text + markdown_table(head, lines))
    return 1 if missed else 0


def quality_of(autopilot: str, action: str, seed: int) -> tuple[float, float, float, float]:
    """Radius error m, yaw error deg, share of time in the middle third, share of time orbiting."""
    settings = LoopSettings(autopilot=autopilot, action=action, wind_m_s=(8.0, 0.0, 0.0), seed=seed, seconds=32)
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04))
    loop.start()
    loop.run(31.0)
    result = orbit_quality(loop, 6.0, 13.0)
    return result.radius_error_m, result.yaw_error_deg, result.in_middle_third, result.orbiting


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="randomized", choices=["randomized", "table", "quality"])
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, help="number of seeds: 300, quality 10")
    parser.add_argument("--again", action="store_true", help="fly recorded seeds again")
    parser.add_argument("--seconds", type=float, default=math.inf, help="no new orbit after this time")
    args = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    if args.what == "quality":
        return quality(args.first, args.count or 10)
    if args.what == "table":
        return table(args.first, args.count or 300)
    return randomized(args.first, args.count or 300, args.again, args.seconds)


if __name__ == "__main__":
    raise SystemExit(main())
