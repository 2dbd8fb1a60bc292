"""Orbits in closed loop: randomized ones, which must keep every limit, and the quality of the protocol's orbit.

    python benchmarks/flight_orbits.py [--jobs 2]           the 1000 randomized orbits, those not flown yet
    python benchmarks/flight_orbits.py --first 100 --count 50
    python benchmarks/flight_orbits.py table                summary of the orbits flown
    python benchmarks/flight_orbits.py quality              errors of radius, yaw and framing
    python benchmarks/flight_orbits.py busy                 orbits of 60 s on a busy machine: late pictures, gaps

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
from perception_errors import PerceptionErrors

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.states import Command, State
from lab.flights.branches import over_processes
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, orbit_quality, with_config

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
    errors = PerceptionErrors.drawn(seed)
    settings = settings_of(seed)
    loop = OrbitLoop(errors.settings(settings))
    loop.down.loss = loop.up.loss = float(np.random.default_rng(seed + 10**6).choice([0.0, 0.0, 0.05]))
    loop.start(SETTLE_S)
    errors.disturb(loop)
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


def closing_speeds(loop: OrbitLoop) -> tuple[float, float, float]:
    """Highest speeds (m/s): the vehicle's towards the person, what of it does not follow one who walks away, and the
    loss of distance, the person's own approach included.
    """
    rows = [row for row in loop.rows if row.t_s > SETTLE_S]
    parts = np.zeros((len(rows) + 1, 3))
    for part, row in zip(parts[1:], rows, strict=True):
        away = (loop.pelvis(row.t_s) - row.position)[:2]
        toward = away / max(float(np.hypot(*away)), 1e-3)
        walked = (loop.pelvis(row.t_s + 0.25) - loop.pelvis(row.t_s - 0.25))[:2] / 0.5
        own, receding = float(row.velocity[:2] @ toward), float(walked @ toward)
        part[:] = own, own - max(receding, 0.0), own - receding
    own_m_s, beyond_m_s, loss_m_s = parts.max(axis=0)
    return float(own_m_s), float(beyond_m_s), float(loss_m_s)


def breaches(settings: LoopSettings, loop: OrbitLoop) -> list[str]:
    """Limits that the true vehicle broke from its first orbit on: before, its autopilot holds it without the bridge.

    Places in the map count with 0.6 m for the errors of the vehicle's own position; the distance from the person,
    which does not depend on it, with nothing.
    """
    config, found = settings.config, []
    rows = list(itertools.dropwhile(lambda row: row.state != State.ORBITING, loop.rows))
    if not rows:
        return found
    nearest = least_distance(loop)
    if nearest < config.min_distance_m:
        found.append(f"distance {nearest:.2f} m")
    flown = loop.settings.config  # heights count from the ground that the bridge is configured with
    heights = [float(row.position[2]) - flown.ground_height_m for row in rows]
    if min(heights) < flown.min_height_m - 0.6 or max(heights) > flown.max_height_m + 0.6:
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
    hovers = itertools.takewhile(lambda row: row.state != State.ORBITING, loop.rows)
    settled = [row.distance_m - settings.config.radius_m for row in rows if row.t_s > 14.0]
    reasons = [(state, reason) for t, state, reason in loop.reasons if t > SETTLE_S]
    stops = [
        reason.code.name for (before, _), (state, reason) in itertools.pairwise(reasons)
        if before == "ORBITING" and state != "ORBITING"
    ]  # fmt: skip
    refusals = [answer.condition.code.name for _, answer in loop.answers if not answer.accepted]
    own, beyond, loss = closing_speeds(loop)
    whole = all(row.state == State.ORBITING for row in rows if row.t_s > 14.0)
    return {
        "seed": seed, "code": _CODE, "autopilot": settings.autopilot, "action": settings.action,
        "breaches": breaches(settings, loop), "hover_m": round(min(float(row.position[2]) for row in hovers), 2),
        "least_distance_m": round(least_distance(loop), 3),
        "closing_m_s": round(own, 2), "beyond_m_s": round(beyond, 2), "loss_m_s": round(loss, 2),
        "perception": PerceptionErrors.drawn(seed).kind,
        "orbiting": round(float(np.mean(orbiting)), 3), "flown": any(orbiting), "held": stops[:3],
        "refused": refusals[:1] if not any(orbiting) else [],
        "radius_error_m": round(float(np.mean(np.abs(settled))), 3) if whole else None,
    }  # fmt: skip


def randomized(first: int, count: int, again: bool, seconds: float, jobs: int) -> int:
    """Fly what has not been flown, for so long at most; the table of all of them."""
    done = {} if again else {row["seed"] for row in _read()}
    end_s = time.monotonic() + seconds
    RESULTS.parent.mkdir(exist_ok=True)
    waiting = [seed for seed in range(first, first + count) if seed not in done]
    for row in over_processes(outcome, waiting, jobs):
        seed = row["seed"]
        if time.monotonic() > end_s:
            print(f"time is up after seed {seed}: run it again to go on")
            break
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
    hovers = sorted((row["hover_m"], f"{row['autopilot']}, seed {row['seed']}") for row in rows)
    lowest = "; ".join(f"{height_m:.2f} ({which})" for height_m, which in hovers[:3])
    lines = [
        ["orbits", f"{len(rows)} of {count}, {len({row['code'] for row in rows})} version(s) of the code"],
        ["with a breach", f"{len(bad)} " + "; ".join(f"seed {r['seed']}: {', '.join(r['breaches'])}" for r in bad)],
        ["least heights before the first orbit, held by the autopilot alone, m", lowest],
        ["flown", len(flown)],
        ["orbited without a stop from 14 s to the end", len(errors)],
        ["time in ORBITING after the first start, %", f"{100 * np.mean([row['orbiting'] for row in rows]):.0f}"],
    ]
    if errors:
        lines.append(["radius error of those, m: mean, worst", f"{np.mean(errors):.2f}, {max(errors):.2f}"])
    if near:
        lines.append(["least true distances, m", ", ".join(f"{value:.2f}" for value in near[:3])])
    for title, key in (
        ("highest own speeds towards the person, m/s", "closing_m_s"),
        ("of it beyond following one who walks away, m/s", "beyond_m_s"),
        ("highest loss of distance, his own approach included, m/s", "loss_m_s"),
    ):
        highest = sorted((row[key] for row in flown), reverse=True)
        lines.append([title, ", ".join(f"{value:.2f}" for value in highest[:3])])
    for kind in sorted({row["perception"] for row in rows}):
        part = [row for row in rows if row["perception"] == kind]
        least = min((row["least_distance_m"] for row in part if row["flown"]), default=math.inf)
        bad_here = sum(bool(row["breaches"]) for row in part)
        lines.append([f"{kind}: orbits, breaches, least distance m", f"{len(part)}, {bad_here}, {least:.2f}"])
    for title, key in (("held", "held"), ("never flown", "refused")):
        counts = Counter(reason for row in rows for reason in row[key])
        lines += [[f"{title}: {reason}", number] for reason, number in counts.most_common()]
    for line in lines:
        print(*line, sep=": ")
    write_figures("flight_orbits", "Randomized orbits", markdown_table(["what", "count"], lines))
    return 1 if bad else 0


def _read() -> list[dict[str, Any]]:
    return [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []


QUALITY = tuple(itertools.product(("ardupilot", "px4"), ("stand", "walk"), (0.0, 8.0), ("gimbal", "fixed")))
QUALITY_S, RAMPED_S = 60.0, 13.0


def quality(first: int, count: int) -> int:
    """Orbits of 6 m, 19 deg/s wanted, body height known, 60 s from the start: means over seeds, and the worst."""
    missed, lines = 0, []
    for flight in QUALITY:
        rows = np.array([quality_of(*flight, seed) for seed in range(first, first + count)])
        (radius, yaw, middle, orbiting, ratio, omega), worst = rows.mean(axis=0), rows.max(axis=0)
        least = rows.min(axis=0)
        lines.append([
            *flight[:2], f"{flight[2]:g}", flight[3], f"{radius:.2f} ({worst[0]:.2f})", f"{yaw:.2f} ({worst[1]:.2f})",
            f"{100 * middle:.1f} ({100 * least[2]:.1f})", f"{100 * orbiting:.1f} ({100 * least[3]:.0f})",
            f"{ratio:.2f} ({worst[4]:.2f})", f"{omega:.1f}",
        ])  # fmt: skip
        print("  ".join(lines[-1]), flush=True)
        # Written so that a flight without an orbit, whose errors are NaN, misses.
        missed += not (radius <= 0.3 and yaw <= 3.0 and middle >= 0.9 and orbiting >= 0.9 and ratio <= 1.3)
    head = [
        "autopilot", "person", "wind, m/s", "camera", "radius error, m", "yaw error, deg", "in the middle third, %",
        "orbiting, %", "acceleration ratio", "deg/s",
    ]  # fmt: skip
    text = (
        f"Orbit of 6 m, 19 deg/s wanted, body height known, {QUALITY_S:g} s: mean over {count} seeds (worst seed)."
        f" Errors from {RAMPED_S:g} s on while it orbits. Required: 0.3 m, 3 deg, 90 %, 90 %, 1.3. The acceleration"
        " ratio is the mean acceleration of the setpoints over what the flown orbit needs: omega^2 R and the"
        " acceleration of a walking person, both over a second.\n\n"
    )
    write_figures("flight_quality", "Quality of the orbit", text + markdown_table(head, lines))
    return 1 if missed else 0


def quality_of(
    autopilot: str, action: str, wind: float, mount: str, seed: int
) -> tuple[float, float, float, float, float, float]:
    """Radius error m, yaw error deg, shares of time in the middle third and orbiting, acceleration ratio, deg/s."""
    settings = LoopSettings(
        autopilot=autopilot, action=action, wind_m_s=(wind, 0.0, 0.0), seed=seed, mount=mount,
        seconds=QUALITY_S + SETTLE_S + 1,
    )  # fmt: skip
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04))
    loop.start(SETTLE_S)
    asked: list[tuple[float, float]] = []
    loop.run(
        SETTLE_S + QUALITY_S,
        lambda flown: asked.append((flown.t, float(np.linalg.norm(flown.copter.target.acceleration[:2])))),
    )
    result = orbit_quality(loop, 6.0, RAMPED_S)
    rows = [row for row in loop.rows if row.t_s >= RAMPED_S and row.state == State.ORBITING]
    if len(rows) < 100:
        return math.nan, math.nan, result.in_middle_third, result.orbiting, math.nan, 0.0
    needed, omega = needed_acceleration(
        np.array([row.t_s for row in rows]), np.array([row.position[:2] for row in rows]),
        np.array([loop.pelvis(row.t_s)[:2] for row in rows]),
    )  # fmt: skip
    flown = {row.t_s for row in rows}
    ratio = float(np.mean([size for t, size in asked if t in flown])) / needed
    errors = np.array([(abs(row.distance_m - 6.0), abs(row.yaw_error_deg)) for row in rows]).mean(axis=0)
    return float(errors[0]), float(errors[1]), result.in_middle_third, result.orbiting, ratio, omega


def needed_acceleration(times: np.ndarray, vehicle: np.ndarray, person: np.ndarray) -> tuple[float, float]:
    """Mean of omega^2 R and the person's acceleration over a second, m/s^2, and mean angular speed, deg/s.

    times : (N,) s;  vehicle, person : (N, 2) m
    """
    width = round(1.0 / float(np.median(np.diff(times))))

    def smooth(values: np.ndarray) -> np.ndarray:
        return np.stack([np.convolve(column, np.ones(width) / width, "valid") for column in values.T], axis=1)

    seconds = smooth(times[:, None])[:, 0]
    offset = vehicle - person
    phase = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
    omega = np.gradient(smooth(phase[:, None])[:, 0], seconds)
    radius = smooth(np.hypot(*offset.T)[:, None])[:, 0]
    velocity = np.gradient(smooth(person), seconds, axis=0)
    walking = np.linalg.norm(np.gradient(smooth(velocity), smooth(seconds[:, None])[:, 0], axis=0), axis=1)
    return float(np.mean(omega**2 * radius) + np.mean(walking)), math.degrees(float(np.mean(np.abs(omega))))


def busy(first: int, count: int, jobs: int) -> int:
    """Orbits of 60 s with late pictures and gaps of telemetry, by mount, person and wind: share of time orbiting."""
    flights = [(*flight, seed) for flight in QUALITY for seed in range(first, first + count)]
    lines, missed = [], 0
    for orbiting, line in over_processes(busy_orbit, flights, jobs):
        lines.append(line)
        missed += orbiting < 0.9
        print(*line, sep="; ")
    head = [
        "autopilot", "person", "wind, m/s", "camera", "seed", "orbiting, %", "radius error, m", "yaw error, deg",
        "ended or refused",
    ]  # fmt: skip
    text = (
        "Orbit of 6 m, 19 deg/s wanted, body height known, 60 s: one picture in twenty up to 0.3 s late, pauses of the"
        " telemetry as on a busy machine. Errors from 6 s on, whether or not it orbits. Required: 90 % of the time.\n\n"
    )
    write_figures("flight_busy", "Orbits on a busy machine", text + markdown_table(head, lines))
    return 1 if missed else 0


def busy_orbit(flight: tuple[str, str, float, str, int]) -> tuple[float, list[Any]]:
    """Share of time orbiting of one of them, and its line of the table."""
    autopilot, action, wind, mount, seed = flight
    settings = LoopSettings(
        autopilot=autopilot, mount=mount, action=action, wind_m_s=(wind, 0.0, 0.0), seed=seed, seconds=65,
        late_share=0.05, gaps_hz=0.5,
    )  # fmt: skip
    rates = {"attitude_hz": 50.0, "position_hz": 20.0}  # that arrived on real links
    loop = OrbitLoop(with_config(settings, body_height_m=settings.stature_m, size_error=0.04, **rates))
    loop.start()
    loop.run(64.0)
    quality = orbit_quality(loop, 6.0, 6.0)
    reasons = [str(reason) for _, state, reason in loop.reasons if state in ("HOLDING", "TAKEN_OVER", "FAULT")]
    reasons += [str(answer.condition) for _, answer in loop.answers if not answer.accepted]
    return quality.orbiting, [
        autopilot, action, f"{wind:g}", mount, seed, f"{100 * quality.orbiting:.0f}", f"{quality.radius_error_m:.2f}",
        f"{quality.yaw_error_deg:.1f}", next(iter(reasons), ""),
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="randomized", choices=["randomized", "table", "quality", "busy"])
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, help="number of seeds: 1000, quality 1")
    parser.add_argument("--again", action="store_true", help="fly recorded seeds again")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--seconds", type=float, default=math.inf, help="no new orbit after this time")
    args = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    if args.what == "quality":
        return quality(args.first, args.count or 1)
    if args.what == "busy":
        return busy(args.first, args.count or 1, args.jobs)
    if args.what == "table":
        return table(args.first, args.count or 1000)
    return randomized(args.first, args.count or 1000, args.again, args.seconds, args.jobs)


if __name__ == "__main__":
    raise SystemExit(main())
