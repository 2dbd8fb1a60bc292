"""Randomized orbits in closed loop, no breach allowed: `python benchmarks/flight_orbits.py [COUNT] [FIRST_SEED]`."""

from __future__ import annotations

import math
import sys

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.config import MavlinkBridgeConfig
from drocap_ros.simulation.orbit_loop import LoopSettings, OrbitLoop, orbit_quality

SECONDS = 24.0
SETTLE_S = 4.0


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
    settings = settings_of(seed)
    loop = OrbitLoop(settings)
    loop.down.loss = loop.up.loss = float(np.random.default_rng(seed + 10**6).choice([0.0, 0.0, 0.05]))
    loop.start(SETTLE_S)
    loop.run(SECONDS)
    return settings, loop


def breaches(settings: LoopSettings, loop: OrbitLoop) -> list[str]:
    """Limits that the true vehicle broke after the start, with 0.6 m for the errors of its own position."""
    config, rows = settings.config, [row for row in loop.rows if row.t_s > SETTLE_S]
    found = []
    # To a vehicle that hovers a person may walk as close as he likes: what counts is while it moves.
    nearest = min((row.distance_m for row in rows if np.linalg.norm(row.velocity) > 0.5), default=math.inf)
    if nearest < config.min_distance_m - 0.6:
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


def main() -> int:
    sys.stdout.reconfigure(line_buffering=True)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    bad, going, errors = 0, 0, []
    for seed in range(first, first + count):
        settings, loop = fly(seed)
        found = breaches(settings, loop)
        bad += bool(found)
        quality = orbit_quality(loop, settings.config.radius_m, 14.0)
        if quality.orbiting == 1.0:
            going += 1
            errors.append(quality.radius_error_m)
        if found or seed % 10 == 0:
            end = loop.reasons[-1][2] if loop.reasons else ""
            print(seed, settings.autopilot, settings.action, "; ".join(found) or "no breach", "|", end, flush=True)
    mean = float(np.mean(errors)) if errors else math.nan
    print(f"{count} orbits: {bad} with a breach; {going} went on to the end, mean radius error {mean:.2f} m")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
