"""The allow-list of the link: messages that may leave the port.

It contains no command to arm or to take off, and no mode but the control and hold modes of the dialects.
"""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.dialects import DIALECTS

TELEMETRY = frozenset({"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "REQUEST_DATA_STREAM", "PARAM_REQUEST_READ"})
TELEMETRY_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE})
_MODES = frozenset(
    (float(main), float(sub)) for d in DIALECTS.values() for main, sub in (d.control_numbers, d.hold_numbers)
)


def is_telemetry(message: Any) -> bool:
    """Whether the message only requests or answers telemetry: always allowed."""
    name = message.get_type()
    return name in TELEMETRY and (name != "COMMAND_LONG" or message.command in TELEMETRY_COMMANDS)


def is_motion(message: Any) -> bool:
    """Whether it is a setpoint, a mode of a dialect or the mount's pitch: allowed with ``commands_enabled``."""
    if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        return True
    if message.get_type() != "COMMAND_LONG":
        return False
    if message.command == mavlink.MAV_CMD_DO_SET_MODE:
        return (float(message.param2), float(message.param3)) in _MODES
    return bool(message.command == mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW)
