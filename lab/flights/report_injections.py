"""Injections of wrong, missing and alarming reports of the autopilot, its mount and the perception."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.simulation.pinhole import pinhole_matrix
from lab.flights.fault_flight import FAULT_S, Injection
from lab.flights.orbit_loop import OrbitLoop


def never_sends(number: int) -> Injection:
    """Messages of this number never arrive from the autopilot."""
    header = bytes([number & 255, number >> 8, 0])
    return lambda loop: setattr(loop.down, "drops", lambda packet: packet[:1] == b"\xfd" and packet[7:10] == header)


def reports_state(mav_state: int) -> Injection:
    """The autopilot's heartbeats have this MAV_STATE from now on."""

    def inject(loop: OrbitLoop) -> None:
        heartbeat: Callable[[], Any] = loop.copter._heartbeat

        def changed() -> Any:
            message = heartbeat()
            message.system_status = mav_state
            return message

        loop.copter._heartbeat = changed  # type: ignore[method-assign]

    return inject


def unknown_mount(loop: OrbitLoop) -> None:
    """The mount reports that it does not know its angles: NaN."""
    mount = loop.copter.mount
    report = mount.report

    def unknown(*arguments: Any) -> Any:
        reported = report(*arguments)
        return None if reported is None else (np.full(4, np.nan), reported[1])

    mount.report = unknown  # type: ignore[method-assign, assignment]


def zoomed(field_deg: float) -> Injection:
    """camera_info states another field of view in deg, as of a lens that zooms; the pictures stay."""

    def inject(loop: OrbitLoop) -> None:
        height, width = 2 * loop.matrix[1, 2], 2 * loop.matrix[0, 2]
        loop.controller.on_camera(pinhole_matrix(round(width), round(height), field_deg))

    return inject


def small_steps(toward_m: float) -> Injection:
    """The estimate steps every second, six times: a place of before is then nearer to the person by this."""

    def inject(loop: OrbitLoop) -> None:
        fly, begin_s, steps = loop.copter.fly, loop.t, [0]

        def stepping(t_s: float) -> None:
            if t_s >= begin_s + steps[0] and steps[0] < 6:
                steps[0] += 1
                sight = (loop.pelvis() - loop.copter.body.position)[:2]
                step = np.append(toward_m * sight / np.hypot(*sight), 0.0)
                loop.copter.gps_error = loop.copter.gps_error - step
            fly(t_s)

        loop.copter.fly = stepping  # type: ignore[method-assign]

    return inject


def at_least(distance_m: float) -> Callable[[OrbitLoop], str]:
    """ArduPilot's vehicle stayed at this distance from the person, m."""

    def check(loop: OrbitLoop) -> str:
        least_m = min(row.distance_m for row in loop.rows if row.t_s > FAULT_S)
        kept = least_m >= distance_m or loop.settings.autopilot != "ardupilot"
        return "" if kept else f"{least_m:.1f} m from the person"

    return check


ECHO, TIME_SYNC = mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_TIMESYNC
EMERGENCY, CRITICAL = mavlink.MAV_STATE_EMERGENCY, mavlink.MAV_STATE_CRITICAL
