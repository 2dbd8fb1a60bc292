"""From what is seen to what is sent: subject, safety, planner and commands in one step of the control loop.

The node and the simulation run this same object.  It reads no clock and owns no thread.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError, ParameterError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import CommandQueue, command_message
from drocap_ros.flight.mavlink.dialects import ARDUPILOT, DIALECTS, Dialect, halt_message, setpoint_message
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.orbit.planner import (
    OrbitGoal,
    OrbitState,
    advance,
    begin_orbit,
    goal_of,
    least_radius,
    setpoint_of,
)
from drocap_ros.flight.orbit.pose_history import PoseHistory
from drocap_ros.flight.orbit.safety import (
    Action,
    Command,
    Limits,
    ModeRequest,
    Observed,
    SafetyState,
    State,
    permit_mode,
    reduce,
)
from drocap_ros.flight.orbit.subject_position import SubjectEstimate, SubjectFilter
from drocap_ros.flight.orbit.watchdog import LastWords, Watchdog
from drocap_ros.flight.setpoint import Setpoint, hold_setpoint
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.observation import PoseObservation

_NS = 1_000_000_000
_COMMAND_AGE_S = 2.0
_CLOCK_JUMP_S = 0.25
_POSITION_JUMP_M = 1.0
_GIMBAL_PERIOD_S = 0.5
_SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
_GIMBAL = mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW
_COMMANDS_KEPT = 16


@dataclass(frozen=True)
class OperatorCommand:
    """A command of the operator; NaN = as at present or as configured.  ``stamp_ns`` 0 = of now."""

    kind: int
    radius_m: float = math.nan
    height_m: float = math.nan
    angular_speed_deg_s: float = math.nan
    stamp_ns: int = 0


class ControlStatus(NamedTuple):
    """What one step did: the fields of ``msg/OrbitStatus.msg``, the answer to a command, and what was sent."""

    state: State
    reason: str
    answer: str
    radius_m: float
    height_m: float
    angular_speed_deg_s: float
    radius_error_m: float
    yaw_error_deg: float
    subject_position: np.ndarray
    action: Action


class OrbitController:
    """Flies the orbit through a link.  States, images and commands may come from other threads than the steps.

    Parameters
    ----------
    link : to the autopilot; it sends motion only with ``commands_enabled``
    watchdog : told of every step, when given
    """

    def __init__(self, link: MavlinkLink, config: MavlinkBridgeConfig, watchdog: Watchdog | None = None) -> None:
        self._link, self._config, self._watchdog = link, config, watchdog
        self._limits = Limits(config, config)
        self._history = PoseHistory(config.camera_mount_pitch_deg)
        self._subject = SubjectFilter(config)
        self._camera_matrix: np.ndarray | None = None
        self._vehicle: VehicleState | None = None
        self._commands: deque[OperatorCommand] = deque(maxlen=_COMMANDS_KEPT)
        self._queue = CommandQueue()
        self._lock = threading.Lock()
        self.safety = SafetyState()
        self._goal: OrbitGoal = goal_of(config)
        self._orbit: OrbitState | None = None
        self._before: tuple[int, float] | None = None
        self._left: Setpoint | None = None  # what the watchdog holds if this loop hangs
        self._jump_m = 0.0  # of the reported position, since the last step
        self._keypoints: np.ndarray | None = None
        self._gimbal_s = -1e18
        self._start_s = 0.0

    # -- what comes in ---------------------------------------------------------------------------------

    def on_state(self, state: VehicleState) -> None:
        """Take a state of the vehicle."""
        with self._lock:
            self._jump_m = max(self._jump_m, _jump_m(self._vehicle, state))
            self._vehicle = state
            self._history.add(state)

    def on_camera(self, camera_matrix: np.ndarray) -> None:
        """Take the camera matrix (3, 3) px; one that cannot be is refused.

        Raises
        ------
        InputError
        """
        focal = np.diag(camera_matrix)[:2]
        if not np.isfinite(camera_matrix).all() or np.any(focal <= 0):
            raise InputError("camera_info: expected a camera matrix with positive focal lengths; calibrate the camera")
        with self._lock:
            self._camera_matrix = np.asarray(camera_matrix, dtype=float)

    def on_pose2d(self, observation: PoseObservation) -> None:
        """Take the keypoints of one image."""
        with self._lock:
            # No two pictures from a flight give the same keypoints bit for bit: these are of one that is frozen.
            before, self._keypoints = self._keypoints, observation.keypoints
            frozen = before is not None and observation.has_subject and np.array_equal(before, observation.keypoints)
            if self._camera_matrix is not None and not frozen:
                camera = self._history.at(observation.stamp_ns)
                locked = self.safety.state == State.ORBITING or not math.isnan(self.safety.engaging_s)
                self._subject.update(observation, self._camera_matrix, camera, locked=locked)

    def command(self, command: OperatorCommand) -> None:
        """Take a command; the next step answers.  Of a storm the latest are kept, and any stop goes first."""
        with self._lock:
            self._commands.append(command)

    # -- one step --------------------------------------------------------------------------------------

    def step(self, now_ns: int, now_s: float) -> ControlStatus:
        """One step of the control loop.

        Parameters
        ----------
        now_ns : clock of the stamps
        now_s : monotonic
        """
        with self._lock:
            return self._step(now_ns, now_s)

    def _step(self, now_ns: int, now_s: float) -> ControlStatus:
        disturbance, dt, hung = self._disturbance(now_ns, now_s)
        estimate = self._subject.estimate(now_ns)
        if estimate is not None:  # into the frame of the reported position, by which the setpoints are flown
            estimate = dataclasses.replace(estimate, position=estimate.position + self._history.offset)
        seen = self._observe(estimate, disturbance, now_ns)
        kind, refusal = self._next_command(now_ns)
        dialect = DIALECTS.get(seen.autopilot, ARDUPILOT)
        before = self.safety
        limits = self._limits._replace(warm_up_s=dialect.warm_up_s)
        self.safety, decision = reduce(before, seen, now_s, kind, limits)
        if hung and self.safety.state == State.HOLDING and self._left is not None:
            # The watchdog has been holding a place already: another one, farther on, would let the vehicle go there.
            self.safety = dataclasses.replace(self.safety, hold_position=self._left.position, hold_yaw=self._left.yaw)
        if self.safety.state != before.state:
            self._on_change(before, seen, estimate, now_s)
        self._request_mode(decision.mode_request, dialect, now_s)
        sent = self._send(decision.action, seen, estimate, dt)
        self._send_commands(seen, estimate, now_s)
        self._leave_words(seen, dialect, now_s)
        return self._status(seen, estimate, refusal or decision.answer, sent)

    def _disturbance(self, now_ns: int, now_s: float) -> tuple[str, float, bool]:
        """What is wrong with our own time, the time since the last step, and whether the watchdog has acted."""
        before, self._before = self._before, (now_ns, now_s)
        hung, asked = self._watchdog.take_fired() if self._watchdog else (False, False)
        if asked and self.safety.modes and self._vehicle is not None:
            dialect = DIALECTS.get(self._vehicle.autopilot, ARDUPILOT)
            self.safety = permit_mode(self.safety, dialect.hold_mode)
        if before is None:
            return "", 0.0, hung
        dt = now_s - before[1]
        jump_s = (now_ns - before[0]) / _NS - dt
        if abs(jump_s) > _CLOCK_JUMP_S:
            return f"our clock jumped by {jump_s:.1f} s", dt, hung
        moved_m, self._jump_m = self._jump_m, 0.0
        if moved_m > 0:
            return f"the reported position jumped by {moved_m:.1f} m", dt, hung
        if hung or dt > self._config.watchdog_s:
            return f"the control loop stood still for {dt:.1f} s", dt, hung
        return "", dt, hung

    def _observe(self, estimate: SubjectEstimate | None, disturbance: str, now_ns: int) -> Observed:
        vehicle, estimator = self._vehicle, self._link.estimator
        if vehicle is None:
            return Observed(disturbance=disturbance)
        age_s = (now_ns - vehicle.stamp_ns) / _NS
        # The state is at the attitude's stamp; a moment later the vehicle is a little farther.
        position = vehicle.position_enu_m + np.nan_to_num(vehicle.velocity_enu_m_s) * min(max(age_s, 0.0), 0.3)
        told = estimator.snapshot(now_ns) or vehicle  # mode and health are newer than the attitude
        dialect = DIALECTS.get(told.autopilot, ARDUPILOT)
        health = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
        status_age = max(estimator.age_s(names, now_ns) for names in (("GPS_RAW_INT",), health, ("SYS_STATUS",)))
        distance, closing, approach = math.nan, 0.0, 0.0
        if estimate is not None:
            offset = position[:2] - estimate.position[:2]
            distance = float(np.hypot(*offset))
            closing = -float(offset @ vehicle.velocity_enu_m_s[:2]) / max(distance, 1e-3)
            approach = float(offset @ estimate.velocity[:2]) / max(distance, 1e-3)
        echo = estimator.age_s(("POSITION_TARGET_LOCAL_NED",), now_ns)
        heeded = True
        if not disturbance and self.safety.state == State.ORBITING and math.isfinite(echo):
            flown_s = (self._before[1] if self._before else 0.0) - self.safety.since_s
            if min(echo, flown_s) > self._config.max_echo_age_s:
                # PX4 must be told another mode; ArduPilot's GUID_TIMEOUT has ended the motion by now, and BRAKE from
                # there would take longer.
                heeded = told.autopilot != "px4"
                disturbance = f"the autopilot has not echoed a setpoint for {echo:.1f} s: it does not follow them"
        return Observed(
            autopilot=told.autopilot, mode=told.mode, in_control=told.mode == dialect.control_mode,
            in_hold=told.mode == dialect.hold_mode, armed=told.armed, landed_state=told.landed_state,
            link_age_s=told.link_age_s, heartbeat_age_s=estimator.age_s(("HEARTBEAT",), now_ns),
            state_age_s=abs(age_s), position_age_s=(now_ns - estimator.position_changed_ns) / _NS,
            status_age_s=status_age, round_trip_s=self._link.answer_age_s(), echo_age_s=echo,
            gps_fix_type=told.gps_fix_type, position_ok=told.position_ok, battery_fraction=told.battery_fraction,
            position=position, velocity=np.asarray(vehicle.velocity_enu_m_s, float), yaw=_yaw(vehicle),
            height_m=float(position[2]) - self._config.ground_height_m,
            subject=None if estimate is None else estimate.position,
            subject_age_s=math.inf if estimate is None else estimate.age_s,
            subject_sd_m=math.inf if estimate is None else estimate.position_sd_m,
            subject_distance_m=distance, closing_m_s=closing, approach_m_s=approach, disturbance=disturbance,
            heeded=heeded, settings_problem=self._link.settings.problem(self._config.max_control_timeout_s),
        )  # fmt: skip

    def _next_command(self, now_ns: int) -> tuple[Command | None, str]:
        """The command to obey in this step, or why it is refused before anything looks at it."""
        if not self._commands:
            return None, ""
        if any(c.kind == Command.STOP for c in self._commands):
            self._commands.clear()
            return Command.STOP, ""
        command = self._commands.popleft()
        if command.kind not in list(Command):
            return None, f"refused: no command has the number {command.kind}"
        age_s = (now_ns - command.stamp_ns) / _NS
        if command.stamp_ns and abs(age_s) > _COMMAND_AGE_S:
            return None, f"refused: the command is {age_s:.1f} s old; commands of the past are not obeyed"
        kind = Command(command.kind)
        if kind == Command.ADJUST and self.safety.state != State.ORBITING:
            return kind, ""
        if kind != Command.ADJUST and (self.safety.state == State.ORBITING or not math.isnan(self.safety.engaging_s)):
            return kind, ""
        try:
            goal = goal_of(
                self._config, command.radius_m, command.height_m, command.angular_speed_deg_s,
                self._goal if kind == Command.ADJUST else None,
            )  # fmt: skip
            low, high = self._config.min_height_m + 0.3, self._config.max_height_m - 0.5
            if not low <= goal.height_m <= high:
                raise ParameterError(f"height_m: expected {low:g} to {high:g} m, got {goal.height_m:g}")
        except ParameterError as error:
            return None, f"refused: {error}"
        self._goal = goal
        return kind, ""

    def _on_change(self, before: SafetyState, seen: Observed, estimate: SubjectEstimate | None, now_s: float) -> None:
        if self.safety.state == State.ORBITING and estimate is not None:
            self._orbit = begin_orbit(seen.position, seen.velocity, estimate.position, self._config)
            self._start_s = now_s
        else:
            self._orbit = None
        if self.safety.state in (State.TAKEN_OVER, State.IDLE):
            self._queue.cancel_all()

    def _request_mode(self, request: ModeRequest, dialect: Dialect, now_s: float) -> None:
        if request == ModeRequest.NONE:
            self._queue.cancel(_SET_MODE)
            return
        hold = request == ModeRequest.HOLD
        mode = dialect.hold_mode if hold else dialect.control_mode
        self.safety = permit_mode(self.safety, mode)
        self._queue.request(_SET_MODE, dialect.mode_parameters(hold), f"mode {mode}", now_s)

    def _send(self, action: Action, seen: Observed, estimate: SubjectEstimate | None, dt: float) -> Action:
        mav, target = self._link.mav, self._link.target
        setpoint: Setpoint | None = None
        if action == Action.ORBIT and self._orbit is not None and estimate is not None:
            config = self._config
            speed = float(np.hypot(*estimate.velocity[:2]))
            self._orbit = advance(
                self._orbit, self._goal, seen.position, estimate.position, estimate.velocity, config.ground_height_m,
                dt, config, least_radius(config, estimate.position_sd_m, speed, config.braking_m_s2),
            )  # fmt: skip
            setpoint = setpoint_of(
                self._orbit, seen.position, estimate.position, estimate.velocity, config, seen.velocity
            )
        elif action == Action.HOLD and self.safety.hold_position is not None:
            setpoint = hold_setpoint(self.safety.hold_position, self.safety.hold_yaw)
        if setpoint is not None and setpoint.is_finite():
            self._link.send_motion(setpoint_message(mav, target, setpoint))
            return action
        if action != Action.NOTHING and target[1]:
            self._link.send_motion(halt_message(mav, target))
            return Action.HALT
        return Action.NOTHING

    def _send_commands(self, seen: Observed, estimate: SubjectEstimate | None, now_s: float) -> None:
        for command, result in self._link.take_answers():
            self._queue.acknowledge(command, result, now_s)
        if self._queue.failure(_GIMBAL):
            self._gimbal_s = math.inf  # there is no mount: not asked again
        wanted = self._config.gimbal_control and self.safety.state == State.ORBITING and estimate is not None
        if wanted and estimate is not None and now_s - self._gimbal_s > _GIMBAL_PERIOD_S:
            drop = float(seen.position[2] - estimate.position[2])
            pitch = -math.degrees(math.atan2(drop, max(seen.subject_distance_m, 0.1)))
            nan = math.nan
            self._queue.request(_GIMBAL, (round(pitch, 1), 0.0, nan, nan, 0.0, 0.0, 0.0), "gimbal pitch", now_s)
            self._gimbal_s = now_s
        for command, confirmation, parameters in self._queue.due(now_s):
            message = command_message(self._link.mav, self._link.target, command, confirmation, parameters)
            self._link.send_motion(message)

    def _leave_words(self, seen: Observed, dialect: Dialect, now_s: float) -> None:
        if self._watchdog is None:
            return
        words = None
        if self.safety.state == State.ORBITING and np.isfinite(seen.position).all() and math.isfinite(seen.yaw):
            mav, target = self._link.mav, self._link.target
            self._left = hold_setpoint(seen.position, seen.yaw)
            hold = setpoint_message(mav, target, self._left)
            mode = command_message(mav, target, _SET_MODE, 0, dialect.mode_parameters(True))
            words = LastWords(self._link.check_motion(hold), self._link.check_motion(mode))
        self._watchdog.kick(now_s, words)

    def _status(self, seen: Observed, estimate: SubjectEstimate | None, answer: str, sent: Action) -> ControlStatus:
        subject = np.full(3, np.nan)
        yaw_error = omega = math.nan
        if estimate is not None:
            subject = estimate.position
            sight, drift = seen.position[:2] - subject[:2], seen.velocity[:2] - estimate.velocity[:2]
            omega = math.degrees((sight[0] * drift[1] - sight[1] * drift[0]) / max(float(sight @ sight), 0.01))
            bearing = math.atan2(-sight[1], -sight[0])
            yaw_error = math.degrees(math.remainder(seen.yaw - bearing, 2 * math.pi)) if sight.any() else math.nan
        orbiting = self.safety.state == State.ORBITING
        reason, failure = self.safety.reason, self._queue.failure(_SET_MODE)
        return ControlStatus(
            state=self.safety.state, reason=f"{reason} ({failure})" if failure else reason, answer=answer,
            radius_m=seen.subject_distance_m, height_m=seen.height_m, angular_speed_deg_s=omega,
            radius_error_m=seen.subject_distance_m - self._goal.radius_m if orbiting else math.nan,
            yaw_error_deg=yaw_error, subject_position=subject, action=sent,
        )  # fmt: skip


def _jump_m(before: VehicleState | None, state: VehicleState) -> float:
    """How far the reported position is from where the last one was going; 0 = near enough."""
    if before is None:
        return 0.0
    dt = (state.stamp_ns - before.stamp_ns) / _NS
    if not 0 < dt < 0.5:
        return 0.0
    mean = 0.5 * (before.velocity_enu_m_s + state.velocity_enu_m_s)
    jump = float(np.linalg.norm(state.position_enu_m - before.position_enu_m - mean * dt))
    return jump if jump > _POSITION_JUMP_M else 0.0  # NaN is no jump


def _yaw(vehicle: VehicleState) -> float:
    """Yaw of the nose, rad from east."""
    if not np.isfinite(vehicle.orientation_xyzw).all():
        return math.nan
    nose = matrix_from_quaternion(vehicle.orientation_xyzw)[:, 0]
    return math.atan2(float(nose[1]), float(nose[0]))
