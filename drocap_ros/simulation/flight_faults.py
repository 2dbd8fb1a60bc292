"""Faults in flight, one at a time, in the closed loop: how soon commanded motion ends, and how far the vehicle goes."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.safety import Action, Command, State
from drocap_ros.perception.observation import PoseObservation
from drocap_ros.simulation.orbit_loop import LoopSettings, OrbitLoop, with_config

FAULT_S = 14.0
_WATCH_S = 7.0
_FRAME_S = 0.17  # the next picture and its way: then a fault of perception can be seen
_HEARTBEAT_S = 0.21  # mode and status come five times a second


class FaultResult(NamedTuple):
    """What a fault did.

    motion_s : how long after the fault became observable setpoints still moved the vehicle; < 0 = sooner
    excursion_m : horizontal, from where it was when the fault became observable
    least_distance_m : to the person, from the fault on
    resumed : whether motion was commanded again without the operator
    """

    motion_s: float
    excursion_m: float
    least_distance_m: float
    resumed: bool
    state: State
    reason: str


@dataclass(frozen=True)
class Fault:
    """One case.

    inject : makes the fault
    observable_s : when it can be seen at the earliest, after it was made
    harmless : the orbit may go on
    cause : why a bound does not hold, where it cannot
    before : called at the start of the flight
    """

    name: str
    inject: Callable[[OrbitLoop], None]
    observable_s: float = 0.0
    harmless: bool = False
    cause: str = ""
    change: Callable[[LoopSettings], LoopSettings] = lambda settings: settings
    later: tuple[tuple[float, Callable[[OrbitLoop], None]], ...] = ()


def fly_fault(fault: Fault, autopilot: str, seed: int = 4) -> FaultResult:
    """Orbit, make the fault at ``FAULT_S``, watch."""
    settings = LoopSettings(autopilot=autopilot, seed=seed, seconds=FAULT_S + _WATCH_S + 1.0)
    loop = OrbitLoop(fault.change(settings))
    loop.start()
    loop.run(FAULT_S)
    if loop.controller.safety.state != State.ORBITING:
        raise AssertionError(f"{fault.name}: not orbiting before the fault: {loop.controller.safety.reason}")
    fault.inject(loop)
    loop.run(FAULT_S + fault.observable_s)
    place, observed_s, first = loop.copter.body.position.copy(), loop.t, len(loop.rows)
    for after_s, action in fault.later:
        loop.run(FAULT_S + after_s)
        action(loop)
    loop.run(FAULT_S + _WATCH_S)
    rows = loop.rows[first:]
    away = [float(np.linalg.norm(row.position[:2] - place[:2])) for row in rows]
    actions = [row.action for row in rows]
    ended = next((i for i, a in enumerate(actions) if a != Action.ORBIT), len(actions))
    return FaultResult(
        loop.copter.motion_until_s - observed_s, max(away), min(row.distance_m for row in rows),
        Action.ORBIT in actions[ended:], loop.controller.safety.state, loop.controller.safety.reason,
    )  # fmt: skip


def passes(fault: Fault, result: FaultResult) -> bool:
    """Whether the bounds of the protocol hold: 0.5 s, 2.5 m, no motion again by itself."""
    if fault.harmless:
        return result.least_distance_m > 3.0
    return result.motion_s <= 0.5 and result.excursion_m < 2.5 and not result.resumed


def _perceive(change: Callable[[PoseObservation], PoseObservation | None]) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        loop.perceive = change

    return inject


def _shifted(seen: PoseObservation, pixels: float, track_id: int = 1) -> PoseObservation:
    return dataclasses.replace(seen, keypoints=seen.keypoints + np.array([pixels, 0], np.float32), track_id=track_id)


def _freeze(loop: OrbitLoop) -> None:
    kept: list[PoseObservation] = []

    def change(seen: PoseObservation) -> PoseObservation:
        kept.append(seen)
        return dataclasses.replace(kept[0], stamp_ns=seen.stamp_ns)

    loop.perceive = change


def _half(loop: OrbitLoop) -> None:
    chance = random.Random(1)
    loop.perceive = lambda seen: seen if chance.random() < 0.5 else None


def _set(**values: Any) -> Callable[[OrbitLoop], None]:
    """Set attributes by their path: ``copter_battery=5`` sets ``loop.copter.battery``."""

    def inject(loop: OrbitLoop) -> None:
        for name, value in values.items():
            owner, _, attribute = name.partition("__")
            if attribute:
                setattr(getattr(loop, owner), attribute, value)
            else:
                setattr(loop, owner, value)

    return inject


def _both(**values: Any) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        for channel in (loop.down, loop.up):
            for name, value in values.items():
                setattr(channel, name, value)

    return inject


def _mode(mode: str, px4: str = "") -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        loop.copter.set_mode(px4 if px4 and loop.settings.autopilot == "px4" else mode, "pilot")

    return inject


def _at(name: str) -> Callable[[OrbitLoop], None]:
    def inject(loop: OrbitLoop) -> None:
        setattr(loop.copter, name, loop.t)

    return inject


def _restart(loop: OrbitLoop) -> None:
    loop.stopped = False
    loop.restart()


def _storm(loop: OrbitLoop) -> None:
    chance = random.Random(7)
    for _ in range(500):
        loop.command(chance.choice(list(Command)), radius_m=chance.uniform(-50, 50), height_m=chance.uniform(-5, 50))


def _foreign(loop: OrbitLoop) -> None:
    """Another vehicle on the same link says that it is in LAND, disarmed, elsewhere."""
    other = mavlink.MAVLink(None, srcSystem=42, srcComponent=1)
    for i in range(400):
        packets = other.heartbeat_encode(2, 3, 1, 9, 4), other.local_position_ned_encode(i, 500, 0, 0, 0, 0, 0)
        for packet in packets:
            loop.down.write(packet.pack(other))


def _walk_into(loop: OrbitLoop) -> None:
    """The person walks straight to where the vehicle is."""
    here = loop.copter.body.position[:2]
    first = int(loop.t * loop.settings.perception_hz)
    way = here - loop._joints[first, 0, :2]
    length = float(np.hypot(*way))
    steps = np.arange(len(loop._joints) - first) / loop.settings.perception_hz * 1.4
    loop._joints[first:, :, :2] += (np.minimum(steps, length)[:, None] * way / length)[:, None]


def _walk_away(loop: OrbitLoop) -> None:
    first = int(loop.t * loop.settings.perception_hz)
    steps = np.arange(len(loop._joints) - first) / loop.settings.perception_hz * 1.4
    loop._joints[first:, :, 0] += steps[:, None]


def _deny_hold(loop: OrbitLoop) -> None:
    loop.copter.denied_modes = frozenset({"BRAKE", "LOITER"})
    loop.perceive = lambda seen: None


_GUID = "nothing of ours runs: the autopilot's own time-out ends it, GUID_TIMEOUT 0.5 s, COM_OF_LOSS_T 1 s"

_SILENCE = "silence counts after 0.3 s, 0.6 m at 2 m/s; then the stop of 1.5 m, and the position's own drift"

FAULTS: tuple[Fault, ...] = (
    Fault("perception stops", _perceive(lambda seen: None), _FRAME_S),
    Fault("perception says there is nobody", _perceive(lambda s: dataclasses.replace(s, track_id=0)), _FRAME_S),
    Fault("keypoints jump by 400 px", _perceive(lambda s: _shifted(s, 400)), _FRAME_S),
    Fault(
        "keypoints are NaN", _perceive(lambda s: dataclasses.replace(s, keypoints=s.keypoints * np.float32(np.nan))),
        _FRAME_S,
    ),
    Fault("picture freezes, stamps go on", _freeze, _FRAME_S),
    Fault("another person, by its track", _perceive(lambda s: _shifted(s, 150, 2)), _FRAME_S),
    Fault("another person 2 m aside, same track", _perceive(lambda s: _shifted(s, 370)), _FRAME_S),
    Fault(
        "perception 1 s late", _perceive(lambda s: dataclasses.replace(s, stamp_ns=s.stamp_ns - 10**9)), _FRAME_S
    ),
    Fault(
        "stamps 5 s in the future", _perceive(lambda s: dataclasses.replace(s, stamp_ns=s.stamp_ns + 5 * 10**9)),
        _FRAME_S,
    ),
    Fault("every other picture lost", _half, harmless=True),
    Fault("process killed", _set(stopped=True), cause=_GUID),
    Fault("process stopped for 3 s (SIGSTOP)", _set(stopped=True), cause=_GUID, later=((3.0, _set(stopped=False)),)),
    Fault("process restarts after 1 s", _set(stopped=True), cause=_GUID, later=((1.0, _restart),)),
    Fault("control loop hangs", _set(hung=True)),
    Fault("control loop hangs for 1 s", _set(hung=True), later=((1.0, _set(hung=False)),)),
    Fault("link lost", _both(cut=True), 0.05, cause=_GUID),
    Fault("link lost for 2 s", _both(cut=True), 0.05, cause=_GUID, later=((2.0, _both(cut=False)),)),
    Fault("downlink lost", _set(down__cut=True), 0.05, cause=_SILENCE),
    Fault("uplink lost", _set(up__cut=True), 0.05, cause=_GUID),
    Fault("link delayed by 1 s", _both(delay_s=1.0), 0.05, cause="the hold itself arrives a second late"),
    Fault("30 % loss", _both(loss=0.3), harmless=True),
    Fault("every packet twice", _both(duplicate=1.0), harmless=True),
    Fault("packets out of order", _both(jitter_s=0.08), harmless=True),
    Fault("a foreign system on the link", _foreign, harmless=True),
    Fault("GPS lost", _at("gps_lost_s"), 0.4 + _HEARTBEAT_S),
    Fault("estimator fails", _at("ekf_failed_s"), _HEARTBEAT_S),
    Fault("battery at 10 %", _set(copter__battery=10), _HEARTBEAT_S),
    Fault("battery unknown", _set(copter__battery=-1), _HEARTBEAT_S),
    Fault("pilot takes LOITER (POSCTL)", _mode("LOITER", "POSCTL"), _HEARTBEAT_S),
    Fault("pilot takes ALT_HOLD (ALTCTL)", _mode("ALT_HOLD", "ALTCTL"), _HEARTBEAT_S),
    Fault("pilot takes LAND", _mode("LAND"), _HEARTBEAT_S),
    Fault("pilot takes RTL", _mode("RTL"), _HEARTBEAT_S),
    Fault(
        "pilot takes over during a hold", _perceive(lambda seen: None), _FRAME_S,
        later=((0.8, _mode("LOITER", "POSCTL")),), cause="the pilot's mode stops the vehicle in its own way",
    ),
    Fault(
        "pilot takes over and gives back", _mode("LOITER", "POSCTL"), _HEARTBEAT_S,
        later=((2.0, _mode("GUIDED", "OFFBOARD")),), cause="",
    ),
    Fault("clock jumps 3 s ahead", _set(clock_jump_s=3.0), 0.05),
    Fault("clock jumps 3 s back", _set(clock_jump_s=-3.0), 0.05),
    Fault("telemetry frozen, clock goes on", _set(copter__frozen=True), 0.05, cause=_SILENCE),
    Fault(
        "telemetry frozen with its clock", _set(copter__frozen=True, copter__frozen_clock=True), 0.05, cause=_SILENCE
    ),
    Fault("autopilot follows no more, says nothing", _set(copter__deaf=True), 0.2, cause=_GUID),
    Fault("storm of 500 commands", _storm),
    Fault("landing reported", _set(copter__landed_state=mavlink.MAV_LANDED_STATE_LANDING), _HEARTBEAT_S),
    Fault("subject walks towards the vehicle", _walk_into, harmless=True),
    Fault(
        "subject leaves the fence", _walk_away, harmless=True,
        change=lambda settings: with_config(settings, fence_radius_m=9.0),
    ),
    Fault("hold mode denied", _deny_hold, _FRAME_S),
)  # fmt: skip
