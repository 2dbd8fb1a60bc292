"""A simulated MAVLink vehicle in the place of an autopilot.

It has heartbeat, telemetry at the requested rates, acknowledgements, and time synchronization.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError
from drocap_ros.flight.autopilot import AUTOPILOTS, autopilot_of
from drocap_ros.flight.mavlink.parser import CurrentMode, MavlinkParser, sign_with
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.flight.vehicle import enu_to_ned, flu_to_frd, orientation_to_aviation
from drocap_ros.geometry.geodesy import enu_to_geodetic


class VehiclePose(NamedTuple):
    """Vehicle at one instant: (3,) m and m/s ENU, (4,) x y z w body FLU -> ENU, (3,) rad/s FLU, camera FLU -> ENU."""

    position_enu_m: np.ndarray
    velocity_enu_m_s: np.ndarray
    orientation_xyzw: np.ndarray
    angular_velocity_flu_rad_s: np.ndarray
    gimbal_orientation_xyzw: np.ndarray


#: A message by path time, s, and pose; None = none is due.
Encode = Callable[[float, VehiclePose], mavlink.MAVLink_message | None]
#: Latitude deg, longitude deg, altitude m of the local frame's origin.
HOME = np.array([47.397742, 8.545594, 488.0])
ESTIMATOR_HEALTHY = 831  # flags of both autopilots in the air: recorded
_GIMBAL_FLAGS = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
_GIMBAL_EARTH = _GIMBAL_FLAGS | mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME


class SimulatedVehicle:
    """MAVLink vehicle on a link of its own; a subclass gives its pose.

    autopilot : name of one that has a simulated counterpart
    gimbal : whether it has a gimbal and reports its attitude
    boot_s : time since boot at path time 0
    """

    def __init__(self, transport: Transport, autopilot: str, *, gimbal: bool, boot_s: float = 30.0) -> None:
        kind = autopilot_of(autopilot)
        if kind.simulated is None:
            raise InputError(f"autopilot: expected one of {', '.join(AUTOPILOTS)}, got {autopilot!r}")
        self.kind, self.simulated = kind, kind.simulated
        self.autopilot, self.gimbal = autopilot, gimbal
        self.received: list[str] = []  # names of the received messages, for tests of what is sent
        #: Highest delivered rate, whatever was requested and acknowledged: lower on a slow link.
        self.max_rate_hz = 400.0
        self.boot_s, self._transport = boot_s, transport
        self._parser = MavlinkParser()
        #: Parameters of the autopilot by their names: a float, or an int.
        self.settings: dict[str, float] = dict(self.simulated.settings)
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._period_s: dict[int, float] = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0}
        self._period_s |= {_number(name): period_s for name, period_s in self.simulated.streams.items()}
        self._encoders = self._all_encoders()
        self._due_s: dict[int, float] = {}
        self.armed, self.battery, self.landed_state = True, 87, mavlink.MAV_LANDED_STATE_IN_AIR
        self.system_status = mavlink.MAV_STATE_ACTIVE
        #: The mode, and the one that was chosen last: an autopilot keeps it where a failsafe enters another.
        self.mode = self.intended = kind.control_mode
        self._mode_sent: tuple[float, tuple[int, int]] = (-math.inf, (0, 0))

    def use_key(self, key: bytes, now_ns: int) -> None:
        """Sign from now on, and drop unsigned packets."""
        self._parser = MavlinkParser(key, now_ns)
        sign_with(self._mav, key, now_ns)

    def step(self, t_s: float, data: bytes | None = None) -> None:
        """Answer the messages received (None = what waits now) and send those due at path time ``t_s``."""
        if data is None:
            data = self._transport.read(0.0)
        if data:
            for message in self._parser.feed(data):
                self._transport.accept_peer()
                self.received.append(message.get_type())
                self._answer(message, t_s)
        pose: VehiclePose | None = None
        for number, period_s in self._period_s.items():
            if t_s >= self._due_s.get(number, -math.inf):
                due = self._due_s.get(number, t_s)
                self._due_s[number] = due + period_s if t_s - due < period_s else t_s + period_s
                pose = pose or self.at(t_s)
                self._send(self._telemetry(number, t_s, pose))

    def at(self, t_s: float) -> VehiclePose:
        """Reported pose at path time ``t_s``."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the port."""
        self._transport.close()

    def _send(self, message: mavlink.MAVLink_message | None) -> None:
        if message is None:
            return
        self._transport.write(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    def _answer(self, message: mavlink.MAVLink_message, t_s: float) -> None:
        name = message.get_type()
        if name == "TIMESYNC" and message.tc1 == 0:
            self._send(self._mav.timesync_encode(int(self.clock_s(t_s) * 1e9), message.ts1))
        elif name == "PARAM_REQUEST_READ":
            self._report_setting(message.param_id)
        elif name == "COMMAND_LONG":
            result = mavlink.MAV_RESULT_UNSUPPORTED
            if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                result = self._set_interval(int(message.param1), message.param2)
            self._send(
                self._mav.command_ack_encode(
                    message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
                )
            )

    def _report_setting(self, name: str) -> None:
        if name not in self.settings:
            return
        value, kind = self.settings[name], mavlink.MAV_PARAM_TYPE_REAL32
        if self.kind.integers_in_bytes and isinstance(value, int):
            value, kind = struct.unpack("<f", struct.pack("<i", value))[0], mavlink.MAV_PARAM_TYPE_INT32
        self._send(self._mav.param_value_encode(name.encode("ascii"), value, kind, len(self.settings), 0))

    def _set_interval(self, number: int, interval_us: float) -> int:
        if number not in self._known():
            return int(mavlink.MAV_RESULT_DENIED)
        if interval_us < 0:
            self._period_s.pop(number, None)
        else:
            self._period_s[number] = max(interval_us * 1e-6, 1.0 / self.max_rate_hz)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _known(self) -> frozenset[int]:
        """Messages whose rates it grants."""
        without = set() if self.gimbal else {mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS}
        return frozenset(self._encoders) - {mavlink.MAVLINK_MSG_ID_HEARTBEAT} - without

    def _all_encoders(self) -> dict[int, Encode]:
        """Messages by path time and pose."""
        encoders: dict[str, Encode] = {
            "HEARTBEAT": lambda _t_s, _pose: self._heartbeat(),
            "ATTITUDE": self._attitude,
            "ATTITUDE_QUATERNION": self._attitude_quaternion,
            "LOCAL_POSITION_NED": self._local_position,
            "GLOBAL_POSITION_INT": self._global_position,
            "GPS_RAW_INT": self._satellites,
            "SYS_STATUS": self._status,
            "EXTENDED_SYS_STATE": self._landed,
            "SYSTEM_TIME": self._system_time,
            "GIMBAL_DEVICE_ATTITUDE_STATUS": self._mount_angles,
            self.kind.estimator_message: self._estimator,
        }
        numbered = {_number(name): encode for name, encode in encoders.items()}
        return numbered if self.kind.heartbeat_on_request else numbered | {CurrentMode.id: self._current_mode}

    def _telemetry(self, number: int, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message | None:
        return self._encoders[number](t_s, pose)

    def clock_s(self, t_s: float) -> float:
        """Time since boot by its own clock, at a path time."""
        return self.boot_s + self.simulated.clock_rate * t_s

    def _boot_ms(self, t_s: float) -> int:
        return int(self.clock_s(t_s) * 1e3) % 2**32

    def _local_position(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message:
        vectors = (*enu_to_ned(pose.position_enu_m), *enu_to_ned(pose.velocity_enu_m_s))
        return self._mav.local_position_ned_encode(self._boot_ms(t_s), *vectors)

    def _mount_angles(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message | None:
        x, y, z, w = orientation_to_aviation(pose.gimbal_orientation_xyzw)
        return self._mav.gimbal_device_attitude_status_encode(
            0, 0, self._boot_ms(t_s), _GIMBAL_EARTH, [w, x, y, z], 0, 0, 0, 0
        )

    def _estimator_flags(self) -> int:
        rests = self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
        return ESTIMATOR_HEALTHY | (self.simulated.flags_at_rest if rests else 0)

    def _estimator(self, t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message:
        flags, ratios = self._estimator_flags(), (0.1, 0.1, 0.1, 0.1)
        if self.kind.estimator_message == "EKF_STATUS_REPORT":
            return self._mav.ekf_status_report_encode(flags, *ratios, 0)
        return self._mav.estimator_status_encode(self._boot_ms(t_s) * 1000, flags, *ratios, 0, 0, 0.3, 0.3)

    def _status(self, _t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message:
        return self._mav.sys_status_encode(0, 0, 0, 200, 15800, 1200, self.battery, 0, 0, 0, 0, 0, 0)

    def _landed(self, _t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message:
        return self._mav.extended_sys_state_encode(mavlink.MAV_VTOL_STATE_UNDEFINED, self.landed_state)

    def _system_time(self, t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message:
        return self._mav.system_time_encode(time.time_ns() // 1000, self._boot_ms(t_s))

    def _heartbeat(self) -> mavlink.MAVLink_message:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return self._mav.heartbeat_encode(
            mavlink.MAV_TYPE_QUADROTOR,
            self.kind.mav_autopilot,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
            self.kind.modes[self.mode],
            self.system_status,
        )

    def _present_modes(self) -> tuple[int, int]:
        """Numbers of the present and of the intended mode."""
        return self.kind.modes[self.mode], self.kind.modes[self.intended]

    def _current_mode(self, t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message | None:
        sent_s, before = self._mode_sent
        present = self._present_modes()
        # An autopilot publishes its state so often, and every change at once: measured.
        if present == before and t_s - sent_s < 0.5:
            return None
        self._mode_sent = t_s, present
        return CurrentMode(0, *present)

    def _attitude_quaternion(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message:
        x, y, z, w = orientation_to_aviation(pose.orientation_xyzw)
        rates = flu_to_frd(pose.angular_velocity_flu_rad_s)
        return self._mav.attitude_quaternion_encode(self._boot_ms(t_s), w, x, y, z, *rates)

    def _attitude(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message:
        x, y, z, w = orientation_to_aviation(pose.orientation_xyzw)
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        rates = flu_to_frd(pose.angular_velocity_flu_rad_s)
        return self._mav.attitude_encode(self._boot_ms(t_s), roll, pitch, yaw, *rates)

    def _satellites(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message:
        fix = mavlink.GPS_FIX_TYPE_RTK_FIXED
        return self._mav.gps_raw_int_encode(self._boot_ms(t_s) * 1000, fix, *_degrees(pose), 60, 90, 0, 0, 17)

    def _global_position(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message:
        velocity = np.round(enu_to_ned(pose.velocity_enu_m_s) * 100).astype(int)
        above_mm = round(pose.position_enu_m[2] * 1e3)
        return self._mav.global_position_int_encode(
            self._boot_ms(t_s), *_degrees(pose), above_mm, *(int(v) for v in velocity), 65535
        )


def _degrees(pose: VehiclePose) -> tuple[int, int, int]:
    """Latitude and longitude in 1e-7 degrees, altitude in mm."""
    lat, lon, alt = enu_to_geodetic(pose.position_enu_m, HOME)
    return round(lat * 1e7), round(lon * 1e7), round(alt * 1e3)


def _number(name: str) -> int:
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
