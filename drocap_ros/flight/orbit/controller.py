"""One step of the control loop: subject, safety, planner and setpoint.

The node and the simulation run this same object.  It reads no clock and owns no thread.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import deque

import numpy as np

from drocap_ros.flight.autopilot import Autopilot, autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.commands import CommandQueue
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.messages import (
    GIMBAL_PITCH,
    SET_MODE,
    command_message,
    halt_message,
    setpoint_message,
)
from drocap_ros.flight.orbit.command_checks import command_condition, commanded_goal
from drocap_ros.flight.orbit.control_status import ControlStatus, widened_condition
from drocap_ros.flight.orbit.degradation import slowed
from drocap_ros.flight.orbit.following import Following, Keeping
from drocap_ros.flight.orbit.last_setpoint import coast_speed, harmless, slowed_condition
from drocap_ros.flight.orbit.observer import PositionJumps, observe
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
from drocap_ros.flight.orbit.safety import permit_mode, reduce
from drocap_ros.flight.orbit.shortfall import Shortfall
from drocap_ros.flight.orbit.states import (
    Action,
    Command,
    CommandAnswer,
    Limits,
    ModeRequest,
    Observed,
    OperatorCommand,
    SafetyState,
    State,
)
from drocap_ros.flight.orbit.watchdog import FallbackCommands, Watchdog
from drocap_ros.flight.setpoint import Setpoint, hold_setpoint
from drocap_ros.flight.subject.framing import Framing
from drocap_ros.flight.subject.guard import Guard
from drocap_ros.flight.subject.subject_filter import SubjectEstimate, SubjectFilter
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.observation import PoseObservation

_NS = 1_000_000_000
_CLOCK_JUMP_S = 0.25
_GIMBAL_PERIOD_S = 0.5
_MODE_AGE_STEPS = 1.5  # a report of the mode is seen in the step that follows it
_MAX_WAITING_COMMANDS = 16


class OrbitController:
    """Flies the orbit through a link.  States, images and commands may come from other threads than the steps.

    Parameters
    ----------
    link : to the autopilot; it sends motion only with ``commands_enabled``
    watchdog : gets the fallback commands of every step, when given
    """

    def __init__(self, link: MavlinkLink, config: MavlinkBridgeConfig, watchdog: Watchdog | None = None) -> None:
        self._link, self._config, self._watchdog = link, config, watchdog
        self._limits = Limits(
            config, config, max_control_timeout_s=config.max_control_timeout_s,
            max_mode_age_s=_MODE_AGE_STEPS / config.control_hz,
        )  # fmt: skip
        self._history = PoseHistory()
        self._subject = SubjectFilter(config)
        self._framing = Framing(config)
        self._guard = Guard(config, config, config.braking_m_s2)
        self._vehicle: VehicleState | None = None
        self._commands: deque[OperatorCommand] = deque()
        self._answers: list[tuple[OperatorCommand, CommandAnswer]] = []
        self._queue = CommandQueue()
        self._following, self._keeping = Following(config.max_echo_age_s), Keeping(config)
        self._lock = threading.Lock()
        self.safety = SafetyState()
        self._goal: OrbitGoal = goal_of(config)
        self._orbit: OrbitState | None = None
        self._shortfall = Shortfall()
        self._framed_radius_m = 0.0  # of the last orbit step, for the status
        self._before: tuple[int, float] | None = None
        self._fallback: Setpoint | None = None  # what the watchdog holds if this loop hangs
        self._jumps = PositionJumps()
        self._gimbal_s = -1e18
        #: Another one that commands or is followed, found in the graph; any thread may set it.
        self.intruder: Condition | None = None
        self._unsafe: Condition | None = None  # why the last setpoint was not sent
        self._camera_changed: Condition | None = None  # since the last step

    # -- inputs ----------------------------------------------------------------------------------------
    def on_state(self, state: VehicleState) -> None:
        """Take a state of the vehicle."""
        with self._lock:
            self._jumps.take(state)
            self._vehicle = state
            self._history.add(state)
            self._subject.height_wanders = autopilot_of(state.autopilot).height_wanders

    def on_camera(self, camera_matrix: np.ndarray) -> None:
        """Take the camera matrix (3, 3) px; raises as :meth:`Framing.calibrate`.  A change ends the motion."""
        with self._lock:
            self._camera_changed = self._framing.calibrate(camera_matrix) or self._camera_changed

    def on_pose2d(self, observation: PoseObservation) -> None:
        """Take the keypoints of one image."""
        late_ns = round(self._config.camera_latency_s * _NS)
        observation = dataclasses.replace(observation, stamp_ns=observation.stamp_ns - late_ns)
        with self._lock:
            self._framing.size = observation.image_size
            if (matrix := self._framing.matrix) is not None and self._camera_changed is None:
                camera = self._history.at(observation.stamp_ns)
                for estimator in (self._subject.update, self._guard.see):
                    estimator(observation, matrix, camera, locked=self.safety.bound)

    def command(self, command: OperatorCommand) -> None:
        """Take a command; a step answers it.  Each step answers one, and a stop before all others."""
        with self._lock:
            self._commands.append(command)
            if len(self._commands) > _MAX_WAITING_COMMANDS:
                # The oldest that is no stop: a stop is never dropped for another command.
                index = next((i for i, c in enumerate(self._commands) if c.kind != Command.STOP), 0)
                dropped = self._commands[index]
                del self._commands[index]
                self._refuse(dropped, condition(ConditionCode.TOO_MANY_COMMANDS, limit=_MAX_WAITING_COMMANDS))

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
        self._link.decided_s = now_s
        disturbance, dt, hung = self._disturbance(now_ns, now_s)
        estimate = self._subject.estimate(now_ns)
        if estimate is not None:  # into the frame of the reported position, by which the setpoints are flown
            estimate = dataclasses.replace(estimate, position=estimate.position + self._history.offset)
        orbiting_s = now_s - self.safety.since_s if self.safety.state == State.ORBITING else 0.0
        setpoints, echo = self._link.sent_setpoints(), self._link.echo()
        trip_s = self._link.answer_age_s()
        not_followed = self._following.step(now_s, orbiting_s, setpoints, echo, self._vehicle, trip_s)
        seen = observe(self._link, self._config, self._vehicle, estimate, disturbance, not_followed, now_ns)
        seen = self._keeping.watch(self._orbit, self._framing.watch(self._vehicle, seen, dt), now_s)
        seen = dataclasses.replace(
            self._guard.doubt(seen, self._history.offset, now_ns), intruder=self.intruder,
            calibrated=self._framing.matrix is not None,
        )  # fmt: skip
        command, kind, goal = self._next_command(now_ns)
        autopilot = autopilot_of(seen.autopilot)
        before = self.safety
        limits = self._limits._replace(warm_up_s=autopilot.warm_up_s)
        self.safety, decision = reduce(before, seen, now_s, kind, limits)
        if command is not None and decision.answer is not None:
            self._answers.append((command, decision.answer))
            if goal is not None and decision.answer.accepted:
                self._goal = goal
        if hung and not seen.jumped and self.safety.state == State.HOLDING and self._fallback is not None:
            # The watchdog already holds a position: a new one, farther on, would let the vehicle move on.
            self.safety = dataclasses.replace(
                self.safety, hold_position=self._fallback.position, hold_yaw=self._fallback.yaw
            )
        if self.safety.state != before.state:
            self._on_change(seen, estimate)
        if self._camera_changed is not None:  # the places so far were measured by another one
            config, self._camera_changed = self._config, None
            self._subject, self._guard = SubjectFilter(config), Guard(config, config, config.braking_m_s2)
        self._request_mode(decision.mode_request, seen, autopilot, now_s)
        sent = self._send(decision.action, seen, estimate, dt)
        self._send_commands(seen, estimate, now_s)
        self._leave_fallback(seen, autopilot, now_s)
        return self._status(seen, estimate, sent)

    def _disturbance(self, now_ns: int, now_s: float) -> tuple[Condition | None, float, bool]:
        """Disturbance of our own time or of the position, time since the last step, whether the watchdog has acted."""
        before, self._before = self._before, (now_ns, now_s)
        hung, requested = self._watchdog.take_fired() if self._watchdog else (False, False)
        if requested and self.safety.modes and self._vehicle is not None:
            autopilot = autopilot_of(self._vehicle.autopilot)
            self.safety = permit_mode(self.safety, autopilot.hold_mode)
        if before is None:
            return None, 0.0, hung
        dt = now_s - before[1]
        jump_s = (now_ns - before[0]) / _NS - dt
        if abs(jump_s) > _CLOCK_JUMP_S:
            return condition(ConditionCode.CLOCK_JUMPED, jump_s=jump_s), dt, hung
        if (jump_m := self._jumps.pop()) > 0:
            return condition(ConditionCode.POSITION_JUMPED, jump_m=jump_m), dt, hung
        if hung or dt > self._config.watchdog_s:
            return condition(ConditionCode.CONTROL_LOOP_STALLED, gap_s=dt), dt, hung
        return self._camera_changed or self._unsafe, dt, hung

    def _next_command(self, now_ns: int) -> tuple[OperatorCommand | None, Command | None, OrbitGoal | None]:
        """The command to execute in this step, and the orbit that it asks for; an invalid one is refused here."""
        if not self._commands:
            return None, None, None
        stop = next((c for c in self._commands if c.kind == Command.STOP), None)
        if stop is not None:
            overruled = condition(ConditionCode.OVERRULED_BY_STOP)
            self._answers += [
                (c, CommandAnswer(c.kind == Command.STOP, overruled)) for c in self._commands if c is not stop
            ]
            self._commands.clear()
            return stop, Command.STOP, None
        command = self._commands.popleft()
        if (refusal := command_condition(command, now_ns)) is not None:
            self._refuse(command, refusal)
            return None, None, None
        kind = Command(command.kind)
        running = self.safety.state == State.ORBITING
        if (kind == Command.ADJUST and not running) or (kind != Command.ADJUST and (running or self.safety.requesting)):
            return command, kind, None  # the state decides, and the goal stays
        goal = commanded_goal(self._config, command, self._goal if kind == Command.ADJUST else None, self._framing)
        if isinstance(goal, Condition):
            self._refuse(command, goal)
            return None, None, None
        return command, kind, goal

    def _refuse(self, command: OperatorCommand, refusal: Condition) -> None:
        self._answers.append((command, CommandAnswer(False, refusal)))

    def _on_change(self, seen: Observed, estimate: SubjectEstimate | None) -> None:
        if self.safety.state == State.ORBITING and estimate is not None:
            self._shortfall = Shortfall()
            self._orbit = begin_orbit(seen.position, seen.velocity, estimate.position, self._config)
        else:
            self._orbit = self._unsafe = None
        if self.safety.state in (State.TAKEN_OVER, State.IDLE):
            self._queue.cancel_all()

    def _request_mode(self, request: ModeRequest, seen: Observed, autopilot: Autopilot, now_s: float) -> None:
        if request == ModeRequest.NONE or not autopilot.supported:
            # A request that waits for a visible mode is not sent, but it is not forgotten either: a mode that was
            # granted must not be requested again.
            waiting = self.safety.requesting or self.safety.state in (State.HOLDING, State.FAULT)
            (self._queue.pause if waiting and not seen.in_hold else self._queue.cancel)(SET_MODE)
            return
        mode = autopilot.hold_mode if request == ModeRequest.HOLD else autopilot.control_mode
        self.safety = permit_mode(self.safety, mode)
        self._queue.request(SET_MODE, autopilot.mode_parameters(mode), f"mode {mode}", now_s)

    def _send(self, action: Action, seen: Observed, estimate: SubjectEstimate | None, dt: float) -> Action:
        mav, target = self._link.mav, self._link.target
        setpoint: Setpoint | None = None
        if action == Action.ORBIT and self._orbit is not None and estimate is not None:
            config, pace = self._config, self.safety.pace
            speed = float(np.hypot(*estimate.velocity[:2]))
            least = least_radius(
                config, estimate.position_sd_m, speed, config.braking_m_s2, config.size_error,
                estimate.nearer * seen.subject_distance_m,
            )  # fmt: skip
            self._framed_radius_m = self._framing.least_radius(self._goal, speed, seen.autopilot)
            self._orbit = advance(
                self._orbit, self._goal, seen.position, estimate.position, estimate.velocity, config.ground_height_m,
                dt * pace.value, config, max(least, self._framed_radius_m), coast_speed(seen, self._limits),
            )  # fmt: skip
            setpoint = setpoint_of(self._orbit, seen.position, estimate.position, estimate.velocity, config)
            setpoint = self._shortfall.added(setpoint, seen, estimate.position, self._orbit.centre_velocity)
            setpoint = slowed(setpoint, pace, config.max_acceleration_m_s2)
            setpoint = self._guard.limit(setpoint, seen, -seen.approach_m_s)
            setpoint, self._unsafe = harmless(setpoint, seen, estimate.velocity, self.safety.fence_centre, self._limits)
            self._shortfall.learn(setpoint, seen, dt)
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
        if self._queue.failure(GIMBAL_PITCH):
            self._gimbal_s, self._framing.follows = math.inf, False  # there is no mount: no further requests
        wanted = self._config.gimbal_control and self.safety.state == State.ORBITING and estimate is not None
        if wanted and estimate is not None and now_s - self._gimbal_s > _GIMBAL_PERIOD_S:
            drop = float(seen.position[2] - estimate.position[2])
            pitch = -math.degrees(math.atan2(drop, max(seen.subject_distance_m, 0.1)))
            nan = math.nan
            self._queue.request(GIMBAL_PITCH, (round(pitch, 1), 0.0, nan, nan, 0.0, 0.0, 0.0), "gimbal pitch", now_s)
            self._gimbal_s = now_s
        for command, confirmation, parameters in self._queue.due(now_s):
            message = command_message(self._link.mav, self._link.target, command, confirmation, parameters)
            self._link.send_motion(message)

    def _leave_fallback(self, seen: Observed, autopilot: Autopilot, now_s: float) -> None:
        if self._watchdog is None:
            return
        commands = None
        if self.safety.state == State.ORBITING and np.isfinite(seen.position).all() and math.isfinite(seen.yaw):
            mav, target = self._link.mav, self._link.target
            self._fallback = hold_setpoint(seen.position, seen.yaw)
            hold = setpoint_message(mav, target, self._fallback)
            mode = command_message(mav, target, SET_MODE, 0, autopilot.mode_parameters(autopilot.hold_mode))
            commands = FallbackCommands(
                self._link.check_motion(hold), self._link.check_motion(mode),
                lambda: self._link.fresh_mode(self._limits.max_mode_age_s) == autopilot.control_mode,
            )  # fmt: skip
        self._watchdog.kick(now_s, commands)

    def _status(self, seen: Observed, estimate: SubjectEstimate | None, sent: Action) -> ControlStatus:
        subject = np.full(3, np.nan)
        yaw_error = omega = math.nan
        if estimate is not None:
            subject = estimate.position
            sight, drift = seen.position[:2] - subject[:2], seen.velocity[:2] - estimate.velocity[:2]
            omega = math.degrees((sight[0] * drift[1] - sight[1] * drift[0]) / max(float(sight @ sight), 0.01))
            bearing = math.atan2(-sight[1], -sight[0])
            yaw_error = math.degrees(math.remainder(seen.yaw - bearing, 2 * math.pi)) if sight.any() else math.nan
        orbiting, present = self.safety.state == State.ORBITING, self.safety.condition
        if orbiting and self._orbit is not None:
            framed_m = self._framed_radius_m
            present, flown = widened_condition(present, self._goal, self._orbit, framed_m, self._config)
            present = slowed_condition(present, flown, seen, self._limits)
        answers, self._answers = self._answers, []
        return ControlStatus(
            state=self.safety.state, condition=present, mode_failure=self._queue.failure(SET_MODE),
            answers=answers, radius_m=seen.subject_distance_m, height_m=seen.height_m, angular_speed_deg_s=omega,
            radius_error_m=seen.subject_distance_m - self._goal.radius_m if orbiting else math.nan,
            yaw_error_deg=yaw_error, subject_position=subject, action=sent,
        )  # fmt: skip
