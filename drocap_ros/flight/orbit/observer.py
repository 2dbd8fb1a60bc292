"""What is observed of vehicle, link, subject and pictures: everything that arrives, and the one value of each step."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.autopilot import UNKNOWN
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.observed import (
    Course,
    Health,
    Height,
    Link,
    Mode,
    Motion,
    Observed,
    Pictures,
    SizeSight,
    Subject,
)
from drocap_ros.flight.orbit.following import Echoes, Following, Keeping
from drocap_ros.flight.orbit.motion_checks import stalled_condition
from drocap_ros.flight.subject.framing import Framing
from drocap_ros.flight.subject.guard import Guard
from drocap_ros.flight.subject.subject_filter import SubjectEstimate, SubjectFilter
from drocap_ros.flight.vehicle import Doubt, PoseHistory, VehicleFilter, VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.keypoints import PoseObservation
from drocap_ros.stamps import NS

#: MAV_TYPE of the vehicles for which the control was made: multirotors, and a helicopter under the same autopilot.
_MULTIROTORS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})
_STATUS_MESSAGES = (("GPS_RAW_INT",), ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS"), ("SYS_STATUS",))


class OwnFlight(NamedTuple):
    """What the controller itself adds to the observation.

    orbiting_s : how long the orbit has been flown; 0 = it is not
    reference : (3,) m, the place on the orbit; None = there is none
    hung : whether the watchdog has acted since the last step
    unsafe : why the setpoint of the last step was not sent
    intruder : another one that commands or is followed, found in the graph
    refusal : why the autopilot does not enter the requested mode, as a sentence; "" = it does not refuse
    operator_age_s : since the last sign of the operator
    """

    orbiting_s: float = 0.0
    reference: np.ndarray | None = None
    hung: bool = False
    unsafe: Condition | None = None
    intruder: Condition | None = None
    refusal: str = ""
    operator_age_s: float = math.inf


class Observer:
    """Takes what arrives between the steps, and builds the observation of a step.  It reads no clock.

    vehicle : latest state
    framing : of the present camera
    """

    def __init__(self, config: MavlinkBridgeConfig) -> None:
        self._config = config
        self.vehicle: VehicleState | None = None
        self.framing = Framing(config)
        self._filter, self._doubt = VehicleFilter(UNKNOWN.velocity_sd_m_s), Doubt()
        self._history, self._pictures = PoseHistory(), PictureWatch()
        self._subject, self._guard = SubjectFilter(config), Guard(config)
        self._following, self._keeping = Following(config.max_echo_age_s, config.watchdog_s), Keeping(config)
        # Pictures wait for the camera's attitude: half a second at 30 Hz, older than any that is flown by.
        self._waiting: deque[tuple[PoseObservation, bool]] = deque(maxlen=16)
        self._before: tuple[int, float] | None = None  # stamp and monotonic time of the last step
        self._camera_changed: Condition | None = None  # since the last step

    def on_state(self, state: VehicleState) -> None:
        """Take a state of the vehicle."""
        if self.vehicle is None or self.vehicle.autopilot != state.autopilot:
            self._filter = VehicleFilter(autopilot_of(state.autopilot).velocity_sd_m_s)
        if np.isfinite(state.position_enu_m).all() and np.isfinite(state.velocity_enu_m_s).all():
            doubt = self._filter.take(state.stamp_ns / NS, state.position_enu_m, state.velocity_enu_m_s)
            self._doubt = self._doubt.worse(doubt)
            state = dataclasses.replace(state, velocity_enu_m_s=self._filter.velocity)
        self.vehicle = state
        self._history.add(state, self._filter.position)
        autopilot = autopilot_of(state.autopilot)
        self._subject.height_wanders = autopilot.height_wanders
        self._subject.heading_sd = math.radians(max(autopilot.heading_sd_deg, self._config.attitude_error_deg))
        self._locate()

    def on_camera(self, camera_matrix: np.ndarray) -> None:
        """Take the camera matrix (3, 3) px; raises as :meth:`Framing.calibrate`.  A change ends the motion."""
        self._camera_changed = self.framing.calibrate(camera_matrix) or self._camera_changed

    def on_pose2d(self, observation: PoseObservation, *, locked: bool) -> None:
        """Take the keypoints of one image; ``locked``: the vehicle flies by the present subject.

        It waits for a state after its exposure: the attitude of a body that starts or brakes is off by degrees 0.1 s
        later, whatever its rate was, and the range of the ankles by a metre.
        """
        stamp_ns = observation.stamp_ns - round(self._config.camera_latency_s * NS)
        observation = dataclasses.replace(observation, stamp_ns=stamp_ns)
        self.framing.size = observation.image_size
        if self._pictures.take(observation):
            self._waiting.append((observation, locked))
            self._locate()

    def _locate(self) -> None:
        """Locate the subject in the pictures whose camera's pose is known by now."""
        for _ in range(len(self._waiting)):
            observation, locked = self._waiting.popleft()
            if not self._history.reached(observation.stamp_ns):
                self._waiting.append((observation, locked))
                continue
            if (matrix := self.framing.matrix) is not None and self._camera_changed is None:
                camera = self._history.at(observation.stamp_ns)
                self._subject.update(observation, matrix, camera, locked=locked)
                self._guard.see(observation, matrix, camera, locked=locked)

    def observe(self, link: MavlinkLink, now_ns: int, now_s: float, own: OwnFlight) -> tuple[Observed, float]:
        """The observation of a step, and the time in s since the last one.

        now_ns : clock of the stamps
        now_s : monotonic
        """
        vehicle, config = self.vehicle, self._config
        before, self._before = self._before, (now_ns, now_s)
        dt = 0.0 if before is None else now_s - before[1]
        disturbance = self._own_disturbance(before, now_ns, dt, own)
        estimate = self._subject.estimate(now_ns)
        echoes = Echoes(link.sent_setpoints(), link.echo(), link.answer_age_s())
        not_followed = self._following.step(now_s, own.orbiting_s, echoes, vehicle)
        pictures = self._pictures.observed(now_ns, calibrated=self.framing.matrix is not None)
        if vehicle is None:
            return Observed(pictures=pictures, intruder=own.intruder, disturbance=disturbance), dt
        seen = observe_vehicle(link, config, vehicle, now_ns)
        motion = dataclasses.replace(seen.vehicle, velocity_offset=self._filter.velocity_offset)
        by_size = self._guard.sight(motion.position, self._history.offset, now_ns)
        subject = Subject() if estimate is None else _subject(estimate, self._history.offset, motion, by_size)
        away_m, away_s = self._keeping.watch(own.reference, motion.position, now_s)
        self.framing.watch(vehicle, motion.velocity, dt)
        followed = not not_followed or not seen.autopilot.needs_mode_to_stop
        if not_followed and disturbance is None:
            disturbance = condition(ConditionCode.SETPOINTS_NOT_FOLLOWED, evidence=not_followed)
        observed = dataclasses.replace(
            seen,
            vehicle=motion,
            subject=subject,
            pictures=dataclasses.replace(pictures, camera_problem=seen.pictures.camera_problem),
            course=Course(followed, away_m, away_s),
            intruder=own.intruder,
            disturbance=disturbance,
            refusal=own.refusal,
            operator_age_s=own.operator_age_s,
        )
        # Within this step the process may have stood still too: what was read above belongs to different instants.
        stood_s = max(dt, link.decision_age_s())
        if before is not None and (own.hung or stood_s > config.watchdog_s):
            observed = dataclasses.replace(observed, stalled_s=max(stood_s, config.watchdog_s))
            # Until its time-out the autopilot has flown the last setpoint, whose coast was judged.
            timeout_s = min(seen.autopilot.timeout_s(seen.loss_settings), config.max_control_timeout_s or math.inf, 0.5)
            if stood_s > max(config.watchdog_s, timeout_s) and not observed.jumped:
                observed = dataclasses.replace(observed, disturbance=stalled_condition(observed))
        return observed, dt

    def forget_changed_camera(self) -> None:
        """Begin anew with the subject after a change of the camera: the places so far were measured by another one."""
        if self._camera_changed is not None:
            self._camera_changed = None
            self._subject, self._guard = SubjectFilter(self._config), Guard(self._config)

    def _own_disturbance(
        self, before: tuple[int, float] | None, now_ns: int, dt: float, own: OwnFlight
    ) -> Condition | None:
        """Disturbance of our own time, of the reports, of the camera or of the setpoint since the last step."""
        if before is None:
            return self._camera_changed or own.unsafe
        jump_s = (now_ns - before[0]) / NS - dt
        # A subject's age would be wrong by a jump between the clock of the stamps and the monotonic one.
        if abs(jump_s) > 0.25:
            return condition(ConditionCode.CLOCK_JUMPED, jump_s=jump_s)
        doubt, self._doubt = self._doubt, Doubt()
        if doubt.jump_m > 0:
            return condition(ConditionCode.POSITION_JUMPED, jump_m=doubt.jump_m)
        if doubt.error_m_s > 0:
            return condition(ConditionCode.REPORTS_CONTRADICT, error_m_s=doubt.error_m_s)
        return self._camera_changed or own.unsafe


def observe_vehicle(link: MavlinkLink, config: MavlinkBridgeConfig, vehicle: VehicleState, now_ns: int) -> Observed:
    """The observation of vehicle and link alone; ``vehicle``: latest state."""
    estimator = link.estimator
    heard = estimator.modes.take_heard()
    age_s = (now_ns - vehicle.stamp_ns) / NS
    latest = estimator.snapshot(now_ns) or vehicle  # mode and health are newer than the attitude
    autopilot = autopilot_of(latest.autopilot)
    loss = link.settings.loss_settings()
    action = math.nan if loss is None else loss.action
    loss_modes = {} if autopilot.loss_action is None else autopilot.loss_action.modes
    loss_mode = loss_modes.get(int(action) if math.isfinite(action) else -1, latest.mode)
    vehicle_type = estimator.modes.vehicle_type
    flies = vehicle_type in _MULTIROTORS
    # The state is at the attitude's stamp; a moment later the vehicle is a little farther.
    # A velocity extrapolates no farther.
    moved_s = min(max(age_s, 0.0), 0.3)
    velocity = vehicle.velocity_enu_m_s
    moves = velocity if np.isfinite(velocity).all() else np.nan_to_num(velocity)
    position = vehicle.position_enu_m + moves * moved_s
    position_age_s = max((now_ns - estimator.position_changed_ns) / NS, estimator.position_behind_s() + abs(age_s))
    return Observed(
        autopilot=autopilot if flies else UNKNOWN,
        autopilot_name=latest.autopilot if flies else f"{latest.autopilot}, vehicle type {vehicle_type}",
        loss_settings=loss,
        mode=Mode(
            name=latest.mode,
            in_control=latest.mode == autopilot.control_mode,
            in_hold=latest.mode == autopilot.hold_mode,
            heard=heard | {latest.mode},
            left_by_itself=estimator.modes.intended == autopilot.control_mode != latest.mode == loss_mode,
        ),
        link=Link(
            age_s=latest.link_age_s,
            heartbeat_age_s=estimator.modes.age_s(now_ns),
            round_trip_s=link.answer_age_s(),
            packet_loss=estimator.packets.loss,
            stream_gap_s=link.stream_gap_s(),
            vehicles=frozenset() if config.target_system_id else estimator.systems,
        ),
        health=Health(
            armed=latest.armed,
            system_status=estimator.modes.system_status,
            landed_state=latest.landed_state,
            gps_fix_type=latest.gps_fix_type,
            position_ok=latest.position_ok,
            battery_fraction=latest.battery_fraction,
            battery_voltage_v=latest.battery_voltage_v,
            age_s=max(estimator.age_s(names, now_ns) for names in _STATUS_MESSAGES),
        ),
        vehicle=Motion(
            position=position,
            velocity=np.asarray(velocity, float),
            yaw=_yaw(vehicle),
            height=Height(float(position[2]) - config.ground_height_m, config.height_error_m),
            clearance_m=estimator.clearance_m(now_ns) * float(matrix_from_quaternion(vehicle.orientation_xyzw)[2, 2]),
            age_s=abs(age_s),
            position_age_s=position_age_s,
        ),
        pictures=Pictures(camera_problem=estimator.mount.problem(autopilot, now_ns)),
    )


def _subject(estimate: SubjectEstimate, offset: np.ndarray, motion: Motion, by_size: SizeSight | None) -> Subject:
    """The subject as filter and guard have him together: no surer than by the less sure one of them.

    offset : (3,) m, from the frame of the camera's poses to that of the reported position, in which is flown
    """
    place = estimate.position + offset
    sight = motion.position[:2] - place[:2]
    distance = float(np.hypot(*sight))
    spread = float(sight @ estimate.covariance[3:5, 3:5] @ sight)
    return Subject(
        position=place,
        velocity=estimate.velocity,
        # Without a size nothing bounds the closing speed.
        age_s=math.inf if by_size is None else max(estimate.age_s, by_size.age_s),
        contradicted=estimate.contradicted or (by_size is not None and by_size.contradicted),
        sd_m=estimate.position_sd_m,
        nearer=estimate.nearer,
        heading_error=estimate.heading_error,
        ground=Height(estimate.ground.m + float(offset[2]), estimate.ground.sd_m),
        distance_m=distance if by_size is None else min(distance, by_size.farthest_m),
        closing_m_s=-float(sight @ motion.velocity[:2]) / max(distance, 1e-3),
        approach_m_s=float(sight @ estimate.velocity[:2]) / max(distance, 1e-3),
        approach_sd_m_s=math.sqrt(max(spread, 0.0)) / max(distance, 1e-3),
        by_size=by_size,
    )


class PictureWatch:
    """When pictures come, how old they are then, and whether they stand still.  It reads no clock."""

    def __init__(self) -> None:
        self._last: PoseObservation | None = None
        self._frozen = False
        self._waits = False  # for the step that notes when the last one has come
        self._arrived_ns = 0

    def take(self, observation: PoseObservation) -> bool:
        """Take one image; returns whether it shows another instant than the one before."""
        last, self._last, self._waits = self._last, observation, True
        same = last is not None and np.array_equal(last.keypoints, observation.keypoints, equal_nan=True)
        self._frozen = same and bool(np.isfinite(observation.keypoints).any())  # nobody is no picture that stands still
        return not self._frozen

    def observed(self, now_ns: int, *, calibrated: bool) -> Pictures:
        """The pictures at the instant of a step."""
        if self._waits:
            self._waits, self._arrived_ns = False, now_ns
        if self._last is None:
            return Pictures(calibrated=calibrated)
        return Pictures(
            age_s=(now_ns - self._last.stamp_ns) / NS,
            silent_s=(now_ns - self._arrived_ns) / NS,
            frozen=self._frozen,
            calibrated=calibrated,
        )


def _yaw(vehicle: VehicleState) -> float:
    """Yaw of the nose, rad from east."""
    if not np.isfinite(vehicle.orientation_xyzw).all():
        return math.nan
    nose = matrix_from_quaternion(vehicle.orientation_xyzw)[:, 0]
    return math.atan2(float(nose[1]), float(nose[0]))
