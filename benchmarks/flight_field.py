"""Every row of the flights under the real autopilots, flown again: `python benchmarks/flight_field.py [WORDS]`.

ArduPilot Copter and PX4 were flown in their own simulators; what was measured there stands beside what the closed loop
shows now.  Orbits of 6 m at 19 deg/s, faults 14 s after the start of the flight.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from figures import table, write_figures
from flight_field_defects import DEFECTS

from drocap_ros.flight.orbit.states import Command, State
from lab.flights.branches import over_processes
from lab.flights.fault_injections import assign, begins, drop_setpoints, freeze, gust, perceived, pilot
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, orbit_quality, with_config

FAULT_S, WATCH_S = 14.0, 7.0
MOVING_M_S = 0.05
Inject = Callable[[OrbitLoop], None]


class OrbitRow(NamedTuple):
    """An orbit: what was measured, radius, yaw and middle third."""

    autopilot: str
    name: str
    measured: str
    action: str = "stand"
    wind_m_s: float = 0.0
    mount: str = "gimbal"


class FaultRow(NamedTuple):
    """A fault: what was measured, its injection, and a second one so many seconds later."""

    autopilot: str
    name: str
    measured: str
    inject: Inject
    later: tuple[float, Inject] | None = None
    timeout_s: float = 0.5


def _jump(loop: OrbitLoop) -> None:
    loop.future_joints()[:, :, 0] += 3.0


def _stop(loop: OrbitLoop) -> None:
    loop.command(Command.STOP)


_NOTHING, _DEAD = assign(perceive=lambda seen: None), assign(stopped=True)
ORBITS = (
    OrbitRow("ardupilot", "standing, calm, camera fixed", "0.19 (1.17); 0.9 (4.6); 72", mount="fixed"),
    OrbitRow("ardupilot", "standing, 8 m/s, level gimbal", "0.16 (0.55); 1.6 (5.8); 100", wind_m_s=8.0),
    OrbitRow("ardupilot", "walking, calm, camera fixed", "0.29 (0.80); 1.0 (3.3); 64", "walk", mount="fixed"),
    OrbitRow("ardupilot", "walking, 8 m/s, level gimbal", "0.88 (3.58); 2.1 (7.5); 100", "walk", 8.0),
    OrbitRow("ardupilot", "walking, 8 m/s, camera fixed", "holds after 0.4 to 7 s", "walk", 8.0, "fixed"),
    OrbitRow("px4", "standing, calm", "0.45, 0.68 (1.65); 1.2; 85 to 88"),
    OrbitRow("px4", "walking, calm", "0.60 (1.78); 1.4; 57", "walk"),
)
FAULTS = (
    FaultRow("ardupilot", "operator stop", "0.0; 1.8 to 2.1", _stop),
    FaultRow("ardupilot", "perception stops", "0.27; 2.4", _NOTHING),
    FaultRow("ardupilot", "frozen picture", "0.30; 1.9", freeze),
    FaultRow("ardupilot", "nobody", "0.29; 2.9", perceived(lambda seen: {"track_id": 0})),
    FaultRow("ardupilot", "subject jumps 3 m", "0.33; 3.0", _jump),
    FaultRow("ardupilot", "telemetry cut", "0.14; 2.1", assign("down", cut=True)),
    FaultRow("ardupilot", "uplink cut", "0.39; 2.2", assign("up", cut=True)),
    FaultRow("ardupilot", "both ways cut", "0.15; 2.7", assign("link", cut=True)),
    FaultRow("ardupilot", "SIGKILL", "0; 1.8 to 5.7", _DEAD),
    FaultRow("ardupilot", "SIGKILL, GUID_TIMEOUT 0.3", "0; 1.7 to 3.4", _DEAD, timeout_s=0.3),
    FaultRow("ardupilot", "SIGSTOP for 3 s", "0; 1.9", _DEAD, (3.0, assign(stopped=False))),
    FaultRow("ardupilot", "GPS lost", "0.40; 4.3", begins("gps_lost_s")),
    FaultRow("ardupilot", "gust of 12 m/s", "0.74; 7.6", gust),
    FaultRow("ardupilot", "setpoints alone dropped", "never; 2.5", drop_setpoints),
    FaultRow("px4", "operator stop", "0.0; 1.0 to 1.3", _stop),
    FaultRow("px4", "perception stops", "0.34; 1.8", _NOTHING),
    FaultRow("px4", "SIGKILL", "0; 2.8 to 3.0", _DEAD),
    FaultRow("px4", "uplink cut", "0.4; 2.6", assign("up", cut=True)),
    FaultRow("px4", "setpoints alone dropped", "0.9; 2.9 to 3.1", drop_setpoints),
    FaultRow("px4", "SIGSTOP for 3 s", "0; 3.4, 4.4", _DEAD, (3.0, assign(stopped=False))),
    FaultRow("px4", "pilot's LOITER", "0.9; 1.8", pilot("LOITER")),
    FaultRow("px4", "pilot's RTL", "0.9; -", pilot("RTL")),
    FaultRow("px4", "pilot's POSCTL", "0.9; 2.0", pilot("POSCTL")),
)


def fly_orbit(row: OrbitRow, seed: int) -> str:
    """Radius error, mean (worst), m; yaw error, deg; share in the middle third and orbiting, %."""
    settings = LoopSettings(
        autopilot=row.autopilot, action=row.action, wind_m_s=(row.wind_m_s, 0.0, 0.0), mount=row.mount, seed=seed,
        seconds=46.0,
    )  # fmt: skip
    # The person is measured before the flight, as `drocap preflight` asks.
    loop = OrbitLoop(with_config(settings, gimbal_control=row.mount != "fixed", body_height_m=settings.stature_m))
    loop.start()
    loop.run(45.0)
    quality = orbit_quality(loop, 6.0, 13.0)
    rows = [r for r in loop.rows if r.t_s >= 13.0]
    worst = max(abs(r.distance_m - 6.0) for r in rows), max(abs(r.yaw_error_deg) for r in rows)
    flown = [r for r in loop.rows if r.state == State.ORBITING]
    held = "" if loop.rows[-1].state == State.ORBITING else f", {loop.rows[-1].state.name}: {loop.reasons[-1][2]}"
    if not flown:
        return f"not flown{held}"
    return (
        f"{quality.radius_error_m:.2f} ({worst[0]:.2f}); {quality.yaw_error_deg:.1f} ({worst[1]:.1f});"
        f" {100 * quality.in_middle_third:.0f}; orbiting {100 * quality.orbiting:.0f} %{held}"
    )


def fly_fault(row: FaultRow, seed: int) -> str:
    """Last moving setpoint, s; farthest from there, m; what the bridge says at the end."""
    settings = LoopSettings(
        autopilot=row.autopilot, seed=seed, seconds=FAULT_S + WATCH_S + 5.0, timeout_s=row.timeout_s
    )
    loop = OrbitLoop(settings)
    loop.start()
    loop.run(FAULT_S)
    if loop.controller.safety.state != State.ORBITING:
        return f"not orbiting before: {loop.controller.safety.reason}"
    place, first = loop.copter.body.position.copy(), len(loop.rows)
    sent: list[tuple[float, Any]] = []

    def watch(loop: OrbitLoop) -> None:
        sent.extend(loop.link.sent_setpoints()[-1:])

    row.inject(loop)
    if row.later is not None:
        loop.run(FAULT_S + row.later[0], watch)
        row.later[1](loop)
    loop.run(FAULT_S + WATCH_S, watch)
    rows = loop.rows[first:]
    moving = [t for t, setpoint in sent if math.hypot(setpoint.vx, setpoint.vy) > MOVING_M_S]
    last_s = max([t - FAULT_S for t in moving if t > FAULT_S], default=0.0)
    moved = max(float(np.hypot(*(r.position - place)[:2])) for r in rows if r.t_s < FAULT_S + 5.0)
    top = max(float(np.linalg.norm(r.velocity)) for r in rows)
    code = loop.controller.safety.condition.code.name
    state = "-" if loop.stopped else f"{loop.controller.safety.state.name} {code}"
    return f"{last_s:.2f}; {moved:.2f}; top {top:.2f} m/s; {loop.copter.mode}; {state}"


ROWS: tuple[Any, ...] = (*ORBITS, *FAULTS, *DEFECTS)


def cells(job: tuple[int, int]) -> list[str]:
    """A row of the page by its number; the flights of all seeds."""
    row, seeds = ROWS[job[0]], job[1]
    begin_s = time.process_time()
    if isinstance(row, OrbitRow):
        results = [fly_orbit(row, 2 + i) for i in range(seeds)]
    elif isinstance(row, FaultRow):
        results = [fly_fault(row, 4 + i) for i in range(seeds)]
    else:
        results = [row.show(row.autopilot)]
    kind = {OrbitRow: "orbit", FaultRow: "fault"}.get(type(row), "defect")
    found = [kind, row.autopilot, row.name, row.measured, " / ".join(results)]
    print("  ".join(found), f"({time.process_time() - begin_s:.0f} s)", flush=True)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only rows whose names hold one of these")
    parser.add_argument("--seeds", type=int, default=3, help="flights of each orbit and fault")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    args = parser.parse_args()
    chosen = [i for i, row in enumerate(ROWS) if not args.words or any(word in row.name for word in args.words)]
    found = list(over_processes(cells, [(i, args.seeds) for i in chosen], args.jobs))
    text = (
        "Orbits: radius error in m, mean (worst); yaw error in deg; share of the time in the middle third in %. Faults:"
        " last moving setpoint in s after it; farthest in m within 5 s.  Real: measured with the real autopilots in"
        " their own simulators, before this work.\n\n"
    )
    head = ["", "autopilot", "case", "real", "in the closed loop, each seed"]
    write_figures("flight_field", "The flights under the real autopilots, again", text + table(head, found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
