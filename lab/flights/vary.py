"""Flights whose world, configuration, reports, pilot and person are drawn, and what must hold in every one.

    python -m lab.flights.vary --flights 200 [--seed 0] [--processes 2]
    python -m lab.flights.vary --hours 8 --seed 1

A draw leaves most of its values as they are in a good flight.  One that breaks what must hold is made smaller: values
return to those of a good flight for as long as the same requirement stays broken.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import math
import random
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.parser import CurrentMode
from drocap_ros.flight.orbit.states import Action, Command, State
from drocap_ros.simulation.vehicle.flight_control import Manner, Target, manner_of
from drocap_ros.simulation.vehicle.loopback import is_setpoint
from lab.flights.branches import over_processes
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

START_S, SECONDS = 4.0, 20.0
_CHANGED = 0.12  # share of the values that a draw changes
_NEVER = math.inf


#: Of each value: in a good flight, and its range, or what it may be else.  Times are in s of the flight.
#:
#: pilot_m_s, pilot_deg : by which the pilot flies until control is granted; 0 deg = towards the person
#: grant_s : from the request of control to the mode
#: takes_s, gives_s : when the pilot takes over, and for how long
#: mode_s, attitude_s, position_s, mount_s, status_s : least time between two messages of a kind
#: person_m_s, person_deg, until_s : how the person moves, and until when; 0 deg = at the vehicle, all the time
#: flips_s : period of a pilot's switch between his mode and control, from 8 s on
#: blind_s, stop_s : when the pictures end, and when the operator stops
#: jump_m, clock_drift : of the reported position at 9 s, to the person; of the autopilot's clock, a share
#: load : as of :class:`LoopSettings`
#: again : whether the operator starts again what has ended
VALUES: dict[str, tuple[Any, ...]] = {
    "seed": (0, [0]), "autopilot": ("ardupilot", ["px4"]),
    "wind_m_s": (0.0, 0.0, 10.0), "bearing_deg": (0.0, -180.0, 180.0), "distance_m": (7.0, 2.0, 25.0),
    "start_height_m": (3.0, 1.7, 6.0), "mount": ("gimbal", ["servo", "fixed"]), "field_deg": (60.0, 50.0, 100.0),
    "stature_m": (1.75, 0.9, 2.0), "fence_radius_m": (40.0, 8.0, 20.0), "radius_m": (6.0, 3.8, 10.0),
    "height_m": (2.5, 1.8, 5.0), "angular_speed_deg_s": (19.0, -25.0, 25.0), "body_height_m": (1.7, 1.2, 2.1),
    "size_error": (0.08, 0.04, 0.12), "use_ground_plane": (True, [False]), "timeout_s": (0.5, 0.3, 0.5),
    "control_hz": (20.0, 10.0, 40.0), "height_error_m": (0.0, -5.0, 5.0),
    "estimate_error": (1.0, 0.0, 5.0), "attitude_error_deg": (0.4, 0.0, 3.0), "yaw_error_deg": (0.0, 0.0, 30.0),
    "down_delay_s": (0.01, 0.0, 0.35), "up_delay_s": (0.01, 0.0, 0.35), "jitter_s": (0.0, 0.0, 0.1),
    "loss": (0.0, 0.0, 0.3), "gaps_hz": (0.0, 0.0, 2.0), "mode_s": (0.0, 0.05, 5.0), "attitude_s": (0.0, 0.02, 0.2),
    "position_s": (0.0, 0.03, 0.2), "mount_s": (0.0, 0.05, 0.3), "status_s": (0.0, 0.2, 1.5),
    "perception_hz": (15.0, 5.0, 30.0), "latency_s": (0.1, 0.03, 0.5), "late_share": (0.0, 0.0, 0.5),
    "stamp_late_s": (0.0, -0.1, 0.35), "clock_step_s": (0.0, -3.0, 3.0), "pilot_m_s": (0.0, 0.5, 5.0),
    "pilot_deg": (0.0, -180.0, 180.0), "grant_s": (0.0, 0.0, 5.0), "takes_s": (_NEVER, 4.1, 14.0),
    "gives_s": (_NEVER, 0.1, 4.0), "person_m_s": (0.0, 0.3, 5.0), "person_deg": (180.0, -180.0, 180.0),
    "until_s": (_NEVER, 8.0, 16.0), "blind_s": (_NEVER, 6.0, 16.0), "stop_s": (_NEVER, 4.0, 16.0),
    "adjust_m": (0.0, 3.5, 12.0), "again": (False, [True]), "late_s": (0.3, 0.1, 1.5), "duplicate": (0.0, 0.0, 0.3),
    "clock_drift": (0.0, -0.03, 0.03), "jump_m": (0.0, -5.0, 5.0), "flips_s": (_NEVER, 0.3, 2.0),
    "action": ("stand", ["squats", "boxing", "kicking"]), "load": (0.0, 0.0, 20.0), "gyro_error": (1.0, 0.0, 5.0),
    "height_drift_m_s": (0.0, -0.5, 0.5), "gimbal_control": (False, [True]), "max_coast_m": (3.0, 1.0, 5.0),
}  # fmt: skip


class Draw(dict[str, Any]):
    """The values of a flight that a good one does not have; each of ``VALUES`` is an attribute."""

    def __getattr__(self, name: str) -> Any:
        if name not in VALUES:
            raise AttributeError(name)
        return self.get(name, VALUES[name][0])

    def __str__(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.items())


def draw(seed: int, number: int) -> Draw:
    """The draw of this number."""
    chance = random.Random(f"{seed}:{number}")
    drawn = Draw(seed=number)
    for name, (_, *among) in list(VALUES.items())[1:]:
        if chance.random() < (0.5 if name == "autopilot" else _CHANGED):
            drawn[name] = chance.choice(among[0]) if len(among) == 1 else round(chance.uniform(*among), 3)
    if "person_m_s" in drawn and chance.random() < 0.3:
        drawn["person_deg"] = 0.0
    return drawn


#: What must hold: the greatest value of each, m, m/s or s.  Only the vehicle's own motion counts, under our setpoints.
LIMITS = {
    "m of descent below 1.2 m": 0.15,
    "m flown to the person within min_distance_m": 0.3,
    "m/s to the person": 1.3,
    "m outside of the fence": 2.0,
    "m/s": 4.5 * 1.3 + 0.3,
    "s of motion after stop or blindness": 0.5,
    "s sent without permission": 0.0,
    "s until the pilot's mode was changed": 0.0,
}
_DESCENT, _NEARER, _CLOSING, _FENCE, _SPEED, _HELD, _SENT, _PILOT = LIMITS
_LEFT_M_S2, _LEFT_S = 1.0, 1.0  # by which what the pilot flew decays at least after his hand-over, and from when on
_ARM_M = 1.5  # at which one stops who runs up to the vehicle
_MORE_M_S = 0.3  # that a vehicle flies on faster than at its hand-over
_BEGINS = (Command.START, Command.ENGAGE)


class Watch:
    """Compares a flight with its truth, step by step.

    found : worst value and time of each requirement that was broken
    """

    def __init__(self, loop: OrbitLoop, drawn: Draw) -> None:
        self.loop, self.drawn = loop, drawn
        self.found: dict[str, tuple[float, float]] = {}
        self._begun_s = self._before_s = -_NEVER  # last command to begin, and the one before
        self._ended_s = self._pilot_s = _NEVER  # since when nothing may move; last choice of the pilot
        self._ours_s, self._inherited = _NEVER, (0.0, 0.0, 0.0)  # since when the mode is ours; what was flown then
        self._near_m, self._centre, self._modes = 0.0, loop.pelvis()[:2], 1
        self._apart_m = _NEVER
        self._write, loop.up.write = loop.up.write, self._sent  # type: ignore[method-assign]

    def command(self, kind: Command, **values: float) -> None:
        """Send a command of the operator."""
        if kind in _BEGINS:
            self._before_s, self._begun_s = self._begun_s, self.loop.t
        self.loop.command(kind, **values)

    def step(self) -> None:
        """Take what is true now, before a step of the control loop."""
        self._hear()
        loop, copter = self.loop, self.loop.copter
        body, t, ours = copter.body, loop.t, copter.mode == copter.kind.control_mode and self._begun_s > -_NEVER
        sight = loop.pelvis()[:2] - body.position[:2]
        toward = sight / max(float(np.hypot(*sight)), 1e-6)
        flown = float(np.linalg.norm(body.velocity)), float(body.velocity[:2] @ toward), float(body.position[2])
        if not ours:
            self._ours_s, self._inherited, self._near_m = _NEVER, flown, 0.0
            return
        self._ours_s = min(self._ours_s, t)
        left = _LEFT_M_S2 * max(t - self._ours_s - _LEFT_S, 0.0)
        own = [
            now if now > before - left + _MORE_M_S else 0.0
            for now, before in zip(flown[:2], self._inherited, strict=False)
        ]
        fled = [loop.pelvis(max(t - ago, 0.0))[:2] @ toward for ago in (0.0, 0.25, 0.5, 0.75, 1.0)]
        self._note(_SPEED, own[0])
        self._note(_CLOSING, own[1] - 4.0 * max(0.0, *(a - b for a, b in itertools.pairwise(fled))))
        # By a height whose error grows the autopilot sinks in every hold, its own too: then the orbit alone counts.
        if not self.drawn.height_drift_m_s or (loop.rows and loop.rows[-1].action == Action.ORBIT):
            self._note(_DESCENT, min(1.2, self._inherited[2]) - flown[2])
        # One who runs past a vehicle that gives way has its last metre behind him: he is farther with every step.
        before_m, self._apart_m = self._apart_m, float(np.hypot(*sight))
        if self._apart_m < min(loop.settings.config.min_distance_m, before_m):
            self._near_m += max(own[1], 0.0) / loop.settings.config.control_hz
            self._note(_NEARER, self._near_m)
        away = body.position[:2] - self._centre
        if float(body.velocity[:2] @ away) > 0.2 * float(np.hypot(*away)):
            self._note(_FENCE, float(np.hypot(*away)) - loop.settings.config.fence_radius_m)
        self._note(_HELD, copter.motion_until_s - self._ended_s - self._late_s(up=True))

    def _hear(self) -> None:
        """Commands that were answered, and modes that were entered."""
        loop = self.loop
        for command, answer in loop.status.answers if loop.status else ():
            if command.kind in _BEGINS and not answer.accepted:
                self._begun_s = self._before_s
            elif command.kind in _BEGINS:
                self._ended_s, self._centre = _NEVER, loop.pelvis()[:2]
            elif command.kind == Command.STOP and answer.accepted:
                self._ended_s = min(self._ended_s, loop.t)
        if loop.t > self.drawn.blind_s + self.drawn.latency_s + (0.3 if self.drawn.late_share else 0.0):
            self._ended_s = min(self._ended_s, loop.t)
        for at_s, mode, by in loop.copter.mode_log[self._modes :]:
            if by == "pilot":
                self._pilot_s = _NEVER if mode == loop.copter.kind.control_mode else at_s
            elif by == "command" and self._begun_s < self._pilot_s < _NEVER:
                self._note(_PILOT, late_s := at_s - self._pilot_s - self._late_s(up=True))
                # A choice that the bridge could not know when it asked for the mode is overridden, and never heard of.
                self._pilot_s = _NEVER if late_s <= 0.0 else self._pilot_s
        self._modes = len(loop.copter.mode_log)

    def _late_s(self, *, up: bool = False) -> float:
        """How late the bridge hears at worst, and its answer is heard."""
        d = self.drawn
        lost = 1.0 if d.loss else 0.0
        late = (d.down_delay_s, d.mode_s, d.jitter_s, 0.3 * bool(d.gaps_hz), d.up_delay_s * up)
        return lost + math.fsum(late)

    def _note(self, kind: str, value: float) -> None:
        if value > max(LIMITS[kind], self.found.get(kind, (-_NEVER, 0.0))[0]):
            self.found[kind] = value, self.loop.t

    def _sent(self, data: bytes) -> None:
        command = int.from_bytes(data[7:10], "little") == mavlink.MAVLINK_MSG_ID_COMMAND_LONG
        mode = command and data[38:40] == mavlink.MAV_CMD_DO_SET_MODE.to_bytes(2, "little")
        if mode or is_setpoint(data):
            since_s = self._pilot_s + self._late_s() + 0.3 if self._begun_s < self._pilot_s else _NEVER
            self._note(_SENT, self.loop.t - (since_s if self._begun_s > -_NEVER else 0.0))
        self._write(data)


_KINDS = {
    "mode_s": ("HEARTBEAT", "CURRENT_MODE"), "attitude_s": ("ATTITUDE_QUATERNION", "ATTITUDE"),
    "position_s": ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"), "mount_s": ("GIMBAL_DEVICE_ATTITUDE_STATUS",),
    "status_s": ("SYS_STATUS", "EXTENDED_SYS_STATE", "GPS_RAW_INT", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS"),
}  # fmt: skip


def _slow(loop: OrbitLoop, drawn: Draw) -> Callable[[bytes], bool]:
    """Drops packets that follow one of their kind sooner than drawn."""
    numbers = vars(mavlink) | {"MAVLINK_MSG_ID_CURRENT_MODE": CurrentMode.id}
    least = {numbers[f"MAVLINK_MSG_ID_{name}"]: getattr(drawn, kind) for kind in _KINDS for name in _KINDS[kind]}
    passed: dict[int, float] = {}

    def drops(packet: bytes) -> bool:
        number = int.from_bytes(packet[7:10], "little")
        if loop.t - passed.get(number, -_NEVER) < least.get(number, 0.0) - 1e-6:
            return True
        passed[number] = loop.t
        return False

    return drops


def settings_of(drawn: Draw) -> LoopSettings:
    """Settings of a drawn flight."""
    flight, config = (
        {name: getattr(drawn, name) for name in names} for names in (
            ("autopilot", "seed", "bearing_deg", "distance_m", "mount", "field_deg", "stature_m", "timeout_s",
             "perception_hz", "latency_s", "late_share", "stamp_late_s", "gaps_hz", "estimate_error",
             "attitude_error_deg", "yaw_error_deg", "gyro_error", "late_s", "action", "load"),
            ("radius_m", "height_m", "angular_speed_deg_s", "body_height_m", "size_error", "use_ground_plane",
             "control_hz", "gimbal_control", "max_coast_m"),
        )
    )  # fmt: skip
    wind = drawn.wind_m_s * math.cos(drawn.seed), drawn.wind_m_s * math.sin(drawn.seed), 0.0
    mode = "LOITER" if drawn.grant_s or drawn.pilot_m_s else ""
    settings = LoopSettings(wind_m_s=wind, height_m=drawn.start_height_m, seconds=SECONDS, start_mode=mode, **flight)
    return with_config(settings, fence_radius_m=max(drawn.fence_radius_m, drawn.radius_m + 1.5), **config)


class _Flight:
    """A drawn flight with its pilot, person and operator."""

    def __init__(self, drawn: Draw) -> None:
        self.loop, self.drawn = loop, d = OrbitLoop(settings_of(drawn)), drawn
        self.watch = Watch(loop, drawn)
        loop.down.delay_s, loop.up.delay_s, loop.down.jitter_s = d.down_delay_s, d.up_delay_s, d.jitter_s
        loop.down.loss = loop.up.loss = d.loss
        loop.down.duplicate = loop.up.duplicate = d.duplicate
        loop.down.drops = _slow(loop, d)
        copter = loop.copter
        copter.gps_error = copter.gps_error + np.array([0.0, 0.0, d.height_error_m])
        clock_s = copter.clock_s
        copter.clock_s = lambda t_s: clock_s((1.0 + d.clock_drift) * t_s)  # type: ignore[method-assign]
        copter.control.begin(manner_of(copter.kind, copter.mode), copter.estimate, np.zeros(3), copter.body.yaw)
        self._enter = copter.set_mode
        copter.set_mode = self._set_mode  # type: ignore[method-assign]
        command, takes_s = self.watch.command, d.takes_s
        self._plan: list[tuple[float, Callable[[], object]]] = [
            (START_S - 2.0, self._steer), (START_S, self._start),
            (takes_s, partial(copter.set_mode, copter.simulated.stick_mode, "pilot")),
            (takes_s + d.gives_s, partial(copter.set_mode, copter.kind.control_mode, "pilot")),
            (d.stop_s, partial(command, Command.STOP)),
            (12.0 if d.adjust_m else _NEVER, partial(command, Command.ADJUST, radius_m=d.adjust_m)),
            (d.blind_s, partial(setattr, loop, "perceive", lambda seen: None)),
            (10.0, partial(setattr, loop, "clock_jump_s", d.clock_step_s)), (9.0, partial(self._err, d.jump_m, 0.0)),
        ]  # fmt: skip
        for i in range(math.ceil(8.0 / d.flips_s)):
            mode = copter.kind.control_mode if i % 2 else copter.simulated.stick_mode
            self._plan.append((8.0 + i * d.flips_s, partial(copter.set_mode, mode, "pilot")))
        self._heading: np.ndarray | None = None
        self._waits_s, self._granted_s = START_S, _NEVER

    def step(self, loop: OrbitLoop) -> None:
        """One step of the control loop."""
        for planned in [planned for planned in self._plan if planned[0] <= loop.t]:
            self._plan.remove(planned)
            planned[1]()
        if self._granted_s <= loop.t:
            self._granted_s = _NEVER
            self._enter(loop.copter.kind.control_mode, "command")
        self._walk()
        if self.drawn.height_drift_m_s and loop.t > START_S + 2.0:
            self._err(0.0, self.drawn.height_drift_m_s / loop.settings.config.control_hz)
        if loop.controller.safety.state == State.ORBITING or not self.drawn.again:
            self._waits_s = loop.t
        elif loop.t - self._waits_s > 3.0:
            self._waits_s = loop.t
            self._start()
        self.watch.step()

    def _set_mode(self, mode: str, by: str) -> None:
        """A requested mode is accepted at once and entered later, unless the pilot chooses another one meanwhile."""
        if by == "command" and mode == self.loop.copter.kind.control_mode and self.drawn.grant_s:
            self._granted_s = min(self._granted_s, self.loop.t + self.drawn.grant_s)
            return
        self._granted_s = _NEVER
        self._enter(mode, by)

    def _err(self, toward_m: float, up_m: float) -> None:
        """The reported position moves, to the person and up."""
        copter = self.loop.copter
        copter.gps_error = copter.gps_error + np.array([*toward_m * self._towards(-1.0, 0.0), up_m])

    def _start(self) -> None:
        control = self.loop.copter.mode == self.loop.copter.kind.control_mode
        self.watch.command(Command.START if control else Command.ENGAGE)

    def _steer(self) -> None:
        """The pilot flies on."""
        copter, d = self.loop.copter, self.drawn
        if d.pilot_m_s:
            velocity = d.pilot_m_s * self._towards(-1.0, d.pilot_deg)
            copter.control.begin(Manner.STICK, copter.estimate, copter.body.velocity, copter.body.yaw)
            copter.control.target = Target(velocity=np.append(velocity, 0.0), yaw=copter.body.yaw)

    def _walk(self) -> None:
        loop, d = self.loop, self.drawn
        arrived = d.person_deg == 0.0 and loop.rows and loop.rows[-1].distance_m < _ARM_M
        if d.person_m_s and START_S + 3.0 <= loop.t < d.until_s and not arrived:
            if self._heading is None or d.person_deg == 0.0:
                self._heading = self._towards(1.0, d.person_deg)
            loop.future_joints()[..., :2] += d.person_m_s * self._heading / loop.settings.config.control_hz

    def _towards(self, sign: float, turned_deg: float) -> np.ndarray:
        """(2,) direction from the person to the vehicle, or back, turned."""
        sight = complex(*sign * (self.loop.copter.body.position - self.loop.pelvis())[:2])
        way = sight / max(abs(sight), 1e-6) * np.exp(1j * math.radians(turned_deg))
        return np.array([way.real, way.imag])


def fly(drawn: Draw) -> Watch:
    """One flight, and what it broke."""
    flight = _Flight(drawn)
    flight.loop.run(SECONDS - 1.0, flight.step)
    return flight.watch


def smaller(drawn: Draw, kind: str) -> Draw:
    """The draw without the values that this requirement's break does not need."""
    for name in tuple(drawn):
        less = Draw({other: value for other, value in drawn.items() if other != name})
        if name != "seed" and kind in fly(less).found:
            drawn = less
    return drawn


def _flown(drawn: Draw) -> tuple[Draw, dict[str, tuple[float, float]], float]:
    """A draw, what it broke, and how long it orbited, s."""
    watch = fly(drawn)
    orbited = sum(row.state == State.ORBITING for row in watch.loop.rows) / watch.loop.settings.config.control_hz
    return drawn, watch.found, orbited


def main() -> int:
    """Fly; status 1 where something was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=2000, help="at most")
    parser.add_argument("--hours", type=float, default=_NEVER, help="of this machine's time, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--as-drawn", action="store_true", help="do not make the broken ones smaller")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    begun_s, flights, broken, orbited_s, last = time.monotonic(), 0, 0, 0.0, args.first + args.flights
    for first in range(args.first, last, size := 8 * args.processes):
        jobs = [draw(args.seed, number) for number in range(first, min(first + size, last))]
        for drawn, found, seconds in over_processes(_flown, jobs, args.processes):
            flights, broken, orbited_s = flights + 1, broken + bool(found), orbited_s + seconds
            for kind, (worst, at_s) in found.items():
                least = drawn if args.as_drawn else smaller(drawn, kind)
                print(f"{worst:.2f} {kind}, at {at_s:.1f} s: {least}", flush=True)
        if time.monotonic() - begun_s > 3600 * args.hours:
            break
    print(f"{flights} flights, {orbited_s / 60:.0f} min of orbit, {broken} broke something")
    return 1 if broken else 0


if __name__ == "__main__":
    raise SystemExit(main())
