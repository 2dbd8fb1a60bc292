"""One step of the control loop: what is observed, what may be done, what is sent.

The node and the simulation run this same object.  It reads no clock and owns no thread.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.coasting import Setpoint, hold_setpoint
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.mavlink.commands import (
    GIMBAL_PITCH,
    SET_MODE,
    CommandQueue,
    command_message,
    halt_message,
    setpoint_message,
)
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.command_checks import CommandDesk
from drocap_ros.flight.orbit.observer import Observer, OwnFlight
from drocap_ros.flight.orbit.safety import permit_mode, reduce, way_out
from drocap_ros.flight.orbit.setpoint import FlownOrbit
from drocap_ros.flight.orbit.states import (
    Action,
    CommandAnswer,
    Fault,
    Holding,
    Idle,
    ModeRequest,
    OperatorCommand,
    Orbiting,
    Requesting,
    SafetyState,
    State,
)
from drocap_ros.flight.orbit.watchdog import FallbackCommands, Watchdog
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.keypoints import PoseObservation


class ControlStatus(NamedTuple):
    """Outcome of one step: the fields of ``msg/OrbitStatus.msg``, the commands it answered, and what was sent.

    failed : why the last engage ended without an orbit; None = it did not, or another command has followed
    mode_failure : why the autopilot did not enter the requested mode, as a sentence; "" = it did, or none was requested
    way_out : what the operator may do next, as a sentence; "" = nothing
    """

    state: State
    condition: Condition
    failed: Condition | None
    mode_failure: str
    way_out: str
    answers: list[tuple[OperatorCommand, CommandAnswer]]
    radius_m: float
    height_m: float
    angular_speed_deg_s: float
    radius_error_m: float
    yaw_error_deg: float
    subject_position: np.ndarray
    action: Action

    @property
    def reason(self) -> str:
        """Why the controller is in its state, and what leads out of it, as a sentence."""
        failed = "" if self.failed in (None, self.condition) else str(self.failed)
        present = f"{self.condition} ({self.mode_failure})" if self.mode_failure else str(self.condition)
        return "; ".join(filter(None, (present, failed, self.way_out)))


class OrbitController:
    """Flies the orbit through a link.  States, images and commands may come from other threads than the steps.

    link : to the autopilot; it sends motion only with ``commands_enabled``
    watchdog : gets the fallback commands of every step, when given
    """

    def __init__(self, link: MavlinkLink, config: MavlinkBridgeConfig, watchdog: Watchdog | None = None) -> None:
        self._link, self._config, self._watchdog = link, config, watchdog
        self._observer, self._desk = Observer(config), CommandDesk(config)
        self._orbit = FlownOrbit(config)
        self._queue = CommandQueue()
        self._lock = threading.Lock()
        self.safety: SafetyState = Idle()
        self._fallback: Setpoint | None = None  # what the watchdog holds if this loop hangs
        self._gimbal_s = -math.inf
        #: Another one that commands or is followed, found in the graph; any thread may set it.
        self.intruder: Condition | None = None

    @property
    def calibrated(self) -> bool:
        """Whether a camera matrix has arrived."""
        return self._observer.framing.matrix is not None

    # -- inputs ----------------------------------------------------------------------------------------
    def on_state(self, state: VehicleState) -> None:
        """Take a state of the vehicle."""
        with self._lock:
            self._observer.on_state(state)

    def on_camera(self, camera_matrix: np.ndarray) -> None:
        """Take the camera matrix (3, 3) px; raises as :meth:`Framing.calibrate`.  A change ends the motion."""
        with self._lock:
            self._observer.on_camera(camera_matrix)

    def on_pose2d(self, observation: PoseObservation) -> None:
        """Take the keypoints of one image."""
        with self._lock:
            self._observer.on_pose2d(observation, locked=self.safety.bound)

    def command(self, command: OperatorCommand) -> None:
        """Take a command; a step answers it.  Each step answers one, and a stop before all others."""
        with self._lock:
            self._desk.take(command)

    # -- one step --------------------------------------------------------------------------------------
    def step(self, now_ns: int, now_s: float) -> ControlStatus:
        """One step of the control loop.

        now_ns : clock of the stamps
        now_s : monotonic
        """
        with self._lock:
            return self._step(now_ns, now_s)

    def _step(self, now_ns: int, now_s: float) -> ControlStatus:
        self._link.decided_s = now_s
        hung = self._watchdog_acted()
        orbiting_s = now_s - self.safety.since_s if self.safety.state == State.ORBITING else 0.0
        refusal = self._queue.failure(SET_MODE)
        unheard_s = now_s - self._desk.operator_s
        own = OwnFlight(orbiting_s, self._orbit.place, hung, self._orbit.unsafe, self.intruder, refusal, unheard_s)
        seen, dt = self._observer.observe(self._link, now_ns, now_s, own)
        request = self._decide(seen, now_ns, now_s, hung=hung)
        self._observer.forget_changed_camera()
        self._request_mode(request[1], seen, now_s)
        sent = self._send(request[0], seen, dt)
        self._send_commands(seen, now_s)
        self._leave_fallback(seen, now_s)
        return self._status(seen, sent)

    def _watchdog_acted(self) -> bool:
        """Whether the watchdog has acted since the last step; a mode that it has requested is no take-over."""
        hung, requested = self._watchdog.take_fired() if self._watchdog else (False, False)
        vehicle = self._observer.vehicle
        if requested and vehicle is not None:
            self.safety = permit_mode(self.safety, autopilot_of(vehicle.autopilot).hold_mode)
        return hung

    def _decide(self, seen: Observed, now_ns: int, now_s: float, *, hung: bool) -> tuple[Action, ModeRequest]:
        """The next state of the machine, and what may be sent in it; executes a command."""
        self._desk.hear_operator(now_ns, now_s)
        order = self._desk.next(now_ns, self.safety, self._orbit.goal, self._observer.framing)
        before = self.safety
        self.safety, decision = reduce(before, seen, now_s, order.kind if order else None, self._config)
        if order is not None and decision.answer is not None:
            self._desk.answer(order.command, decision.answer)
            if decision.answer.accepted:
                self._orbit.take(order)
        if hung and not seen.jumped:
            self._hold_as_watchdog()
        if self.safety.state != before.state:
            self._on_change(seen)
        return decision.action, decision.mode_request

    def _hold_as_watchdog(self) -> None:
        """The watchdog already holds a position: a new one, farther on, would let the vehicle move on."""
        held = self._fallback
        if held is not None and isinstance(self.safety, Holding) and not isinstance(self.safety, Fault):
            self.safety = dataclasses.replace(self.safety, position=held.position, yaw=held.yaw)

    def _on_change(self, seen: Observed) -> None:
        if self.safety.state == State.ORBITING and seen.subject.position is not None:
            self._orbit.begin(seen)
        else:
            self._orbit.end()
        if self.safety.state in (State.TAKEN_OVER, State.IDLE):
            self._queue.cancel_all()

    def _request_mode(self, request: ModeRequest, seen: Observed, now_s: float) -> None:
        autopilot = seen.autopilot
        if request == ModeRequest.NONE or not autopilot.supported:
            # A request that waits for a visible mode is not sent, but it is not forgotten either: a mode that was
            # granted must not be requested again.
            holds = isinstance(self.safety, Holding) and not seen.mode.in_hold
            waits = holds or isinstance(self.safety, Requesting)
            (self._queue.pause if waits else self._queue.cancel)(SET_MODE)
            return
        mode = autopilot.hold_mode if request == ModeRequest.HOLD else autopilot.control_mode
        self.safety = permit_mode(self.safety, mode)
        self._queue.request(SET_MODE, autopilot.mode_parameters(mode), f"mode {mode}", now_s)

    def _send(self, action: Action, seen: Observed, dt: float) -> Action:
        mav, target, safety = self._link.mav, self._link.target, self.safety
        setpoint: Setpoint | None = None
        if isinstance(safety, Orbiting):
            setpoint = self._orbit.setpoint(seen, safety, self._observer.framing, dt)
            # A setpoint that stands stays at zero: nothing moves by an estimate alone.
            # Speed below which a setpoint stands.
            if setpoint is not None and math.sqrt(setpoint.velocity @ setpoint.velocity) > 0.05:
                # The autopilot's loop compares it with the velocity that it reports, error included.
                setpoint = setpoint._replace(velocity=setpoint.velocity + seen.vehicle.velocity_offset)
        elif action == Action.HOLD and isinstance(safety, Requesting | Holding) and safety.position is not None:
            setpoint = hold_setpoint(safety.position, safety.yaw)
        if setpoint is not None and setpoint.is_finite():
            self._link.send_motion(setpoint_message(mav, target, setpoint))
            return action
        if action != Action.NOTHING and target[1]:
            self._link.send_motion(halt_message(mav, target))
            return Action.HALT
        return Action.NOTHING

    def _send_commands(self, seen: Observed, now_s: float) -> None:
        for command, result in self._link.take_answers():
            self._queue.acknowledge(command, result, now_s)
        if self._queue.failure(GIMBAL_PITCH):
            self._gimbal_s, self._observer.framing.follows = math.inf, False  # there is no mount: no further requests
        subject, wanted = seen.subject.position, self._config.gimbal_control and self.safety.state == State.ORBITING
        # Radius and height change slowly: two pitches of the mount a second will do.
        if wanted and subject is not None and now_s - self._gimbal_s > 0.5:
            drop = float(seen.vehicle.position[2] - subject[2])
            pitch = -math.degrees(math.atan2(drop, max(seen.subject.distance_m, 0.1)))
            nan = math.nan
            self._queue.request(GIMBAL_PITCH, (round(pitch, 1), 0.0, nan, nan, 0.0, 0.0, 0.0), "gimbal pitch", now_s)
            self._gimbal_s = now_s
        for command, confirmation, parameters in self._queue.due(now_s):
            message = command_message(self._link.mav, self._link.target, command, confirmation, parameters)
            self._link.send_motion(message)

    def _leave_fallback(self, seen: Observed, now_s: float) -> None:
        if self._watchdog is None:
            return
        commands, vehicle, autopilot = None, seen.vehicle, seen.autopilot
        if self.safety.state == State.ORBITING and np.isfinite(vehicle.position).all() and math.isfinite(vehicle.yaw):
            mav, target = self._link.mav, self._link.target
            self._fallback = hold_setpoint(vehicle.position, vehicle.yaw)
            hold = setpoint_message(mav, target, self._fallback)
            mode = command_message(mav, target, SET_MODE, 0, autopilot.mode_parameters(autopilot.hold_mode))
            commands = FallbackCommands(
                self._link.check_motion(hold),
                self._link.check_motion(mode),
                lambda: self._link.fresh_mode(self._config.max_mode_age_s) == autopilot.control_mode,
                lambda: self._link.estimator.modes.mode != autopilot.control_mode,
            )
        self._watchdog.kick(now_s, commands)

    def _status(self, seen: Observed, sent: Action) -> ControlStatus:
        vehicle, subject = seen.vehicle, np.full(3, np.nan)
        yaw_error = omega = math.nan
        if seen.subject.position is not None:
            subject = seen.subject.position
            sight, drift = vehicle.position[:2] - subject[:2], vehicle.velocity[:2] - seen.subject.velocity[:2]
            omega = math.degrees((sight[0] * drift[1] - sight[1] * drift[0]) / max(float(sight @ sight), 0.01))
            bearing = math.atan2(-sight[1], -sight[0])
            off = vehicle.yaw - seen.subject.heading_error - bearing
            yaw_error = math.degrees(math.remainder(off, 2 * math.pi)) if sight.any() else math.nan
        orbiting, present = self.safety.state == State.ORBITING, self.safety.condition
        distance_m = seen.subject.distance_m
        return ControlStatus(
            state=self.safety.state,
            condition=self._orbit.flown_condition(present, seen) if orbiting else present,
            failed=self.safety.failed if isinstance(self.safety, Idle) else None,
            mode_failure=self._queue.failure(SET_MODE),
            way_out=way_out(self.safety, seen, self._config),
            answers=self._desk.take_answers(),
            radius_m=distance_m,
            height_m=vehicle.height.m,
            angular_speed_deg_s=omega,
            radius_error_m=distance_m - self._orbit.goal.radius_m if orbiting else math.nan,
            yaw_error_deg=yaw_error,
            subject_position=subject,
            action=sent,
        )
