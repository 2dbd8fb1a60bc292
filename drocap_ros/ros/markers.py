"""Poses and camera path as ``visualization_msgs/MarkerArray`` and TF: pure functions of messages."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped, Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import ImageMarker, Marker, MarkerArray

from drocap_ros.geometry.ellipsoids import ellipsoids, unpack_covariance
from drocap_ros.msg import Pose2D, Pose3D
from drocap_ros.ros.conversions import pose2d_from_ros, pose3d_from_ros, quaternion_to_ros, transform_to_ros
from drocap_ros.skeleton import SIDE_COLOURS, JointSet, joint_set, side_of

#: Colours, red, green, blue and opacity from 0 to 1: a joint is seen through its ellipsoid; a judgement.
_UNCERTAIN = (0.95, 0.75, 0.1, 0.25)
_PATH = (0.2, 0.7, 0.3, 0.9)  # likewise
#: Ellipsoids show two standard deviations.
_SIGMAS = 2.0


def pose_markers(message: Pose3D, lifetime_s: float) -> MarkerArray:
    """Skeleton, joints and their uncertainty ellipsoids of one pose, in the pose's frame, for ``lifetime_s``."""
    joints, _ = pose3d_from_ros(message)
    if not len(joints):
        return MarkerArray()
    joints_of = joint_set(message.skeleton)
    known = np.isfinite(joints).all(axis=1)
    bones = [bone for bone in joints_of.bones if known[bone].all()]
    lines = _marker(message.header, "skeleton", Marker.LINE_LIST)
    lines.scale.x = 0.03
    for bone in bones:
        colour = _side_colour(joints_of, int(bone[1]))
        lines.points += [_point(joints[i]) for i in bone]
        lines.colors += [colour, colour]
    balls = _marker(message.header, "joints", Marker.SPHERE_LIST)
    balls.scale = Vector3(x=0.05, y=0.05, z=0.05)
    for i in np.nonzero(known)[0]:
        balls.points.append(_point(joints[i]))
        balls.colors.append(_side_colour(joints_of, int(i)))
    markers = [lines, balls, *_ellipsoids(message, joints, known)]
    for marker in markers:
        marker.lifetime = Duration(sec=int(lifetime_s), nanosec=int(lifetime_s % 1 * 1e9))
    return MarkerArray(markers=markers)


def _ellipsoids(message: Pose3D, joints: np.ndarray, known: np.ndarray) -> list[Marker]:
    flat = np.array(message.covariance, np.float64)
    if flat.size != 6 * len(joints):
        return []
    covariance = flat.reshape(-1, 6)
    use = known & np.isfinite(covariance).all(axis=1)
    orientations, half_axes = ellipsoids(unpack_covariance(covariance[use]), _SIGMAS)
    markers = []
    for number, xyzw, size in zip(np.nonzero(use)[0], orientations, 2.0 * half_axes, strict=True):
        ball = _marker(message.header, "uncertainty", Marker.SPHERE, int(number))
        ball.pose = Pose(position=_point(joints[number]), orientation=quaternion_to_ros(xyzw))
        ball.scale = Vector3(x=float(size[0]), y=float(size[1]), z=float(size[2]))
        ball.color = _colour(*_UNCERTAIN)
        markers.append(ball)
    return markers


def path_marker(header: Header, positions: np.ndarray) -> Marker:
    """Path of the camera (N, 3) m in the header's frame, as a line."""
    line = _marker(header, "camera_path", Marker.LINE_STRIP)
    line.scale.x = 0.04
    line.color = _colour(*_PATH)
    line.points = [_point(p) for p in positions]
    return line


def keypoint_marker(message: Pose2D) -> ImageMarker:
    """Bones and a cross on each keypoint, drawn over the image; without a subject the previous marker is removed.

    One marker of lines, not one per joint: viewers keep only the last message of a topic of image markers.
    """
    observation = pose2d_from_ros(message)
    marker = ImageMarker(header=message.header, ns="keypoints", type=ImageMarker.LINE_LIST, action=ImageMarker.ADD)
    if not observation.has_subject:
        marker.action = ImageMarker.REMOVE
        return marker
    joints_of, points = observation.joints, observation.keypoints.astype(np.float64)
    known = np.isfinite(points).all(axis=1)
    size = max(2.0, 0.004 * max(observation.image_size))
    marker.scale = float(max(1.0, 0.4 * size))
    marker.outline_color = _colour_of("middle")
    for bone in joints_of.bones:
        if known[bone].all():
            _line(marker, points[bone[0]], points[bone[1]], _side_colour(joints_of, int(bone[1])))
    for i in np.nonzero(known)[0]:
        colour = _side_colour(joints_of, int(i))
        for arm in (np.array([size, 0.0]), np.array([0.0, size])):
            _line(marker, points[i] - arm, points[i] + arm, colour)
    return marker


def _line(marker: ImageMarker, start: np.ndarray, end: np.ndarray, colour: ColorRGBA) -> None:
    for p in (start, end):
        marker.points.append(Point(x=float(p[0]), y=float(p[1])))
        marker.outline_colors.append(colour)


def body_transforms(message: Pose3D, frame_prefix: str = "") -> list[TransformStamped]:
    """One frame per joint, ``<prefix>body_<id>/<joint>``, for viewers that draw no markers."""
    joints, _ = pose3d_from_ros(message)
    return [
        transform_to_ros(message.header, f"{frame_prefix}body_{message.track_id}/{name}", p)
        for name, p in zip(joint_set(message.skeleton).joints, joints, strict=False)
        if np.isfinite(p).all()
    ]


def _marker(header: Header, namespace: str, kind: int, number: int = 0) -> Marker:
    marker = Marker(header=header, ns=namespace, id=number, type=kind, action=Marker.ADD)
    marker.pose.orientation = Quaternion(w=1.0)
    marker.color = _colour_of("middle")
    return marker


def _side_colour(joints: JointSet, joint: int) -> ColorRGBA:
    return _colour_of(side_of(joints.joints[joint], joints.joints))


def _colour_of(side: str) -> ColorRGBA:
    red, green, blue = (part / 255.0 for part in SIDE_COLOURS[side])
    return _colour(red, green, blue, 1.0)


def _colour(red: float, green: float, blue: float, alpha: float) -> ColorRGBA:
    return ColorRGBA(r=red, g=green, b=blue, a=alpha)


def _point(p: np.ndarray) -> Point:
    return Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))
