"""Gathers what the safety machine decides by: vehicle, link and subject at the instant of one step."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.orbit.states import Observed
from drocap_ros.flight.subject.subject_filter import SubjectEstimate
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion

_NS = 1_000_000_000
_MAX_EXTRAPOLATION_S = 0.3
_POSITION_JUMP_M, _JUMP_PERIOD_S = 1.0, 0.5
_FADES_S = 4.0  # in recorded flights of both autopilots the steps added up to 0.2 m at most
#: MAV_TYPE of the vehicles for which the control was made: multirotors, and a helicopter under the same autopilot.
_MULTIROTORS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})
_STATUS_MESSAGES = (("GPS_RAW_INT",), ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS"), ("SYS_STATUS",))


def observe(
    link: MavlinkLink,
    config: MavlinkBridgeConfig,
    vehicle: VehicleState | None,
    estimate: SubjectEstimate | None,
    disturbance: Condition | None,
    not_followed: str,
    now_ns: int,
) -> Observed:
    """The observation of one step.

    Parameters
    ----------
    vehicle : latest state
    estimate : of the subject, in the frame of the reported position
    disturbance : of our own time or of the reported position
    not_followed : why the setpoints count as not followed, in words; "" = they are
    """
    if vehicle is None:
        return Observed(disturbance=disturbance)
    estimator = link.estimator
    heard = estimator.modes.take_heard()
    age_s = (now_ns - vehicle.stamp_ns) / _NS
    # The state is at the attitude's stamp; a moment later the vehicle is a little farther.
    position = vehicle.position_enu_m + np.nan_to_num(vehicle.velocity_enu_m_s) * min(
        max(age_s, 0.0), _MAX_EXTRAPOLATION_S
    )
    latest = estimator.snapshot(now_ns) or vehicle  # mode and health are newer than the attitude
    autopilot = autopilot_of(latest.autopilot)
    status_age = max(estimator.age_s(names, now_ns) for names in _STATUS_MESSAGES)
    distance, closing, approach, approach_sd = math.nan, 0.0, 0.0, 0.0
    if estimate is not None:
        offset = position[:2] - estimate.position[:2]
        distance = float(np.hypot(*offset))
        closing = -float(offset @ vehicle.velocity_enu_m_s[:2]) / max(distance, 1e-3)
        approach = float(offset @ estimate.velocity[:2]) / max(distance, 1e-3)
        approach_sd = math.sqrt(max(float(offset @ estimate.covariance[3:5, 3:5] @ offset), 0.0)) / max(distance, 1e-3)
    if not_followed and disturbance is None:
        disturbance = condition(ConditionCode.SETPOINTS_NOT_FOLLOWED, evidence=not_followed)
    followed = not not_followed or not autopilot.needs_mode_to_stop
    loss = link.settings.loss_settings()
    action = math.nan if loss is None else loss.action
    loss_modes = {} if autopilot.loss_action is None else autopilot.loss_action.modes
    loss_mode = loss_modes.get(int(action) if math.isfinite(action) else -1, latest.mode)
    flies = estimator.modes.vehicle_type in _MULTIROTORS
    trip_s, gap_s = link.answer_age_s(), link.stream_gap_s()
    jumped = disturbance is not None and disturbance.code == ConditionCode.POSITION_JUMPED
    if not jumped and (stood_s := link.decision_age_s()) > config.watchdog_s:
        # The process stood still within this step: what was read above belongs to different instants.
        disturbance = condition(ConditionCode.CONTROL_LOOP_STALLED, gap_s=stood_s)
    return Observed(
        autopilot=latest.autopilot if flies else f"{latest.autopilot}, vehicle type {estimator.modes.vehicle_type}",
        mode=latest.mode, in_control=latest.mode == autopilot.control_mode,
        in_hold=latest.mode == autopilot.hold_mode, heard=heard | {latest.mode},
        left_by_itself=estimator.modes.intended == autopilot.control_mode != latest.mode == loss_mode,
        armed=latest.armed, system_status=estimator.modes.system_status, landed_state=latest.landed_state,
        vehicles=frozenset() if config.target_system_id else estimator.systems,
        link_age_s=latest.link_age_s,
        heartbeat_age_s=estimator.modes.age_s(now_ns),
        state_age_s=abs(age_s),
        position_age_s=max(
            (now_ns - estimator.position_changed_ns) / _NS, estimator.position_behind_s() + abs(age_s)
        ),
        status_age_s=status_age, round_trip_s=trip_s, packet_loss=estimator.packets.loss,
        stream_gap_s=gap_s,
        gps_fix_type=latest.gps_fix_type, position_ok=latest.position_ok, battery_fraction=latest.battery_fraction,
        battery_voltage_v=latest.battery_voltage_v,
        position=position, velocity=np.asarray(vehicle.velocity_enu_m_s, float), yaw=_yaw(vehicle),
        height_m=float(position[2]) - config.ground_height_m,
        subject=None if estimate is None else estimate.position,
        subject_age_s=math.inf if estimate is None else estimate.age_s,
        subject_contradicted=estimate is not None and estimate.contradicted,
        subject_sd_m=math.inf if estimate is None else estimate.position_sd_m,
        subject_distance_m=distance, closing_m_s=closing, approach_m_s=approach, approach_sd_m_s=approach_sd,
        disturbance=disturbance, followed=followed, loss_settings=loss,
        camera_problem=estimator.mount.problem(autopilot, now_ns),
    )  # fmt: skip


class PositionJumps:
    """Finds jumps of the reported position: one step, or small ones that add up, as of an estimator that is reset."""

    def __init__(self) -> None:
        self._before: VehicleState | None = None  # the last one whose position was known
        self._drift = np.zeros(3)  # m, that velocity does not explain, and that fades
        self._greatest_m = 0.0

    def take(self, state: VehicleState) -> None:
        """Take a state of the vehicle; one without a position is left out, and the next may jump from before it."""
        if not np.isfinite(state.position_enu_m).all():
            return
        before, self._before = self._before, state
        if before is None:
            return
        since_s = (state.stamp_ns - before.stamp_ns) / _NS
        # Stamps may jump with the position, as where the autopilot restarts: the way since then is bounded anyway.
        dt = min(max(since_s, 0.0), _JUMP_PERIOD_S)
        mean = 0.5 * (before.velocity_enu_m_s + state.velocity_enu_m_s)
        step = state.position_enu_m - before.position_enu_m - mean * dt
        if not np.isfinite(step).all():
            return
        known = 0.0 <= since_s <= _JUMP_PERIOD_S
        self._drift = math.exp(-dt / _FADES_S) * self._drift + (step if known else 0.0)
        jump_m = max(float(np.linalg.norm(step)), float(np.linalg.norm(self._drift)))
        if jump_m > _POSITION_JUMP_M:
            self._greatest_m, self._drift = max(self._greatest_m, jump_m), np.zeros(3)

    def pop(self) -> float:
        """Greatest jump in m since the last call; 0 = none."""
        greatest_m, self._greatest_m = self._greatest_m, 0.0
        return greatest_m


def _yaw(vehicle: VehicleState) -> float:
    """Yaw of the nose, rad from east."""
    if not np.isfinite(vehicle.orientation_xyzw).all():
        return math.nan
    nose = matrix_from_quaternion(vehicle.orientation_xyzw)[:, 0]
    return math.atan2(float(nose[1]), float(nose[0]))
