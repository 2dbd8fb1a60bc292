"""From the autopilot's messages to :class:`VehicleState`; the live link and the readers of logs share it."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections import deque

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import Autopilot
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.mavlink.reports import (
    MAX_LOSS,
    MESSAGES,
    ModeReports,
    Mount,
    PacketOrder,
    finite_quaternion,
    is_autopilots,
)
from drocap_ros.flight.vehicle import (
    LANDED_ON_GROUND,
    VehicleState,
    frd_to_flu,
    ned_to_enu,
    orientation_to_ros,
    quaternion_from_euler,
)
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.stamps import NS

#: Least time between two exchanges, ns, that show the rate.
_RATE_SPAN_NS = 5 * NS

logger = logging.getLogger(__name__)


class ClockOffset:
    """Offset between our clock and the autopilot's time since boot.

    Answers to TIMESYNC give it from both directions; the newest of the shortest round trips of the last minute is used,
    with the rate at which the clocks drift apart where exchanges prove one.  Before the first answer, the fastest
    message of the last ten seconds gives it from one direction, late by the shortest transmission time.  A restart of
    the autopilot or a step of either clock resets it.

    An exchange bounds the offset: the answer was given after our sending and before our reception.  However late or
    uneven a link is, these bounds contain the offset, so two exchanges that exclude each other, beyond what the clocks
    may have drifted between them, prove a step; and a drift is believed where they exclude its absence.
    """

    def __init__(self, window_s: float = 60.0, one_way_window_s: float = 10.0, jump_s: float = 1.0) -> None:
        self._window_ns = int(window_s * NS)
        self._one_way_window_ns = int(one_way_window_s * NS)
        self._jump_ns = int(jump_s * NS)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=512)  # received, round trip, offset
        self._best: tuple[int, int, int] | None = None
        self._rate = 0.0  # of the offset
        self._fastest: deque[tuple[int, int]] = deque(maxlen=4096)  # received, offset; offsets increase
        self._suspects = 0

    @property
    def offset_ns(self) -> int | None:
        """Our clock minus the autopilot's at the last exchange or message, or None before the first message."""
        if self._best is not None:
            return self._offset_at(self._exchanges[-1][0])
        return self._fastest[0][1] if self._fastest else None

    def _offset_at(self, received_ns: int) -> int:
        """By the exchange in use, at an instant of our clock."""
        assert self._best is not None
        return self._best[2] + round(self._rate * (received_ns - self._best[0]))

    @property
    def round_trip_ns(self) -> int | None:
        """Round trip of the exchange in use, or None without one."""
        return None if self._best is None else self._best[1]

    def exchange(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Take an answer to TIMESYNC: our time of sending, the autopilot's of answering, ours of receiving."""
        trip = received_ns - sent_ns
        if not 0 <= trip <= 2 * NS:
            return
        offset = sent_ns + trip // 2 - remote_ns
        if self._exchanges:
            before = self._exchanges[-1]
            # No two clocks drift apart faster: recorded of a simulated autopilot on a busy machine.
            drifted = 0.035 * abs(received_ns - before[0])
            # Both ends stamp a packet within a few ms of its way.
            if abs(offset - before[2]) > (trip + before[1]) // 2 + 20_000_000 + drifted:
                step_s = (offset - before[2]) / NS
                logger.warning("our clock and the autopilot's stepped apart by %+.2f s; synchronized again", step_s)
                self.reset()
        self._exchanges.append((received_ns, trip, offset))
        while received_ns - self._exchanges[0][0] > self._window_ns:
            self._exchanges.popleft()
        # Round trips that differ by less are equally good, and the newest one counts: a clock that runs slow by 0.6 %
        # is 40 ms off after 7 s, before exchanges prove it.
        self._best = min(self._exchanges, key=lambda e: (-(-e[1] // 5_000_000), -e[0]))
        self._rate = self._drift()

    def _drift(self) -> float:
        """Rate of the offset, by the fastest exchanges of the oldest and the newest third; 0 where none is proved."""
        third = len(self._exchanges) // 3
        if not third:
            return 0.0
        exchanges = list(self._exchanges)
        first, last = (min(part, key=lambda e: e[1]) for part in (exchanges[:third], exchanges[-third:]))
        change, span = last[2] - first[2], last[0] - first[0]
        proved = span >= _RATE_SPAN_NS and abs(change) > (first[1] + last[1]) // 2
        return change / span if proved else 0.0

    def observe(self, remote_ns: int, received_ns: int) -> None:
        """Take a message that contains the autopilot's time since boot."""
        offset = received_ns - remote_ns
        known = self.offset_ns
        if known is not None and not -self._jump_ns < offset - known < 5 * self._jump_ns:
            # A single outlier is a late or damaged message; several in a row mean that a clock has jumped.
            self._suspects += 1
            if self._suspects < 3:
                return
            self.reset()
        self._suspects = 0
        while self._fastest and self._fastest[-1][1] >= offset:
            self._fastest.pop()
        self._fastest.append((received_ns, offset))
        while received_ns - self._fastest[0][0] > self._one_way_window_ns and len(self._fastest) > 1:
            self._fastest.popleft()

    def to_local_ns(self, remote_ns: int, received_ns: int) -> int:
        """Our clock's stamp of an instant of the autopilot's clock; never later than its reception.

        The reception replaces an instant that would lie more than 5 s before it.
        """
        offset = self.offset_ns if self._best is None else self._offset_at(received_ns)
        if offset is None:
            return received_ns
        stamp = min(remote_ns + offset, received_ns)
        return stamp if received_ns - stamp <= 5 * NS else received_ns


#: Flags of a usable estimate: all of these, and either horizontal position.
_ESTIMATOR_NEEDED = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_VELOCITY_VERT
_ESTIMATOR_NEEDED |= mavlink.ESTIMATOR_POS_VERT_ABS
_ESTIMATOR_POSITION = mavlink.ESTIMATOR_POS_HORIZ_REL | mavlink.ESTIMATOR_POS_HORIZ_ABS

_STALE_S = 3.0  # of position and estimator's health, which come once a second at least: a link's silence counts then
_FRESH_S = 1.0  # of a quaternion, beside which angles do not count, and of a range finder
_EXTRAPOLATE_S = 0.5  # by the velocity, from the position to the attitude: positions come at 2 Hz at least


class VehicleStateEstimator:
    """Reduces messages of one autopilot to its state.

    The first autopilot (or the configured one) is the vehicle; messages of other systems are ignored.  It reads no
    clock: each message comes with its time of reception.

    target_system_id : MAVLink system of the vehicle; 0 = the first autopilot
    camera_mount : kind of the camera's mount; None = as the autopilot describes it
    """

    def __init__(self, target_system_id: int = 0, mount: Mount | None = None) -> None:
        self.clock = ClockOffset()
        self.mount = mount or Mount()
        self.system_id = target_system_id
        self.component_id = 0
        #: MAVLink systems of all autopilots that were heard.
        self.systems: frozenset[int] = frozenset()
        self._heard_ns: int | None = None
        self._stamp_ns = -(10**18)
        self.modes = ModeReports()
        self.packets = PacketOrder()
        self._attitude: tuple[int, np.ndarray, np.ndarray] | None = None  # boot ns, FRD -> NED x y z w, rates FRD
        self._quaternion_ns = -(10**18)
        self._position: tuple[int, np.ndarray, np.ndarray] | None = None  # boot ns, ENU m, ENU m/s
        self._local_position_ns = -(10**18)
        self._origin: np.ndarray | None = None
        self._estimator: tuple[int, int] | None = None  # reception, flags
        self._attitude_received_ns = 0
        self._clearance = (-(10**18), math.nan)
        self._reported = VehicleState(0)  # what comes with neither attitude nor position
        #: The target that the autopilot follows, and its reception.
        self.echo: tuple[int, Message] | None = None
        #: Reception of the latest message of each kind, and of the last change of the position: our clock.
        self.received_ns: dict[str, int] = {}
        self.position_changed_ns = -(10**18)

    def update(self, message: Message, receive_time_ns: int) -> VehicleState | None:
        """Take one decoded pymavlink message; returns a state for each attitude, else None.

        Stamps increase, except after a jump of a clock by more than five seconds.  Values that are not finite and
        quaternions that are not normalized are dropped.
        """
        name = message.get_type()
        if name == "HEARTBEAT":
            self._take_heartbeat(message, receive_time_ns)
            return None
        if self.modes.autopilot is None or message.get_srcSystem() != self.system_id:
            return None
        from_autopilot = message.get_srcComponent() == self.component_id
        if from_autopilot:
            self._heard_ns = receive_time_ns
            self.received_ns[name] = receive_time_ns
            late = self.packets.is_late(message.get_seq())
            if name == "CURRENT_MODE":
                self.modes.take_current_mode(message, late, receive_time_ns)
        handler = _HANDLERS.get(name) if from_autopilot or name in MESSAGES else None
        return self._next_state(receive_time_ns) if handler and handler(self, message, receive_time_ns) else None

    def _next_state(self, now_ns: int) -> VehicleState | None:
        """The state of a new attitude.

        The estimate of the clock offset improves with time: states slightly back in time are left out.
        """
        state = self.snapshot(now_ns)
        if state is None or 0 <= self._stamp_ns - state.stamp_ns < 5 * NS:
            return None
        self._stamp_ns = state.stamp_ns
        return state

    def age_s(self, names: tuple[str, ...], now_ns: int) -> float:
        """Time in s since the latest message of these kinds; infinity before the first."""
        latest = max((self.received_ns[name] for name in names if name in self.received_ns), default=None)
        return math.inf if latest is None else (now_ns - latest) / NS

    def position_behind_s(self) -> float:
        """Time in s by which the position is older than the attitude, by the autopilot's stamps; at least 0."""
        if self._position is None or self._attitude is None:
            return 0.0
        return max((self._attitude[0] - self._position[0]) / NS, 0.0)

    def fresh_mode(self, now_ns: int, mode_s: float, attitude_s: float) -> str:
        """The mode, if its report and the attitude are not older than this; "" = it cannot be seen.  Needs no lock.

        Nor can it be seen where many packets are lost.
        """
        unseen = abs(now_ns - self._stamp_ns) / NS > attitude_s or self.packets.loss > MAX_LOSS
        return "" if unseen or self.modes.age_s(now_ns) > mode_s else self.modes.mode

    def snapshot(self, now_ns: int) -> VehicleState | None:
        """The state at ``now_ns``; None before the first heartbeat and attitude."""
        autopilot = self.modes.autopilot
        if autopilot is None or self._attitude is None or self._heard_ns is None:
            return None
        boot_ns, orientation, rates = self._attitude
        position, velocity = self._position_at(boot_ns)
        return dataclasses.replace(
            self._reported,
            stamp_ns=self.clock.to_local_ns(boot_ns, self._heard_ns),
            autopilot=autopilot.name,
            mode=self.modes.mode,
            armed=self.modes.armed,
            position_enu_m=position,
            velocity_enu_m_s=velocity,
            orientation_xyzw=orientation_to_ros(orientation),
            angular_velocity_flu_rad_s=frd_to_flu(rates),
            position_ok=self._estimator_ok(autopilot, self._heard_ns) and bool(np.isfinite(position).all()),
            gimbal_orientation_xyzw=self.mount.camera_at(orientation, self._attitude_received_ns),
            link_age_s=max(0.0, (now_ns - self._heard_ns) / NS),
        )

    def _report(self, **values: float) -> None:
        self._reported = dataclasses.replace(self._reported, **values)  # type: ignore[arg-type]  # a field of each kind

    def _estimator_ok(self, autopilot: Autopilot, now_ns: int) -> bool:
        if self._estimator is None or (now_ns - self._estimator[0]) / NS >= _STALE_S:
            return False
        rests = not self.modes.armed and self._reported.landed_state == LANDED_ON_GROUND
        flags, bad = self._estimator[1], autopilot.estimator_bad & ~(autopilot.rest_flags if rests else 0)
        return flags & _ESTIMATOR_NEEDED == _ESTIMATOR_NEEDED and bool(flags & _ESTIMATOR_POSITION) and not flags & bad

    def _take_heartbeat(self, message: Message, now_ns: int) -> None:
        if not is_autopilots(message):
            return
        system = message.get_srcSystem()
        self.systems |= {system}
        if self.system_id not in (0, system):
            return
        if self.modes.autopilot is not None and message.get_srcComponent() != self.component_id:
            return
        self.system_id, self.component_id = system, message.get_srcComponent()
        self._heard_ns = now_ns
        self.received_ns["HEARTBEAT"] = now_ns
        self.modes.take_heartbeat(message, self.packets.is_late(message.get_seq()), now_ns)

    def _boot_ns(self, message: Message, now_ns: int) -> int:
        boot_ns = int(message.time_boot_ms) * 10**6
        self.clock.observe(boot_ns, now_ns)
        return boot_ns

    def _take_attitude(self, message: Message, now_ns: int) -> bool:
        # With both forms of the attitude only the quaternion is used: one state for each instant.
        if (now_ns - self._quaternion_ns) / NS < _FRESH_S:
            return False
        angles = (message.roll, message.pitch, message.yaw)
        if not all(map(math.isfinite, angles)):
            return False
        return self._set_attitude(message, quaternion_from_euler(*angles), now_ns)

    def _take_attitude_quaternion(self, message: Message, now_ns: int) -> bool:
        quaternion = finite_quaternion(message.q2, message.q3, message.q4, message.q1)
        if quaternion is None:
            return False
        self._quaternion_ns = now_ns
        return self._set_attitude(message, quaternion, now_ns)

    def _set_attitude(self, message: Message, quaternion: np.ndarray, now_ns: int) -> bool:
        self._attitude_received_ns = now_ns
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed], dtype=float)
        self._attitude = (self._boot_ns(message, now_ns), quaternion, np.where(np.isfinite(rates), rates, np.nan))
        return True

    def _take_local_position(self, message: Message, now_ns: int) -> bool:
        ned = np.array([message.x, message.y, message.z], dtype=float)
        velocity = np.array([message.vx, message.vy, message.vz], dtype=float)
        if np.isfinite(ned).all() and np.isfinite(velocity).all():
            self._local_position_ns = now_ns
            position = ned_to_enu(ned)
            # A real estimate never repeats bit for bit: a repeated one is frozen, even with a fresh stamp.
            if self._position is None or not np.array_equal(self._position[1], position):
                self.position_changed_ns = now_ns
            self._position = (self._boot_ns(message, now_ns), position, ned_to_enu(velocity))
        return False

    def _take_global_position(self, message: Message, now_ns: int) -> bool:
        boot_ns = self._boot_ns(message, now_ns)
        if message.lat == 0 and message.lon == 0:  # autopilots send zeros before the first fix
            return False
        geodetic = np.array([message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3])
        if abs(geodetic[0]) > 90 or abs(geodetic[1]) > 180:
            return False
        latitude, longitude, altitude = geodetic.tolist()
        self._report(latitude_deg=latitude, longitude_deg=longitude, altitude_amsl_m=altitude)
        if (now_ns - self._local_position_ns) / NS < _STALE_S:
            return False
        # No local position: our own frame, with its origin on the ground below the first position.
        if self._origin is None:
            self._origin = np.array([geodetic[0], geodetic[1], geodetic[2] - message.relative_alt * 1e-3])
        velocity = np.array([message.vx, message.vy, message.vz]) * 1e-2
        self._position = (boot_ns, geodetic_to_enu(geodetic, self._origin), ned_to_enu(velocity))
        return False

    def _take_gps(self, message: Message, _now_ns: int) -> bool:
        self._report(gps_fix_type=int(message.fix_type), satellites=int(message.satellites_visible))
        return False

    def _take_sys_status(self, message: Message, _now_ns: int) -> bool:
        volts, percent = message.voltage_battery, message.battery_remaining
        self._report(
            battery_voltage_v=volts * 1e-3 if 0 < volts < 65535 else math.nan,
            battery_fraction=percent * 1e-2 if 0 <= percent <= 100 else math.nan,
        )
        return False

    def _take_estimator(self, message: Message, now_ns: int) -> bool:
        autopilot = self.modes.autopilot
        if autopilot is not None and message.get_type() == autopilot.estimator_message:
            self._estimator = (now_ns, message.flags)
        return False

    def _take_echo(self, message: Message, now_ns: int) -> bool:
        self.echo = (now_ns, message)
        return False

    def _take_extended_state(self, message: Message, _now_ns: int) -> bool:
        self._report(landed_state=int(message.landed_state) if 0 <= message.landed_state <= 4 else 0)
        return False

    def _take_range_finder(self, message: Message, now_ns: int) -> bool:
        if message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270:
            in_range = message.min_distance <= message.current_distance < message.max_distance
            self._clearance = now_ns, message.current_distance * 1e-2 if in_range else math.nan
        return False

    def clearance_m(self, now_ns: int) -> float:
        """Distance below the vehicle by its range finder; NaN without a fresh one."""
        received_ns, distance_m = self._clearance
        return distance_m if abs(now_ns - received_ns) / NS < _FRESH_S else math.nan

    def _take_mount(self, message: Message, now_ns: int) -> bool:
        self.mount.take(message, now_ns)
        return False

    def _take_parameter(self, message: Message, _now_ns: int) -> bool:
        autopilot = self.modes.autopilot
        if autopilot is not None and str(message.param_id).rstrip("\0") == autopilot.mount_type_setting:
            value = float(message.param_value)
            self.mount.servos = None if math.isnan(value) else value == autopilot.servo_mount
        return False

    def _take_system_time(self, message: Message, now_ns: int) -> bool:
        self._boot_ns(message, now_ns)
        return False

    def _position_at(self, boot_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (3,) ENU at an instant, extrapolated for up to half a second."""
        if self._position is None:
            return np.full(3, np.nan), np.full(3, np.nan)
        since, position, velocity = self._position
        gap_s = (boot_ns - since) / NS
        if abs(gap_s) > _STALE_S:
            return np.full(3, np.nan), np.full(3, np.nan)
        return position + velocity * min(max(gap_s, -_EXTRAPOLATE_S), _EXTRAPOLATE_S), velocity


_HANDLERS = {
    "ATTITUDE": VehicleStateEstimator._take_attitude,
    "ATTITUDE_QUATERNION": VehicleStateEstimator._take_attitude_quaternion,
    "LOCAL_POSITION_NED": VehicleStateEstimator._take_local_position,
    "GLOBAL_POSITION_INT": VehicleStateEstimator._take_global_position,
    "GPS_RAW_INT": VehicleStateEstimator._take_gps,
    "SYS_STATUS": VehicleStateEstimator._take_sys_status,
    "EKF_STATUS_REPORT": VehicleStateEstimator._take_estimator,
    "ESTIMATOR_STATUS": VehicleStateEstimator._take_estimator,
    "EXTENDED_SYS_STATE": VehicleStateEstimator._take_extended_state,
    "POSITION_TARGET_LOCAL_NED": VehicleStateEstimator._take_echo,
    "PARAM_VALUE": VehicleStateEstimator._take_parameter,
    "SYSTEM_TIME": VehicleStateEstimator._take_system_time,
    "DISTANCE_SENSOR": VehicleStateEstimator._take_range_finder,
    **dict.fromkeys(MESSAGES, VehicleStateEstimator._take_mount),
}
