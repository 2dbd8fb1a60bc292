"""Defects that the flights under the real autopilots showed, each as a figure: rows of `flight_field.py`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.flight.orbit.states import Action, Command, State
from drocap_ros.simulation.vehicle.loopback import is_setpoint
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

NEEDED_M_S2 = math.radians(19.0) ** 2 * 6.0  # of an orbit of 6 m at 19 deg/s


class DefectRow(NamedTuple):
    """A defect: what was measured, and a function that shows it."""

    autopilot: str
    name: str
    measured: str
    show: Callable[[str], str]


def orbiting(autopilot: str, seconds: float = 60.0, until_s: float = 14.0, **config: Any) -> OrbitLoop:
    """A flight that orbits."""
    loop = OrbitLoop(with_config(LoopSettings(autopilot=autopilot, seed=4, seconds=seconds), **config))
    loop.start()
    loop.run(until_s)
    return loop


def taken_back(autopilot: str) -> str:
    """The downlink is lost; the pilot chooses a mode 1 s later, and again whenever it is gone, for 32 s."""
    shown = []
    for mode in ("LOITER", "RTL", "LAND") if autopilot == "ardupilot" else ("RTL", "POSCTL", "LAND"):
        loop = orbiting(autopilot)
        loop.down.cut = True
        loop.run(15.0)
        loop.copter.set_mode(mode, "pilot")
        taken = 0
        for second in range(16, 48):
            loop.run(float(second))
            if loop.copter.mode != mode:
                taken += 1
                loop.copter.set_mode(mode, "pilot")
        sent = sum(row.action != Action.NOTHING for row in loop.rows if row.t_s > 40.0)
        shown.append(f"{mode} {taken} times, {sent} steps sent after 25 s")
    return "; ".join(shown)


def near_person(autopilot: str) -> str:
    """Ranges swing by 20 %, stamps are 70 ms late, the person nears by 1.4 m/s; least distance while moving."""
    least, top = math.inf, 0.0
    for seed in range(3):
        settings = LoopSettings(autopilot=autopilot, seed=seed, seconds=36.0, action="walk", stamp_late_s=0.07)
        loop = OrbitLoop(settings)
        loop.start()
        loop.run(12.0)

        def swing(seen: Any, loop: OrbitLoop = loop) -> Any:
            middle = np.nanmean(seen.keypoints, axis=0)
            scale = 1 + 0.2 * math.sin(2 * math.pi * loop.t / 3.0)
            return dataclasses.replace(seen, keypoints=((seen.keypoints - middle) * scale + middle).astype(np.float32))

        loop.perceive = swing
        loop.run(32.0)
        for row in loop.rows:
            if row.t_s > 12.0 and np.linalg.norm(row.velocity) > 0.5:
                least = min(least, row.distance_m)
                away = (loop.pelvis(row.t_s) - row.position)[:2]
                top = max(top, float(row.velocity[:2] @ away / np.linalg.norm(away)))
    return f"{least:.2f} m, vehicle's speed towards the person {top:.2f} m/s"


def acceleration(autopilot: str) -> str:
    """Of the setpoints of an orbit against what it needs."""
    loop = orbiting(autopilot, until_s=12.0)
    sizes: list[float] = []
    take = loop.copter.control.take

    def record(target: Any) -> None:
        sizes.append(float(np.linalg.norm(target.acceleration)))
        take(target)

    loop.copter.control.take = record  # type: ignore[method-assign]
    loop.run(30.0)
    return f"mean {np.mean(sizes):.2f}, largest {max(sizes):.2f} m/s^2, needed {NEEDED_M_S2:.2f}"


def dropped(autopilot: str) -> str:
    """Only setpoints are lost on the way: when and how that is noticed."""
    loop = orbiting(autopilot)
    loop.up.drops = is_setpoint
    loop.run(26.0)
    ended = next((row.t_s for row in loop.rows if row.t_s > 14.0 and row.state != State.ORBITING), math.inf)
    reason = loop.controller.safety.condition
    return f"{ended - 14.0:.2f} s: {loop.controller.safety.state.name}, {reason}"


def mount(autopilot: str) -> str:
    """A servo mount: distance that the bridge believes, and the true one."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=30.0, mount="servo"))
    loop.start()
    loop.run(20.0)
    status = loop.status
    assert status is not None
    return f"{status.state.name}, believed {status.radius_m:.2f} m, true {loop.rows[-1].distance_m:.2f} m"


def battery(autopilot: str) -> str:
    """A monitor of the voltage alone."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=16.0))
    loop.copter.battery = -1
    loop.start()
    loop.run(8.0)
    return f"{loop.controller.safety.state.name}: {loop.controller.safety.condition}"


def fence(autopilot: str) -> str:
    """The person walks out of a fence of 10 m."""
    settings = LoopSettings(autopilot=autopilot, seed=4, seconds=50.0, action="walk", moves_from_s=10.0)
    loop = OrbitLoop(with_config(settings, fence_radius_m=10.0))
    loop.start()
    loop.run(48.0)
    centre = loop.pelvis(4.0)[:2]
    rows = [row for row in loop.rows if row.t_s > 5.0]
    away = max(float(np.hypot(*(row.position[:2] - centre))) for row in rows)
    top = max(float(np.linalg.norm(row.velocity)) for row in rows)
    return f"{away:.2f} m, {top:.2f} m/s"


def no_mount(autopilot: str) -> str:
    """Requests for a gimbal's attitude on a vehicle without a mount."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=70.0, mount="fixed"))
    asked: list[float] = []
    answer = loop.copter._set_interval

    def count(number: int, interval_us: float) -> int:
        if number == 285:
            asked.append(loop.t)
        return answer(number, interval_us)

    loop.copter._set_interval = count  # type: ignore[method-assign]
    loop.run(60.0)
    return f"{len(asked)} requests in 60 s"


def again(autopilot: str) -> str:
    """The stream is lost for 2 s; then the operator commands `engage`."""
    loop = orbiting(autopilot)
    loop.up.drops = is_setpoint
    loop.run(16.0)
    loop.up.drops = lambda packet: False
    loop.run(22.0)
    for _ in range(3):
        loop.command(Command.ENGAGE)
        loop.run(loop.t + 3.0)
        if loop.controller.safety.state == State.ORBITING:
            break
    safety = loop.controller.safety
    return f"{safety.state.name}: {safety.condition}"


def restored(autopilot: str) -> str:
    """SIGSTOP for 3 s: what the process does when it continues."""
    loop = orbiting(autopilot)
    loop.stopped = True
    loop.run(17.0)
    loop.stopped = False
    loop.run(24.0)
    later = [f"{mode} ({by})" for t, mode, by in loop.copter.mode_log if t > 14.0]
    return f"{'; '.join(later) or 'no change'}: {loop.controller.safety.state.name}"


def seen(autopilot: str) -> str:
    """From the pilot's mode to the bridge's silence."""
    times = []
    for k in range(5):
        loop = orbiting(autopilot, until_s=14.0 + 0.23 * k)
        begin_s = loop.t
        loop.copter.set_mode("POSCTL" if autopilot == "px4" else "LOITER", "pilot")
        loop.run(begin_s + 3.0)
        sent = [row.t_s for row in loop.rows if row.t_s > begin_s and row.action != Action.NOTHING]
        times.append(max(sent, default=begin_s) - begin_s)
    return f"{max(times):.2f} s at most of 5"


def answers(autopilot: str) -> str:
    """OFFBOARD is denied: what the operator reads."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=20.0))
    loop.copter.denied_modes = frozenset({"OFFBOARD"})
    loop.start()
    loop.run(12.0)
    assert loop.status is not None
    last = [str(answer.condition) for _, answer in loop.answers][-1:]
    return f"{loop.status.reason}; {last}"


def loss_action(autopilot: str) -> str:
    """COM_OBL_RC_ACT 0, PX4's default."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=12.0))
    loop.copter.settings["COM_OBL_RC_ACT"] = 0
    loop.start()
    loop.run(9.0)
    return f"{loop.controller.safety.state.name}: {loop.controller.safety.condition}"


def bad_data(autopilot: str) -> str:
    """Bad packets of a healthy link."""
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=30.0))
    loop.run(25.0)
    return f"{loop.link.status().bad_count / 25.0:.2f} a second"


DEFECTS = (
    DefectRow("ardupilot", "1 control taken back, downlink lost", "18 times in 32 s", taken_back),
    DefectRow("ardupilot", "2 near the person: wrong range, late stamps", "0.46 m, 4.1 m/s", near_person),
    DefectRow("ardupilot", "3 acceleration of the setpoints", "mean 1.57, often 2.0; needed 0.66", acceleration),
    DefectRow("ardupilot", "4 setpoints dropped: noticed", "never", dropped),
    DefectRow("ardupilot", "5 servo mount", "4.8 for 6.3 m", mount),
    DefectRow("ardupilot", "7 battery monitor of the voltage alone", "refused, no remedy", battery),
    DefectRow("ardupilot", "9 fence of 10 m", "10.6 m, 4.8 m/s", fence),
    DefectRow("ardupilot", "10 no mount: asked for a gimbal's attitude", "for ever", no_mount),
    DefectRow("px4", "1 control taken back, downlink lost", "again and again", taken_back),
    DefectRow("px4", "2 engage after a loss of OFFBOARD", "fails, 4 of 4", again),
    DefectRow("px4", "2 a process that continues after 3 s", "restores OFFBOARD", restored),
    DefectRow("px4", "3 a take-over is seen", "0.9 s", seen),
    DefectRow("px4", "4 setpoints dropped: noticed", "called the pilot's", dropped),
    DefectRow("px4", "5 OFFBOARD denied", "the first answer is kept", answers),
    DefectRow("px4", "6 COM_OBL_RC_ACT 0", "no warning", loss_action),
    DefectRow("px4", "8 bad MAVLink data", "2 a second", bad_data),
    DefectRow("px4", "near the person: wrong range, late stamps", "-", near_person),
    DefectRow("px4", "acceleration of the setpoints", "-", acceleration),
)
