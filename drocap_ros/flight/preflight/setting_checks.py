"""Checks of the autopilot's parameters that the bridge itself does not read, as a table.

The meanings are those of ArduCopter/mode_guided.cpp and AC_PosControl.cpp, PX4's PositionControl.cpp and failsafe.cpp.
Speed limits of ArduPilot's waypoints (WPNAV_SPEED) are missing here: setpoints with a velocity pass them by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.preflight.findings import Finding, Level, Measured

_NO_PLACE, _WEATHERVANE = 16 | 32, 128  # of GUID_OPTIONS
_IN_GUIDED, _IN_OFFBOARD = 4, 4  # of FS_OPTIONS and COM_RCL_EXCEPT: flies on without the remote control
_GOES_ON = "on the autopilot: else the orbit goes on when the remote control is lost, and nobody takes over by it"
_SLOW_STOP = "on the autopilot, as shipped since 4.1: with less each stop is longer, that after the bridge's death too"


class _Check(NamedTuple):
    """One parameter: wanted value and remedy, in which ``config`` is the bridge's, and the level of a value."""

    name: str
    wanted: str
    remedy: str
    level: Callable[[float, MavlinkBridgeConfig], Level]


def _warn_if(wrong: Callable[[float], bool]) -> Callable[[float, MavlinkBridgeConfig], Level]:
    return lambda value, _: Level.WARNING if wrong(value) else Level.OK


def _guided_options(value: float, _: MavlinkBridgeConfig) -> Level:
    bits = int(value)
    return Level.MISSING if bits & _NO_PLACE else Level.WARNING if bits & _WEATHERVANE else Level.OK


def _greatest_speed(value: float, config: MavlinkBridgeConfig) -> Level:
    orbit_m_s = abs(math.radians(config.angular_speed_deg_s)) * config.radius_m
    return Level.MISSING if value < orbit_m_s else Level.WARNING if value < config.max_speed_m_s else Level.OK


_CHECKS = {
    "ardupilot": (
        _Check(
            "GUID_OPTIONS", "bits 4, 5 and 7 clear",
            "clear bits 4 (16), 5 (32) and 7 (128) of GUID_OPTIONS on the autopilot: with 4 or 5 it drifts off its "
            "setpoints and its hold, with 7 it may turn the camera into the wind", _guided_options,
        ),
        # By its name and unit up to 4.6, and from 4.7 on; 0 stands for the default.
        _Check(
            "WPNAV_ACCEL", "at least 250 cm/s^2", f"set WPNAV_ACCEL to 250 {_SLOW_STOP}",
            _warn_if(lambda v: 0 < v < 250),
        ),
        _Check("WP_ACC", "at least 2.5 m/s^2", f"set WP_ACC to 2.5 {_SLOW_STOP}", _warn_if(lambda v: 0 < v < 2.5)),
        _Check("FS_THR_ENABLE", "not 0", f"set FS_THR_ENABLE to 1 (returns) {_GOES_ON}", _warn_if(lambda v: v == 0)),
        _Check(
            "FS_OPTIONS", "bit 2 clear", f"clear bit 2 (4) of FS_OPTIONS {_GOES_ON}",
            _warn_if(lambda v: bool(int(v) & _IN_GUIDED)),
        ),
    ),
    "px4": (
        _Check(
            "MPC_XY_VEL_MAX", "at least {config.max_speed_m_s:g} m/s (max_speed_m_s)",
            "set MPC_XY_VEL_MAX above {config.max_speed_m_s:g} on the autopilot, or fly slower with a lower "
            "max_speed_m_s: it cuts off every setpoint's speed, and the orbit waits for the vehicle", _greatest_speed,
        ),
        _Check(
            "COM_RCL_EXCEPT", "bit 2 clear", f"clear bit 2 (4) of COM_RCL_EXCEPT {_GOES_ON}",
            _warn_if(lambda v: bool(int(v) & _IN_OFFBOARD)),
        ),
        _Check(
            "NAV_RCL_ACT", "1 (holds), 2 (returns) or 3 (lands)",
            "set NAV_RCL_ACT to 1 on the autopilot: when the remote control is lost, 5 and 6 stop the motors, and with "
            "0 the orbit goes on", _warn_if(lambda v: v not in (1, 2, 3)),
        ),
    ),
}  # fmt: skip

#: Parameters to read, by autopilot.
SETTINGS = {autopilot: tuple(check.name for check in checks) for autopilot, checks in _CHECKS.items()}


def setting_findings(config: MavlinkBridgeConfig, measured: Measured, autopilot: str) -> Iterator[Finding]:
    """A finding for each parameter that was reported: no version of an autopilot has all of them."""
    names = SETTINGS.get(autopilot, ())
    if names and not any(name in measured.settings for name in names):
        yield Finding(
            "settings", "autopilot's settings", Level.WARNING, "not read", f"good values of {', '.join(names)}",
            "stop the running bridge and run this again to read them",
        )  # fmt: skip
        return
    for name, wanted, remedy, level_of in _CHECKS.get(autopilot, ()):
        value = measured.setting(name)
        if math.isnan(value):
            continue
        level = level_of(value, config)
        yield Finding(
            name.lower(), name, level, f"{value:.6g}", wanted.format(config=config),
            "" if level == Level.OK else remedy.format(config=config), {"value": value},
        )  # fmt: skip
