"""MAVLink commands with retries until they are acknowledged."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import AUTOPILOTS
from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.vehicle import enu_to_ned


class Message(Protocol):
    """A message of pymavlink: ``get_type()`` and the like, and the fields of its kind."""

    def __getattr__(self, name: str) -> Any: ...


SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
GIMBAL_PITCH = mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW
TELEMETRY_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE})
TELEMETRY = frozenset({"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "PARAM_REQUEST_READ"})
_MODES = frozenset(a.mode_parameters(mode)[1:3] for a in AUTOPILOTS.values() for mode in (a.control_mode, a.hold_mode))
#: What SET_POSITION_TARGET_LOCAL_NED leaves out where it is velocity and yaw rate alone.
_VELOCITY_ONLY = sum(
    getattr(mavlink, f"POSITION_TARGET_TYPEMASK_{name}_IGNORE") for name in ("X", "Y", "Z", "AX", "AY", "AZ", "YAW")
)


def is_telemetry(message: Message) -> bool:
    """Whether the message only requests or answers telemetry: always allowed."""
    name = message.get_type()
    return name in TELEMETRY and (name != "COMMAND_LONG" or message.command in TELEMETRY_COMMANDS)


def is_motion(message: Message) -> bool:
    """Whether it is a setpoint, a mode on the list or the mount's pitch: allowed with ``commands_enabled``."""
    if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        return True
    if message.get_type() != "COMMAND_LONG":
        return False
    if message.command == SET_MODE:
        return (float(message.param2), float(message.param3)) in _MODES
    return bool(message.command == GIMBAL_PITCH)


def setpoint_message(mav: mavlink.MAVLink, target: tuple[int, int], setpoint: Setpoint) -> Message:
    """Position, velocity, acceleration, yaw and yaw rate in one message.

    Raises ValueError when a value is not finite: such a setpoint has crashed an autopilot.
    """
    if not setpoint.is_finite():
        raise ValueError("expected a setpoint of finite values")
    return _encode(mav, target, 0, setpoint)


def halt_message(mav: mavlink.MAVLink, target: tuple[int, int]) -> Message:
    """Velocity and yaw rate zero: the setpoint for a vehicle whose position is unknown."""
    return _encode(mav, target, _VELOCITY_ONLY, Setpoint(np.zeros(3), np.zeros(3), np.zeros(3), math.pi / 2, 0.0))


def command_message(
    mav: mavlink.MAVLink, target: tuple[int, int], command: int, confirmation: int, parameters: tuple[float, ...]
) -> Message:
    """COMMAND_LONG of a command."""
    message: Message = mav.command_long_encode(*target, command, confirmation, *parameters)
    return message


def _encode(mav: mavlink.MAVLink, target: tuple[int, int], mask: int, setpoint: Setpoint) -> Message:
    # ENU to NED: yaw from east counter-clockwise becomes yaw from north clockwise.
    heading = math.remainder(math.pi / 2 - setpoint.yaw, 2 * math.pi)
    vectors = (float(v) for vector in setpoint[:3] for v in enu_to_ned(vector))
    message: Message = mav.set_position_target_local_ned_encode(
        0, *target, mavlink.MAV_FRAME_LOCAL_NED, mask, *vectors, heading, -setpoint.yaw_rate
    )
    return message


_RETRY_S = 0.4  # between tries: two round trips at the longest that is flown with
_TRIES = 5  # 2 s of them: an autopilot that does not answer then has not heard
_REPEAT_S = 1.5  # after an answer: the mode it granted has been reported by then, and a second answer has come
_NOT_ANSWERED = -1  # beside the MAV_RESULTs
_RESULTS = {
    mavlink.MAV_RESULT_ACCEPTED: "accepted",
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "rejected for now",
    mavlink.MAV_RESULT_DENIED: "denied",
    mavlink.MAV_RESULT_UNSUPPORTED: "unsupported",
    mavlink.MAV_RESULT_FAILED: "failed",
    mavlink.MAV_RESULT_IN_PROGRESS: "in progress",
    6: "cancelled",
    _NOT_ANSWERED: f"not answered after {_TRIES} tries",
}


@dataclass
class _Pending:
    parameters: tuple[float, ...]
    label: str
    tries: int = 0
    sent_s: float = -1e9
    paused: bool = False
    result: int | None = None  # MAV_RESULT, or _NOT_ANSWERED
    answered_s: float = -1e9
    refusal: int | None = None  # while there is no result: the last answer, also to the same command before


class CommandQueue:
    """At most one command of each kind is pending; time is an argument."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def request(self, command: int, parameters: tuple[float, ...], label: str, now_s: float) -> None:
        """Send a command until it is answered; it replaces another one of its kind.

        The same command is repeated only a while after its answer: a mode that is granted but not yet visible must not
        be requested again, because the pilot may have just chosen another one.
        """
        present = self._pending.get(command)
        same = present is not None and present.parameters == parameters
        if present is None or not same or (present.result is not None and now_s - present.answered_s > _REPEAT_S):
            before = None if present is None or not same else present.result
            self._pending[command] = _Pending(parameters, label, refusal=before)
        self._pending[command].paused = False

    def pause(self, command: int) -> None:
        """Do not send the command until it is requested again; its answer is still taken."""
        if command in self._pending:
            self._pending[command].paused = True

    def cancel(self, command: int) -> None:
        """Stop sending the command."""
        self._pending.pop(command, None)

    def cancel_all(self) -> None:
        """Stop sending all commands: the pilot has taken over."""
        self._pending.clear()

    def acknowledge(self, command: int, result: int, now_s: float) -> None:
        """Take an acknowledgement.

        Some autopilots answer DO_SET_MODE twice: accepted at once, and then in earnest.  A refusal that follows counts.
        """
        pending = self._pending.get(command)
        if pending is None or pending.tries == 0:
            return
        if pending.result is not None:
            accepted = pending.result == mavlink.MAV_RESULT_ACCEPTED
            if not accepted or result == pending.result or now_s - pending.answered_s > _REPEAT_S:
                return
            pending.result = None
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            # Such an answer earns more patience.
            pending.sent_s = now_s + 3.0 - _RETRY_S
        elif result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and pending.tries < _TRIES:
            pending.sent_s, pending.refusal = now_s, result  # retried after the usual time
        else:
            pending.result, pending.answered_s = result, now_s

    def due(self, now_s: float) -> list[tuple[int, int, tuple[float, ...]]]:
        """(command, confirmation, parameters) to send now."""
        ready = []
        for command, pending in self._pending.items():
            if pending.paused or pending.result is not None or now_s - pending.sent_s < _RETRY_S:
                continue
            if pending.tries >= _TRIES:
                pending.result, pending.answered_s = _NOT_ANSWERED, now_s
                continue
            ready.append((command, pending.tries, pending.parameters))
            pending.sent_s = now_s
            pending.tries += 1
        return ready

    def failure(self, command: int) -> str:
        """Why the last command of this kind failed, or is refused so far, as a sentence; "" = neither."""
        pending = self._pending.get(command)
        result = None if pending is None else pending.refusal if pending.result is None else pending.result
        if pending is None or result in (None, mavlink.MAV_RESULT_ACCEPTED):
            return ""
        words = _RESULTS.get(result, f"answered with result {result}")
        return f"{pending.label}: {words}"
