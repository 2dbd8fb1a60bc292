"""What the autopilot reports of mode and mount: the newest mode counts, and none that was reported is overlooked."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import Autopilot, autopilot_by_heartbeat
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.vehicle import orientation_to_ros, quaternion_from_euler, yaw_of
from drocap_ros.geometry.rotations import LENGTH_ERROR, normalized, quaternion_multiply, slerp
from drocap_ros.stamps import NS

_EARTH, _NOSE = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME, mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
_STALE_S = {"gimbal": 3.0, "servo": 0.5}  # without angles; those of servos follow the body's lean


class Mount:
    """The camera's attitude at each attitude of the body.

    kind : one of ``subject_config.MOUNT_KINDS``
    pitch_deg : of a fixed camera against the body, negative = down
    """

    def __init__(self, kind: str = "auto", pitch_deg: float = 0.0) -> None:
        self._kind = kind
        self._fixed = quaternion_from_euler(0.0, math.radians(pitch_deg), 0.0)
        #: Whether it is servos by the autopilot's parameter; None = not reported.  Servos report their commands,
        #: against the body, under the flags of angles against the horizon.
        self.servos: bool | None = None
        self._latest: _Angles | None = None
        self._before: _Angles | None = None
        self._knows = True  # whether its last message had angles

    @property
    def kind(self) -> str:
        """One of "gimbal", "servo" and "fixed"; "" = no mount has reported its angles."""
        if self._kind != "auto":
            return self._kind
        if self.servos:
            return "servo"
        return "" if self._latest is None else "gimbal"

    @property
    def _stale_s(self) -> float:
        """Greatest age of the angles in s: less where the mount still reports, and not its angles (NaN)."""
        return min(_STALE_S.get(self.kind, math.inf), math.inf if self._knows else _STALE_S["servo"])

    def take(self, message: Message, now_ns: int) -> None:
        """Take a message of the mount."""
        angles = _READERS[message.get_type()](message)
        self._knows = angles is not None
        if angles is not None:
            self._before, self._latest = self._latest, _Angles(now_ns, *angles)

    def age_s(self, now_ns: int) -> float:
        """Time in s since the mount's last message, infinity before the first; 0 for a fixed camera."""
        if self.kind == "fixed":
            return 0.0
        return math.inf if self._latest is None else (now_ns - self._latest.received_ns) / NS

    def problem(self, autopilot: Autopilot, now_ns: int) -> Condition | None:
        """Why the camera's attitude must not be relied on; None = it may be."""
        if self.kind == "":
            return condition(ConditionCode.CAMERA_UNKNOWN)
        if self._kind == "auto" and autopilot.mount_type_setting and self.servos is None:
            return condition(ConditionCode.MOUNT_TYPE_UNKNOWN, name=autopilot.mount_type_setting)
        if self.age_s(now_ns) > self._stale_s:
            return condition(ConditionCode.MOUNT_OUTDATED, age_s=self.age_s(now_ns))
        return None

    def camera_at(self, body: np.ndarray, received_ns: int) -> np.ndarray:
        """(4,) x y z w camera FLU -> ENU at an attitude of the body FRD -> NED and its reception; NaN = unknown.

        Messages of the mount come at other times than the attitude.  Its last rotation is extrapolated over at most
        one period: at 25 deg/s and 20 Hz the error would be a degree.  A servo lags its command; without
        this lag a body that rocks at 40 deg/s would be 2 degrees off.
        """
        if self.kind == "fixed":
            return orientation_to_ros(quaternion_multiply(body, self._fixed))
        if self._latest is None or self.age_s(received_ns) > self._stale_s:
            return np.full(4, np.nan)
        latest, before = self._latest, self._before
        angles = latest.quaternion
        if before is not None and before.from_north == latest.from_north:
            step_ns = latest.received_ns - before.received_ns
            # Between reports that are farther apart a rotation is not extrapolated.
            if 0 < step_ns <= 0.25 * NS:
                # A servo follows its demanded angle this much later: a frame of its signal, and its turning.
                delay_s = 0.05 if self.kind == "servo" else 0.0
                after_ns = received_ns - int(delay_s * NS) - latest.received_ns
                part = min(max(after_ns / step_ns, -1.0), 1.0)
                angles = slerp(before.quaternion, angles, 1.0 + part)
        if self.kind == "servo":
            return orientation_to_ros(quaternion_multiply(body, angles))
        if not latest.from_north:
            nose = quaternion_from_euler(0.0, 0.0, float(yaw_of(body)))
            angles = quaternion_multiply(nose, angles)
        return orientation_to_ros(angles)


class _Angles(NamedTuple):
    """(4,) x y z w of the mount's angles FRD, and whether their yaw is against north instead of the nose."""

    received_ns: int
    quaternion: np.ndarray
    from_north: bool


def _device_attitude(message: Message) -> tuple[np.ndarray, bool] | None:
    w, x, y, z = message.q
    quaternion = finite_quaternion(x, y, z, w)
    if quaternion is None:
        return None
    from_north = _EARTH if message.flags & (_EARTH | _NOSE) else mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
    return quaternion, bool(message.flags & from_north)


def _orientation(message: Message) -> tuple[np.ndarray, bool] | None:
    absolute = message.yaw_absolute
    # A v1 message has no absolute yaw and decodes it as 0: the yaw relative to the vehicle is used instead.
    from_north = math.isfinite(absolute) and absolute != 0.0
    angles = np.deg2rad([message.roll, message.pitch, absolute if from_north else message.yaw])
    return (quaternion_from_euler(*angles), from_north) if np.isfinite(angles).all() else None


def _status(message: Message) -> tuple[np.ndarray, bool]:
    pitch, roll, yaw = np.deg2rad(
        np.array([message.pointing_a, message.pointing_b, message.pointing_c], dtype=float) * 1e-2
    )
    return quaternion_from_euler(roll, pitch, yaw), False


#: Messages of a mount: (4,) x y z w of its angles, and whether the yaw is against north instead of the nose.
_READERS = {
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _device_attitude,
    "MOUNT_ORIENTATION": _orientation,
    "MOUNT_STATUS": _status,
}
MESSAGES = frozenset(_READERS)


def finite_quaternion(x: float, y: float, z: float, w: float) -> np.ndarray | None:
    """Normalized (4,) x y z w; None where a value is not finite or the length is too far from 1."""
    off = abs(math.sqrt(x * x + y * y + z * z + w * w) - 1.0)  # NaN is below nothing
    return np.array(normalized(x, y, z, w)) if off < LENGTH_ERROR else None


#: Packets; farther back a sequence number counts as the beginning of a new sequence.
_MAX_LATE = 32
#: Share of lost packets above which no mode is requested: the pilot may have chosen one unseen.  At a quarter, the
#: chance that both reports of a mode within 0.2 s are lost is 6 %.
MAX_LOSS = 0.25
_LOSS_RATE = 1 / 64  # a packet: the share of lost ones is that of the last 64, about half a second of telemetry


class PacketOrder:
    """Which packets of one sender are late or lost, by the sequence number that MAVLink counts modulo 256.

    loss : share of the last packets that have not arrived
    """

    def __init__(self) -> None:
        self.loss = 0.0
        self._newest: int | None = None

    def is_late(self, sequence: int) -> bool:
        """Take the next packet; returns whether it arrives after newer ones."""
        sent = 0 if self._newest is None else (sequence - self._newest) % 256
        if sent >= 256 - _MAX_LATE:
            self.loss = max(self.loss - _LOSS_RATE, 0.0)  # it had counted as lost
            return True
        if sent > 0:
            missing = 1.0 - (1.0 - self.loss) * (1.0 - _LOSS_RATE) ** (sent - 1)
            self.loss = missing * (1.0 - _LOSS_RATE)
        self._newest = sequence
        return False


def is_autopilots(heartbeat: Message) -> bool:
    """Whether an autopilot has sent it, and no other program, whatever system and component that one names."""
    return bool(heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and heartbeat.type != mavlink.MAV_TYPE_GCS)


class ModeReports:
    """The mode of one vehicle.

    autopilot : None before the first heartbeat
    mode : by the newest report, the autopilot's own name; "" before the first
    intended : the mode that the pilot or a command has chosen last, as CURRENT_MODE reported it together with the
        present mode; "" = unknown.  An autopilot may keep it where a failsafe enters another mode.
    vehicle_type : MAV_TYPE, by the last heartbeat
    armed : by the last heartbeat
    system_status : MAV_STATE, by the last heartbeat; 0 = unknown, also where a critical state was reported together
        with a mode that has changed since: a failsafe that acts sets the mode
    received_ns : reception of the newest report that did not arrive late
    """

    def __init__(self) -> None:
        self.autopilot: Autopilot | None = None
        self.mode = self.intended = ""
        self.vehicle_type = self.system_status = 0
        self.armed = False
        self.received_ns: int | None = None
        self._heartbeat: Message | None = None
        self._before = ""
        self._changed = (0, 0)  # sequence and reception of the first report of the present mode
        self._heard: deque[str] = deque(maxlen=32)  # appended by one thread and drained by another

    def take_heartbeat(self, message: Message, late: bool, now_ns: int) -> None:
        """Take a HEARTBEAT; ``late``: it was sent before a packet that has already arrived."""
        self._heartbeat = message
        self.autopilot, self.vehicle_type = autopilot_by_heartbeat(message.autopilot), int(message.type)
        if not late:
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.system_status = int(message.system_status)
        # The mode that is intended belongs to the mode with which it was reported.
        mode = self._name(message.custom_mode)
        self._take(mode, self.intended if mode == self.mode else "", message.get_seq(), late, now_ns)

    def take_current_mode(self, message: Message, late: bool, now_ns: int) -> None:
        """Take a CURRENT_MODE; before the first heartbeat its numbers have no names."""
        if self._heartbeat is None:
            return
        intended, mode = message.intended_custom_mode, self._name(message.custom_mode)
        if not late and mode != self.mode and self.system_status == mavlink.MAV_STATE_CRITICAL:
            self.system_status = 0
        self._take(mode, self._name(intended) if intended else "", message.get_seq(), late, now_ns)

    def take_heard(self) -> frozenset[str]:
        """All modes that were reported since the last call, late ones too."""
        heard = set()
        while self._heard:
            heard.add(self._heard.popleft())
        return frozenset(heard)

    def age_s(self, now_ns: int) -> float:
        """Time in s since the newest report; infinity before the first."""
        return math.inf if self.received_ns is None else (now_ns - self.received_ns) / NS

    def _take(self, mode: str, intended: str, sequence: int, late: bool, now_ns: int) -> None:
        if late:
            # What was sent before the present mode began, with the mode of that time, is no news.  Any other mode is
            # one in between: the vehicle was in it.
            first, since_ns = self._changed
            # Packets of a former mode may still arrive late for a second.
            history = 0 < (first - sequence) % 256 <= _MAX_LATE and now_ns - since_ns < NS
            if not (history and mode == self._before):
                self._heard.append(mode)
            return
        if mode != self.mode:
            self._before, self._changed = self.mode, (sequence, now_ns)
        self.mode, self.intended, self.received_ns = mode, intended, now_ns
        self._heard.append(mode)

    def _name(self, custom_mode: int) -> str:
        """A mode by the autopilot's own name, or its number where neither its table nor pymavlink knows one."""
        from pymavlink import mavutil

        assert self.autopilot is not None
        assert self._heartbeat is not None
        if name := self.autopilot.mode_name(custom_mode):
            return name
        kind, custom = self._heartbeat, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        numbered = mavlink.MAVLink_heartbeat_message(kind.type, kind.autopilot, custom, custom_mode, 0, 3)
        return str(mavutil.mode_string_v10(numbered))
