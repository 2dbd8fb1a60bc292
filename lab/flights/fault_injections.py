"""Injections of faults into a simulated flight, changes of its settings, and additional requirements."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.orbit.states import Action, Command, OperatorCommand, State
from drocap_ros.keypoints import PoseObservation
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport, is_setpoint
from lab.flights.fault_flight import FAULT_S, Injection
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config


def assign(owner: str = "", **values: Any) -> Injection:
    """Set attributes of the loop, or of its part ``owner``: "copter", "down", "up", or "link" for both directions."""

    def inject(loop: OrbitLoop) -> None:
        parts = [loop.down, loop.up] if owner == "link" else [getattr(loop, owner) if owner else loop]
        for part in parts:
            for name, value in values.items():
                setattr(part, name, value)

    return inject


def perceived(fields: Callable[[PoseObservation], dict[str, Any]]) -> Injection:
    """Replace fields of each observation."""
    return assign(perceive=lambda seen: dataclasses.replace(seen, **fields(seen)))


def shifted(seen: PoseObservation, pixels: float) -> np.ndarray:
    """(15, 2) px, the keypoints moved to the right."""
    return seen.keypoints + np.array([pixels, 0], np.float32)


def freeze(loop: OrbitLoop) -> None:
    """The first observation repeats, with the present stamps."""
    kept: list[PoseObservation] = []

    def change(seen: PoseObservation) -> PoseObservation:
        kept.append(seen)
        return dataclasses.replace(kept[0], stamp_ns=seen.stamp_ns)

    loop.perceive = change


def lose_half(loop: OrbitLoop) -> None:
    """Every other observation is lost, at random."""
    chance = random.Random(1)
    loop.perceive = lambda seen: seen if chance.random() < 0.5 else None


def restart(loop: OrbitLoop) -> None:
    """A new process of the bridge."""
    loop.stopped = False
    loop.restart()


def foreign_system(loop: OrbitLoop) -> None:
    """Packets of another vehicle: disarmed, in LAND, far away."""
    other = mavlink.MAVLink(None, srcSystem=42, srcComponent=1)
    for i in range(400):
        packets = other.heartbeat_encode(2, 3, 1, 9, 4), other.local_position_ned_encode(i, 500, 0, 0, 0, 0, 0)
        for packet in packets:
            loop.down.write(packet.pack(other))


def second_vehicle(loop: OrbitLoop) -> None:
    """Another vehicle with the same system and component is heard: in control mode, 6 m beyond the person."""
    sight = (loop.pelvis() - loop.copter.body.position)[:2]
    place = np.append(loop.pelvis()[:2] + 6.0 * sight / np.hypot(*sight), loop.copter.body.position[2])
    deaf = LoopbackTransport(Channel(lambda: loop.t), loop.down)
    other = SimulatedCopter(deaf, place, 0.0, CopterSetup(loop.settings.autopilot, seed=99, mode=loop.copter.mode))
    other.armed, other._period_s = True, dict(loop.copter._period_s)
    fly = loop.copter.fly

    def both_fly(t_s: float) -> None:
        fly(t_s)
        other.fly(t_s)

    loop.copter.fly = both_fly  # type: ignore[method-assign]


def answer_time_sync(loop: OrbitLoop) -> None:
    """A companion computer of the same vehicle answers TIMESYNC, too, by its own clock and without delay."""
    companion = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER2)
    parser = mavlink.MAVLink(None)

    def heard(packet: bytes) -> bool:
        for message in parser.parse_buffer(packet) or ():
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                delay_s, loop.down.delay_s = loop.down.delay_s, 0.01
                loop.down.write(companion.timesync_encode(loop.clock_ns(), message.ts1).pack(companion))
                loop.down.delay_s = delay_s
        return False

    loop.up.drops = heard


def begins(name: str) -> Injection:
    """A failure of the copter that begins now."""
    return lambda loop: setattr(loop.copter, name, loop.t)


def restart_clock(loop: OrbitLoop) -> None:
    """The autopilot's clock goes back by 25 s."""
    loop.copter.boot_s -= 25.0


def jump(loop: OrbitLoop) -> None:
    """A GPS glitch of 15 m that the autopilot accepts."""
    loop.copter.gps_error = loop.copter.gps_error + np.array([12.0, -9.0, 0.0])


def reset_position(nearer_m: float) -> Injection:
    """The autopilot's estimate is reset: a place that was latched before now lies nearer to the person by this."""

    def inject(loop: OrbitLoop) -> None:
        sight = (loop.pelvis() - loop.copter.body.position)[:2]
        loop.copter.gps_error = loop.copter.gps_error - np.append(nearer_m * sight / np.hypot(*sight), 0.0)

    return inject


def pilot(ardupilot: str, px4: str = "") -> Injection:
    """The pilot switches the mode; its name for ArduPilot, and for PX4 where that differs."""

    def inject(loop: OrbitLoop) -> None:
        loop.copter.set_mode(px4 if px4 and loop.settings.autopilot == "px4" else ardupilot, "pilot")

    return inject


def command(kind: Command) -> Injection:
    """A command of the operator."""
    return lambda loop: loop.command(kind)


def storm(loop: OrbitLoop) -> None:
    """500 commands at random."""
    chance = random.Random(7)
    for _ in range(500):
        loop.command(chance.choice(list(Command)), radius_m=chance.uniform(-50, 50), height_m=chance.uniform(-5, 50))


def old_commands(loop: OrbitLoop) -> None:
    """Commands with stamps 3 to 200 s in the past, as from a replayed recording."""
    for age_s in range(3, 200):
        stamp_ns = loop.clock_ns() - age_s * 10**9
        for kind in (Command.START, Command.ENGAGE, Command.ADJUST):
            loop.controller.command(OperatorCommand(int(kind), 9.0, 3.0, -19.0, stamp_ns))


def invalid_commands(loop: OrbitLoop) -> None:
    """Unknown numbers, values out of range."""
    for number in (-1, 4, 77, 255):
        for value in (float("nan"), float("inf"), -1e30, 0.0):
            loop.controller.command(OperatorCommand(number, value, value, value))
    for value in (-5.0, 0.0, 1e30, float("inf")):
        loop.controller.command(OperatorCommand(int(Command.ADJUST), radius_m=value))


def walk_to_vehicle(loop: OrbitLoop) -> None:
    """The person walks to the place of the vehicle."""
    joints = loop.future_joints()
    way = loop.copter.body.position[:2] - joints[0, 0, :2]
    length = float(np.hypot(*way))
    joints[:, :, :2] += (np.minimum(steps_m(loop), length)[:, None] * way / length)[:, None]


def walk_east(loop: OrbitLoop, way_m: float = 40.0) -> None:
    """The person walks away, so far."""
    loop.future_joints()[:, :, 0] += np.minimum(steps_m(loop), way_m)[:, None]


def steps_m(loop: OrbitLoop) -> np.ndarray:
    """Distance walked at each future frame, at 1.4 m/s."""
    return np.arange(len(loop.future_joints())) / loop.settings.perception_hz * 1.4


def stick_mode(settings: LoopSettings) -> LoopSettings:
    """The pilot holds the height by the sticks."""
    return dataclasses.replace(settings, start_mode="ALTCTL" if settings.autopilot == "px4" else "ALT_HOLD")


def short_timeouts(settings: LoopSettings) -> LoopSettings:
    """Time-outs of 0.3 s."""
    return dataclasses.replace(settings, timeout_s=0.3)


def shipped_timeouts(settings: LoopSettings) -> LoopSettings:
    """Time-outs as the autopilots ship: a flight only with the operator's permission."""
    settings = with_config(settings, max_control_timeout_s=0.0)
    return dataclasses.replace(settings, timeout_s=autopilot_of(settings.autopilot).shipped_timeout_s)


def same_radius(loop: OrbitLoop) -> str:
    """The radius is the configured one."""
    assert loop.status is not None
    radius_m = loop.status.radius_m - loop.status.radius_error_m
    return "" if abs(radius_m - loop.settings.config.radius_m) < 1e-6 else f"the radius became {radius_m:g} m"


def inside_fence(loop: OrbitLoop) -> str:
    """The vehicle stayed within the fence."""
    centre = loop.pelvis(FAULT_S - 4.0)[:2]
    farthest = max(float(np.linalg.norm(row.position[:2] - centre)) for row in loop.rows)
    limit = loop.settings.config.fence_radius_m
    # The bridge keeps the fence by its estimates, and about the estimated position of the subject.
    return "" if farthest < limit + 1.0 else f"{farthest:.1f} m from the start of the orbit, fence {limit:g} m"


def no_orbit(loop: OrbitLoop) -> str:
    """No orbit was commanded after the fault."""
    orbiting = any(row.action == Action.ORBIT for row in loop.rows if row.t_s > FAULT_S)
    return "the orbit was commanded after the fault" if orbiting else ""


def orbits_again(loop: OrbitLoop) -> str:
    """Where the orbit has stopped, the operator starts it again, and it is flown within 3 s."""
    if loop.controller.safety.state != State.ORBITING:
        loop.command(Command.START if loop.copter.mode in ("GUIDED", "OFFBOARD") else Command.ENGAGE)
        loop.run(loop.t + 3.0)
    safety = loop.controller.safety
    return "" if safety.state == State.ORBITING else f"no orbit can be started: {safety.condition}"


def scaled(factor: float) -> Injection:
    """The person appears larger by this factor: nearer, or taller than configured."""

    def change(seen: PoseObservation) -> dict[str, Any]:
        middle = np.nanmean(seen.keypoints, axis=0)
        return {"keypoints": ((seen.keypoints - middle) * factor + middle).astype(np.float32)}

    return perceived(change)


def swinging(loop: OrbitLoop) -> None:
    """The apparent size swings by 20 % in three seconds."""

    def change(seen: PoseObservation) -> PoseObservation:
        middle = np.nanmean(seen.keypoints, axis=0)
        factor = 1 + 0.2 * np.sin(2 * np.pi * loop.t / 3.0)
        return dataclasses.replace(seen, keypoints=((seen.keypoints - middle) * factor + middle).astype(np.float32))

    loop.perceive = change


def shadow(loop: OrbitLoop) -> None:
    """The person's shadow on the ground is taken for the person: upside down below the feet."""

    def change(seen: PoseObservation) -> PoseObservation:
        keypoints = seen.keypoints.copy()
        keypoints[:, 1] = 2 * np.nanmax(keypoints[:, 1]) - keypoints[:, 1]
        return dataclasses.replace(seen, keypoints=keypoints)

    loop.perceive = change


def drop_setpoints(loop: OrbitLoop) -> None:
    """Only the setpoints are lost on the way to the autopilot."""
    loop.up.drops = is_setpoint


def gust(loop: OrbitLoop) -> None:
    """A wind of 12 m/s begins."""
    loop.copter.body.wind = np.array([0.0, 12.0, 0.0])


def move_stick(override: int) -> Injection:
    """The pilot moves a stick; PX4's COM_RC_OVERRIDE decides whether it counts, ArduPilot's GUIDED ignores it."""

    def inject(loop: OrbitLoop) -> None:
        loop.copter.settings["COM_RC_OVERRIDE"] = override
        loop.copter.move_stick()

    return inject


def both(*injections: Injection) -> Injection:
    """One after the other, at once."""

    def inject(loop: OrbitLoop) -> None:
        for injection in injections:
            injection(loop)

    return inject


def kept(mode: str) -> Callable[[OrbitLoop], str]:
    """The pilot's mode is the last one."""

    def check(loop: OrbitLoop) -> str:
        return "" if loop.copter.mode == mode else f"the pilot's {mode} became {loop.copter.mode}"

    return check


def longer(settings: LoopSettings) -> LoopSettings:
    """By the time that :func:`orbits_again` flies on."""
    return dataclasses.replace(settings, seconds=settings.seconds + 3.0)


def in_wind(settings: LoopSettings) -> LoopSettings:
    """8 m/s."""
    return dataclasses.replace(settings, wind_m_s=(8.0, 0.0, 0.0))


def near_fence(bearing_deg: float) -> Callable[[LoopSettings], LoopSettings]:
    """The fence lies 3 m outside of the orbit, which begins at a bearing from the person."""
    return lambda settings: dataclasses.replace(with_config(settings, fence_radius_m=9.0), bearing_deg=bearing_deg)


def late_stamps(settings: LoopSettings) -> LoopSettings:
    """Pictures are stamped 100 ms after their exposure."""
    return dataclasses.replace(settings, stamp_late_s=0.1)


def busy_machine(settings: LoopSettings) -> LoopSettings:
    """Telemetry pauses for up to 0.3 s, about once in two seconds."""
    return dataclasses.replace(settings, gaps_hz=0.5)


def wrong_ground(lower_m: float) -> Callable[[LoopSettings], LoopSettings]:
    """The ground lies lower by so much than it is configured; 2.5 m above the higher of the two, body measured."""

    def change(settings: LoopSettings) -> LoopSettings:
        config = settings.config
        settings = dataclasses.replace(settings, height_m=settings.height_m + max(lower_m, 0.0))
        return with_config(
            settings, ground_height_m=config.ground_height_m + lower_m,
            height_m=config.height_m + max(-lower_m, 0.0), max_height_m=8.0, gimbal_control=True,
            size_error=0.04, height_error_m=1.0,
        )  # fmt: skip

    return change


def ready_late(settings: LoopSettings) -> LoopSettings:
    """Satellite fix, estimator and origin come one after the other; the last one too late for the start."""
    return dataclasses.replace(settings, ready_s=(2.0, 5.0, 9.0))
