"""Poses of a vehicle or camera that other systems recorded: odometry, poses and GPS, as of MAVROS.

By REP 103 and 105 a pose is that of a body (x forward, y left, z up) in a world with z up; MAVROS's is east, north, up.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from drocap_ros.flight.vehicle import ned_to_enu, orientation_to_ros
from drocap_ros.geometry.rotations import quaternion_multiply, unit_quaternions
from drocap_ros.recording.session import Message, Session, TopicInfo, header_stamp_ns, xyzw_of
from drocap_ros.recording.telemetry.log import VehicleTrack, at_stamps, from_first_fix

#: Types of poses, those that say most of their frames first; places on the earth; attitudes.
POSES = (
    *("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped"),
    "geometry_msgs/msg/TransformStamped",
)
PLACES, ATTITUDES = ("sensor_msgs/msg/NavSatFix",), ("sensor_msgs/msg/Imu", "geometry_msgs/msg/QuaternionStamped")
#: Topics of what a vehicle shall do, or of other things than it.
_NO_VEHICLE = re.compile(r"setpoint|goal|target|desired|command|home|reference|person|human|marker", re.IGNORECASE)
_CAMERA = re.compile(r"cam|optical|gimbal|mount", re.IGNORECASE)
#: Of a gimbal's and a camera's topic names these come first.
_USUAL = re.compile(r"local_position|global_position|/imu/data$|odom", re.IGNORECASE)
#: A camera's axes (x right, y down, z forward) to those of a body, x y z w.
_OPTICAL = np.array([0.5, -0.5, 0.5, 0.5])


def read_other_poses(session: Session) -> VehicleTrack | None:
    """Position and attitude of the vehicle, or of the camera where a frame's name says so; None without any."""
    pose, place, attitude = (_topic(session, types) for types in (POSES, PLACES, ATTITUDES))
    if pose is not None:
        rows = _rows(session, pose, _pose)
    elif attitude is not None:
        rows = _rows(session, attitude, _attitude)
    elif place is not None:
        rows = _rows(session, place, _fix)
    else:
        return None
    stamp_ns = np.array(sorted(rows), np.int64)
    if not len(stamp_ns):
        return None
    position, orientation = (np.array([rows[s][i] for s in stamp_ns.tolist()]) for i in (0, 1))
    by_camera = bool(np.mean([row[2] for row in rows.values()]) > 0.5)
    used = [pose or attitude or place]
    if pose is None and place is not None:
        fixes = _rows(session, place, _fix)
        known_ns = np.array(sorted(fixes), np.int64)
        enu = from_first_fix(np.array([fixes[s][0] for s in known_ns.tolist()]))
        if enu is not None:
            position = at_stamps(known_ns, enu, stamp_ns, spherical=False)
            used += [place] if attitude is not None else []
    unknown = np.full((len(stamp_ns), 4), np.nan)
    turned = unit_quaternions(orientation)
    names = " and ".join(f"{topic.name} ({topic.type_name})" for topic in used if topic is not None)
    session.warn(f"the {'camera' if by_camera else 'vehicle'} is where {names} has it, its world taken as z up")
    body, camera = (unknown, turned) if by_camera else (turned, unknown)
    return VehicleTrack(stamp_ns, position, body, camera)


def _topic(session: Session, types: tuple[str, ...]) -> TopicInfo | None:
    """The topic of these types with a usual name, else of the first type, else with most messages; others are named."""
    found = [topic for topic in session.topics_of(*types) if not _NO_VEHICLE.search(topic.name)]
    best = min(found, key=lambda t: (not _USUAL.search(t.name), types.index(t.type_name), -t.count), default=None)
    if len(found) > 1:
        session.warn(f"several topics of poses: {', '.join(t.name for t in found)}; took {best.name if best else ''}")
    return best


_Row = tuple[np.ndarray, np.ndarray, bool]


def _rows(session: Session, topic: TopicInfo, read: Callable[[Message], _Row]) -> dict[int, _Row]:
    """Rows by their stamps, or by the recorder's times where the stamps do not advance."""
    found = [
        (header_stamp_ns(message), raw.log_time_ns, read(message)) for raw, message in session.messages((topic.name,))
    ]
    at = int(len({stamp_ns for stamp_ns, _, _ in found}) < len(found) / 2)
    if at:
        session.warn(f"the stamps on {topic.name} do not advance: the recorder's times are used, late by the transport")
    return {times[at]: row for *times, row in found}


def _attitude(message: Message) -> _Row:
    turn = message.orientation if hasattr(message, "orientation") else message.quaternion
    unknown = np.ravel(getattr(message, "orientation_covariance", 0.0))[0] == -1  # as sensor_msgs/Imu says
    return np.full(3, np.nan), np.full(4, np.nan) if unknown else xyzw_of(turn), False


def _pose(message: Message) -> _Row:
    """Position m ENU, attitude x y z w FLU -> ENU, and whether it is the camera's."""
    if hasattr(message, "transform"):
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        place, turn = pose.position, pose.orientation
    position, attitude = np.array([place.x, place.y, place.z], np.float64), xyzw_of(turn)
    frame, child = str(message.header.frame_id), str(getattr(message, "child_frame_id", ""))
    if "optical" in child.lower():
        attitude = quaternion_multiply(attitude[None], _OPTICAL[None])[0]
    if re.search(r"(^|[_/])ned\b", frame, re.IGNORECASE):
        position, attitude = ned_to_enu(position), orientation_to_ros(attitude)
    return position, attitude, bool(_CAMERA.search(child))


def _fix(message: Message) -> _Row:
    known = int(message.status.status) >= 0
    place = np.array([message.latitude, message.longitude, message.altitude], np.float64)
    return place if known else np.full(3, np.nan), np.full(4, np.nan), False
