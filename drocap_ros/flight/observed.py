"""What is observed at the instant of one control step: a value that is built once, by ``orbit/observer.py``.

Ages are in s, infinite = never; vectors are ENU; unknown = NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot.autopilot import UNKNOWN, Autopilot, LossSettings
from drocap_ros.flight.conditions import Condition, ConditionCode

FIX_3D: int = mavlink.GPS_FIX_TYPE_3D_FIX


def _unknown() -> np.ndarray:
    return np.full(3, np.nan)


@dataclass(frozen=True)
class Mode:
    """The flight mode.

    in_control, in_hold : it is the mode in which the autopilot follows us; it is its hold mode
    heard : all modes that were reported since the last step, late ones too; empty = the mode alone
    left_by_itself : whether the autopilot left the control mode as for the loss of setpoints, and nobody chose this
    """

    name: str = ""
    in_control: bool = False
    in_hold: bool = False
    heard: frozenset[str] = frozenset()
    left_by_itself: bool = False


@dataclass(frozen=True)
class Link:
    """The link to the autopilot.

    heartbeat_age_s : since the newest report of the mode
    round_trip_s : since the sending of the message that was answered last; NaN = no answer yet
    packet_loss : share of the vehicle's last packets that have not arrived
    stream_gap_s : since the last setpoint left
    vehicles : MAVLink systems of the autopilots on the link, unless the operator has chosen one
    """

    age_s: float = math.inf
    heartbeat_age_s: float = math.inf
    round_trip_s: float = math.nan
    packet_loss: float = 0.0
    stream_gap_s: float = 0.0
    vehicles: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Health:
    """What the autopilot reports of itself.

    system_status : MAV_STATE; 0 = unknown
    age_s : of the oldest of these reports
    """

    armed: bool = False
    system_status: int = 0
    landed_state: int = 0
    gps_fix_type: int = 0
    position_ok: bool = False
    battery_fraction: float = math.nan
    battery_voltage_v: float = math.nan
    age_s: float = math.inf

    @property
    def located(self) -> bool:
        """Whether the autopilot knows its position."""
        return self.position_ok and self.gps_fix_type >= FIX_3D


class Height(NamedTuple):
    """A height in m and its standard deviation; NaN = unknown."""

    m: float = math.nan
    sd_m: float = math.inf


NO_HEIGHT = Height()


@dataclass(frozen=True)
class Motion:
    """The vehicle's motion.

    position, velocity : (3,) m, m/s; the position as reported, extrapolated over the age of the state; the velocity of
        the filter
    velocity_offset : (3,) m/s, reported minus filtered velocity: the autopilot flies by the reported one
    height : above the subject's ground, as reported
    clearance_m : of a range finder that looks down; NaN = none
    age_s : of the attitude
    position_age_s : since the reported position last changed, so frozen telemetry ages too
    """

    position: np.ndarray = field(default_factory=_unknown)
    velocity: np.ndarray = field(default_factory=_unknown)
    velocity_offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    yaw: float = math.nan
    height: Height = NO_HEIGHT
    clearance_m: float = math.nan
    age_s: float = math.inf
    position_age_s: float = math.inf

    @property
    def known(self) -> bool:
        """Whether position, velocity and heading are known."""
        return bool(np.isfinite(self.position).all() and np.isfinite(self.velocity).all()) and math.isfinite(self.yaw)


class SizeSight(NamedTuple):
    """The subject by the size and the bearing of his image alone, as the vehicle sees him now.

    toward : (2,) direction to him
    nearest_m, farthest_m : of his distance, by two standard deviations of body and image
    receding_m_s : at which he surely walks away, negative towards the vehicle
    age_s : of the last image that was sure
    contradicted : whether a later one showed him where he cannot be
    """

    distance_m: float
    toward: np.ndarray
    nearest_m: float
    farthest_m: float
    receding_m_s: float
    age_s: float
    contradicted: bool


@dataclass(frozen=True)
class Subject:
    """The subject, in the frame of the reported position.

    position : (3,) m; None = nobody was located
    contradicted : whether images since he was located showed something else in his place
    nearer : share of his distance by which the nearer of body size and ground puts him nearer
    ground : his ground by his body alone, which the reported height has no part in
    heading_error : rad, of the vehicle, reported less true, as the pictures of him show it
    distance_m : horizontal
    closing_m_s, approach_m_s : speed of the vehicle towards him, and of him towards the vehicle
    approach_sd_m_s : standard deviation of ``approach_m_s``
    by_size : by his image alone; None = no image had a size
    """

    position: np.ndarray | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    age_s: float = math.inf
    contradicted: bool = False
    sd_m: float = math.inf
    nearer: float = 0.0
    ground: Height = NO_HEIGHT
    heading_error: float = 0.0
    distance_m: float = math.nan
    closing_m_s: float = 0.0
    approach_m_s: float = 0.0
    approach_sd_m_s: float = 0.0
    by_size: SizeSight | None = None


@dataclass(frozen=True)
class Pictures:
    """The pictures, whatever they show.

    age_s : since the exposure of the newest one
    silent_s : since it arrived
    frozen : whether its keypoints are those of the one before, bit for bit
    calibrated : whether the camera's matrix is known, without which no subject is located
    camera_problem : why the camera's attitude is unknown
    """

    age_s: float = math.inf
    silent_s: float = math.inf
    frozen: bool = False
    calibrated: bool = True
    camera_problem: Condition | None = None


@dataclass(frozen=True)
class Course:
    """How the vehicle flies what is commanded.

    followed : whether the autopilot follows our setpoints; if not, only a mode can stop it
    away_m, away_s : from its place on the orbit, and for how long this has been too far
    """

    followed: bool = True
    away_m: float = 0.0
    away_s: float = 0.0


@dataclass(frozen=True)
class Observed:
    """Vehicle, link and subject at one instant.

    autopilot_name : for people; with the type of a vehicle that nothing here flies
    loss_settings : the autopilot's settings for the loss of setpoints
    intruder : another one that commands, or whose keypoints would be followed
    disturbance : a condition that ends motion and that no other field shows
    operator_age_s : since the last sign of the operator
    stalled_s : for how long our own loop has just stood still; 0 = it has not, and a long stand is a disturbance too
    refusal : why the autopilot does not enter the requested mode, as a sentence; "" = it does not refuse
    """

    autopilot: Autopilot = UNKNOWN
    autopilot_name: str = UNKNOWN.name
    loss_settings: LossSettings | None = None
    mode: Mode = Mode()
    link: Link = Link()
    health: Health = Health()
    vehicle: Motion = field(default_factory=Motion)
    subject: Subject = field(default_factory=Subject)
    pictures: Pictures = Pictures()
    course: Course = Course()
    intruder: Condition | None = None
    disturbance: Condition | None = None
    operator_age_s: float = math.inf
    stalled_s: float = 0.0
    refusal: str = ""

    @property
    def heights(self) -> dict[str, Height]:
        """The vehicle's height above the subject's ground by everything that tells it, the reported one first."""
        ground, clearance_m = self.subject.ground, self.vehicle.clearance_m
        # The ground below the vehicle differs from the subject's by half a metre.
        heights = {
            "as reported": self.vehicle.height,
            "by the subject's image": Height(float(self.vehicle.position[2]) - ground.m, ground.sd_m),
            "by the range finder": Height(clearance_m, 0.5),
        }
        return {source: height for source, height in heights.items() if math.isfinite(height.m)}

    @property
    def jumped(self) -> bool:
        """Whether the reported position has jumped: what was latched in it names another place now."""
        return self.disturbance is not None and self.disturbance.code == ConditionCode.POSITION_JUMPED
