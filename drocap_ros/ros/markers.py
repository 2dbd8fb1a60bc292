"""Poses and camera path as ``visualization_msgs/MarkerArray`` and TF: pure functions of messages."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped, Vector3
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA, Header, String
from visualization_msgs.msg import ImageMarker, Marker, MarkerArray

from drocap_ros.geometry.alignment import torso_frame
from drocap_ros.geometry.rotations import ellipsoids, quaternion_from_matrix, unpack_covariance
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import Pose2D, Pose3D
from drocap_ros.recording.session import Message
from drocap_ros.ros.conversions import pose2d_from_ros, pose3d_from_ros, quaternion_to_ros, transform_to_ros
from drocap_ros.ros.topics import KEPT_QOS
from drocap_ros.skeleton import COLOURS, JointSet, joint_set, side_of

try:
    import hri_msgs.msg as hri
except ImportError:  # optional: see above
    hri = None

AVAILABLE = hri is not None
MISSING = "hri_msgs is missing: only the frames of REP 155; install ros-$ROS_DISTRO-hri-msgs, or run `make setup`"
_BODIES, _PERSONS = "/humans/bodies", "/humans/persons"
_QOS = QoSProfile(depth=10)

_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
#: Our joint -> link of the human model.
LINKS = {"head": "head", **{f"{side}{part}": f"{side}_{part}" for side in "rl" for part in _PARTS}}
#: Our joint, and COCO's -> constant of Skeleton2D.
_CODES = {
    "neck": "NECK",
    "nose": "NOSE",
    **{f"{side}{part}": f"{word}_{part}".upper() for side, word in (("r", "right"), ("l", "left")) for part in _PARTS},
    **{f"{w}_{part}": f"{w}_{part}".upper() for w in ("right", "left") for part in (*_PARTS, "eye", "ear")},
}


def prefix_of(namespace: str, frame_prefix: str) -> str:
    """Prefix of the bodies of a graph: the given one, else the namespace, where it is not the usual one."""
    return frame_prefix or ("" if namespace == "/drocap" else namespace.strip("/"))


def body_id(track_id: int, frame_prefix: str = "") -> str:
    """Identifier of a track; the prefix distinguishes the bodies of two drones.  No name in ROS begins with a digit."""
    return "_".join([*filter(None, frame_prefix.split("/")), f"b{track_id}"])


def person_id(body: str) -> str:
    """Identifier of the person whose body it is: tracks are one person's, whose number is used for nobody else."""
    before, _, number = body.rpartition("b")
    return f"{before}p{number}"


def human_transforms(message: Pose3D, frame_prefix: str = "") -> list[TransformStamped]:
    """Frame ``body_<id>`` between the hips, x forward, z up along the trunk, and one per link of :data:`LINKS` in it.

    The links have the axes of the body: joints alone do not determine the rotation of a limb about itself.
    """
    joints = pose3d_from_ros(message).joints3d
    joints_of = joint_set(message.skeleton) if message.track_id else None
    if joints_of is None or not {"lhip", "rhip", "lshoulder", "rshoulder", "pelvis", "neck"} <= set(joints_of.joints):
        return []
    trunk = [joints_of.index(name) for name in ("lhip", "rhip", "lshoulder", "rshoulder", "pelvis", "neck")]
    if not np.isfinite(joints[trunk]).all():
        return []
    axes = torso_frame(joints, joints_of)
    middle = joints[trunk[:2]].mean(0)
    name = body_id(message.track_id, frame_prefix)
    body = transform_to_ros(message.header, f"body_{name}", middle, quaternion_from_matrix(axes))
    inside = (joints - middle) @ axes
    header = Header(stamp=message.header.stamp, frame_id=f"body_{name}")
    links = [
        transform_to_ros(header, f"{LINKS[joint]}_{name}", p)
        for joint, p in zip(joints_of.joints, inside, strict=True)
        if joint in LINKS and np.isfinite(p).all()
    ]
    return [body, *links]


def skeleton2d(observation: PoseObservation, header: Header) -> Message:
    """Keypoints as ``hri_msgs/Skeleton2D``; an unknown one, or one outside the image, has confidence 0."""
    message = hri.Skeleton2D(header=header)
    unit = observation.keypoints / np.array(observation.image_size)
    known = np.isfinite(unit).all(1) & (unit >= 0).all(1) & (unit <= 1).all(1)
    for i in np.nonzero(known)[0]:
        code = _CODES.get(observation.joints.joints[i])
        if code is not None:
            point = message.skeleton[getattr(hri.Skeleton2D, code)]
            point.x, point.y = (float(v) for v in unit[i])
            point.c = float(np.clip(observation.confidence[i], 0.0, 1.0))
    return message


def region(observation: PoseObservation, header: Header) -> Message:
    """Box as ``hri_msgs/NormalizedRegionOfInterest2D``."""
    size = np.tile(observation.image_size, 2)
    corners = np.clip(np.nan_to_num(observation.roi / size), 0.0, 1.0)
    names = ("xmin", "ymin", "xmax", "ymax")
    values = {name: float(v) for name, v in zip(names, corners, strict=True)}
    return hri.NormalizedRegionOfInterest2D(
        header=header, c=float(np.clip(observation.detection_score, 0.0, 1.0)), **values
    )


class HumanTopics:
    """Publishers of the tracked body; those of its own are destroyed when the track ends."""

    def __init__(self, node: Node, frame_prefix: str = "") -> None:
        self._node, self._prefix = node, frame_prefix
        self._ids = node.create_publisher(hri.IdsList, f"{_BODIES}/tracked", _QOS)
        self._persons = node.create_publisher(hri.IdsList, f"{_PERSONS}/tracked", _QOS)
        self._tracked = ""
        self._own: list[Publisher] = []

    def publish(self, message: Pose2D) -> None:
        """Publish the body's box, keypoints and identifiers."""
        observation = pose2d_from_ros(message)
        body = body_id(message.track_id, self._prefix) if observation.has_subject else ""
        if body != self._tracked:
            self._follow(body)
        ids = [body] if body else []
        self._ids.publish(hri.IdsList(header=message.header, ids=ids))
        self._persons.publish(hri.IdsList(header=message.header, ids=[person_id(name) for name in ids]))
        if body:
            skeletons, regions, _ = self._own
            skeletons.publish(skeleton2d(observation, message.header))
            regions.publish(region(observation, message.header))

    def _follow(self, body: str) -> None:
        for publisher in self._own:
            self._node.destroy_publisher(publisher)
        self._tracked, self._own = body, []
        if body:
            self._own = [
                self._node.create_publisher(hri.Skeleton2D, f"{_BODIES}/{body}/skeleton2d", _QOS),
                self._node.create_publisher(hri.NormalizedRegionOfInterest2D, f"{_BODIES}/{body}/roi", _QOS),
                self._node.create_publisher(String, f"{_PERSONS}/{person_id(body)}/body_id", KEPT_QOS),
            ]
            self._own[-1].publish(String(data=body))


#: Of ellipsoids, through which a joint is seen.
_UNCERTAIN = ColorRGBA(r=0.95, g=0.75, b=0.1, a=0.25)
#: Ellipsoids show two standard deviations.
_SIGMAS = 2.0


def pose_markers(message: Pose3D, lifetime_s: float) -> MarkerArray:
    """Skeleton, joints and their uncertainty ellipsoids of one pose, in the pose's frame, for ``lifetime_s``."""
    joints = pose3d_from_ros(message).joints3d
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
        ball.color = _UNCERTAIN
        markers.append(ball)
    return markers


def path_marker(header: Header, positions: np.ndarray) -> Marker:
    """Path of the camera (N, 3) m in the header's frame, as a line."""
    line = _marker(header, "camera_path", Marker.LINE_STRIP)
    line.scale.x = 0.04
    line.color = _colour("path")
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
    marker.outline_color = _colour("middle")
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
    joints = pose3d_from_ros(message).joints3d
    return [
        transform_to_ros(message.header, f"{frame_prefix}body_{message.track_id}/{name}", p)
        for name, p in zip(joint_set(message.skeleton).joints, joints, strict=False)
        if np.isfinite(p).all()
    ]


def _marker(header: Header, namespace: str, kind: int, number: int = 0) -> Marker:
    marker = Marker(header=header, ns=namespace, id=number, type=kind, action=Marker.ADD)
    marker.pose.orientation = Quaternion(w=1.0)
    marker.color = _colour("middle")
    return marker


def _side_colour(joints: JointSet, joint: int) -> ColorRGBA:
    return _colour(side_of(joints.joints[joint], joints.joints))


def _colour(of: str) -> ColorRGBA:
    red, green, blue = (part / 255.0 for part in COLOURS[of])
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)


def _point(p: np.ndarray) -> Point:
    return Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))
