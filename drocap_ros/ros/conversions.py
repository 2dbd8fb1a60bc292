"""Conversions between messages and the core's types: pure functions that validate their input."""

from __future__ import annotations

import math
from array import array

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, NavSatFix, NavSatStatus
from std_msgs.msg import Header

from drocap_ros.background import FixedPoints
from drocap_ros.flight.vehicle import VehicleState as VehicleStateData
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import BackgroundTracks, Pose2D, Pose3D, Pose3DWindow, VehicleState
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.reconstruction.live.window import AdjustedWindow, Window
from drocap_ros.recording.pose_messages import float_array, observation_from_message
from drocap_ros.skeleton import BODY_15, BODY_17, joint_set
from drocap_ros.srv import OrbitCommand

#: The world's frame: ENU, z up.
MAP = "map"
#: Frame of a path by the picture alone (REP 105: continuous, but for a path that was lost, and it drifts).
ODOM = "odom"


def stamp_to_ros(stamp_ns: int) -> Time:
    """Integer nanoseconds -> builtin_interfaces/Time."""
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    return Time(sec=seconds, nanosec=nanoseconds)


def stamp_from_ros(stamp: Time) -> int:
    """builtin_interfaces/Time -> integer nanoseconds."""
    return int(stamp.sec * 10**9 + stamp.nanosec)


def header_at(stamp_ns: int, frame_id: str) -> Header:
    """Header of a stamp and a frame."""
    return Header(stamp=stamp_to_ros(stamp_ns), frame_id=frame_id)


def floats(values: np.ndarray) -> array:
    """Any array -> flat row-major ``float32[]``; rclpy takes an ``array`` without a check per value."""
    return array("f", np.ascontiguousarray(values, np.float32).tobytes())


def quaternion_to_ros(xyzw: np.ndarray) -> Quaternion:
    """(4,) x y z w -> geometry_msgs/Quaternion."""
    x, y, z, w = (float(v) for v in xyzw)
    return Quaternion(x=x, y=y, z=z, w=w)


def transform_to_ros(
    header: Header, child_frame_id: str, position: np.ndarray, xyzw: np.ndarray | None = None
) -> TransformStamped:
    """Place (3,) m and rotation (4,) of a frame in that of the header -> geometry_msgs/TransformStamped."""
    transform = TransformStamped(header=header, child_frame_id=child_frame_id)
    x, y, z = (float(v) for v in position)
    transform.transform.translation = Vector3(x=x, y=y, z=z)
    if xyzw is not None:
        transform.transform.rotation = quaternion_to_ros(xyzw)
    return transform


def compressed_image_to_ros(header: Header, jpeg: bytes) -> CompressedImage:
    """JPEG of a BGR image -> sensor_msgs/CompressedImage."""
    return CompressedImage(header=header, format="bgr8; jpeg compressed bgr8", data=array("B", jpeg))


def camera_info_to_ros(header: Header, camera: CameraModel) -> CameraInfo:
    """Pinhole camera -> sensor_msgs/CameraInfo, unrectified images."""
    k = camera.matrix.ravel().tolist()
    return CameraInfo(
        header=header,
        width=camera.width,
        height=camera.height,
        distortion_model=camera.distortion_model,
        d=camera.distortion.tolist(),
        k=k,
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[k[0], 0.0, k[2], 0.0, 0.0, k[4], k[5], 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def pose2d_to_ros(observation: PoseObservation, frame_id: str) -> Pose2D:
    """Observation -> message; without a subject the arrays are empty."""
    width, height = observation.image_size
    return Pose2D(
        header=header_at(observation.stamp_ns, frame_id),
        track_id=observation.track_id,
        skeleton=observation.joints.name,
        image_width=width,
        image_height=height,
        roi=observation.roi.astype(np.float32),
        detection_score=float(observation.detection_score),
        keypoints=floats(observation.keypoints),
        covariance=floats(observation.covariance),
        confidence=floats(observation.confidence),
    )


pose2d_from_ros = observation_from_message


def background_to_ros(points: FixedPoints, header: Header) -> BackgroundTracks:
    """The scene's fixed points in the image of a header -> message."""
    return BackgroundTracks(header=header, track=array("q", points.track.tolist()), point=floats(points.point))


def pose3d_to_ros(pose: LivePose, frame_id: str) -> Pose3D:
    """A pose in a frame -> message; it is metric in ``map`` alone."""
    turn = np.full(4, np.nan) if pose.rotation is None else quaternion_from_matrix(pose.rotation)
    return Pose3D(
        header=header_at(pose.stamp_ns, frame_id),
        track_id=pose.track_id,
        stage=Pose3D.REFINED if pose.refined else Pose3D.INITIAL,
        skeleton=(BODY_17 if len(pose.joints3d) == len(BODY_17) else BODY_15).name,
        joints=floats(pose.joints3d),
        covariance=floats(pose.covariance),
        confidence=floats(pose.confidence),
        camera_orientation=quaternion_to_ros(turn),
        metric=frame_id == MAP,
        reprojection_rms=float(pose.reprojection_rms_px),
    )


def pose3d_from_ros(message: Pose3D) -> LivePose:
    """Message -> pose, float64, in the message's own frame; of the camera's orientation nothing is read."""
    count = len(joint_set(message.skeleton)) if message.track_id else 0
    return LivePose(
        stamp_from_ros(message.header.stamp),
        message.track_id,
        float_array(message.joints, (count, 3), "joints").astype(np.float64),
        float_array(message.covariance, (count, 6), "covariance").astype(np.float64),
        float_array(message.confidence, (count,), "confidence").astype(np.float64),
        message.reprojection_rms,
        refined=message.stage == Pose3D.REFINED,
    )


def window_to_ros(
    window: Window, solved: AdjustedWindow, camera_frame: str, sequence: int, solve_seconds: float
) -> Pose3DWindow:
    """Window and its solution -> message; ``camera_frame`` : of the images."""
    in_map = solved.in_map
    frame_id = camera_frame if in_map is None else ODOM if in_map.path else MAP
    poses = [
        LivePose(
            stamp_ns,
            window.track_id,
            solved.joints3d[i],
            solved.covariance[i],
            solved.confidence[i],
            solved.reprojection_rms_px[i],
            refined=True,
            rotation=None if in_map is None else in_map.rotation[i],
        )
        for i, stamp_ns in enumerate(solved.stamp_ns)
    ]
    return Pose3DWindow(
        header=header_at(window.stamp_ns[-1], frame_id),
        poses=[pose3d_to_ros(pose, frame_id) for pose in poses],
        window_seq=sequence,
        iterations=solved.iterations,
        cost=float(solved.cost),
        stop_reason=solved.stop_reason,
        solve_seconds=solve_seconds,
        stride=solved.effort.stride,
        steps=array("I", solved.effort.steps or ()),
        telemetry_stamp=stamp_to_ros(window.known_ns[0]),
        background_stamp=stamp_to_ros(window.known_ns[1]),
    )


def camera_transform(window: AdjustedWindow, child: str) -> TransformStamped:
    """``odom`` -> optical frame, of the newest image of a window there."""
    assert window.in_map is not None
    rotation, position, _, _ = window.in_map
    turn = quaternion_from_matrix(rotation[-1:].swapaxes(1, 2))[0]
    return transform_to_ros(header_at(int(window.stamp_ns[-1]), ODOM), child, position[-1], turn)


def orbit_request(
    node: Node,
    command: int,
    radius_m: float = math.nan,
    height_m: float = math.nan,
    speed_deg_s: float = math.nan,
) -> OrbitCommand.Request:
    """A command for ``mavlink_bridge``, stamped by the node's clock; NaN = the configured or present value."""
    return OrbitCommand.Request(
        stamp=node.get_clock().now().to_msg(),
        command=command,
        radius_m=radius_m,
        height_m=height_m,
        angular_speed_deg_s=speed_deg_s,
    )


def vehicle_state_to_ros(state: VehicleStateData) -> VehicleState:
    """Vehicle state -> message; the two have the same fields."""
    message = VehicleState(
        header=header_at(state.stamp_ns, MAP),
        orientation=quaternion_to_ros(state.orientation_xyzw),
        gimbal_orientation=quaternion_to_ros(state.gimbal_orientation_xyzw),
    )
    for name in VehicleState.get_fields_and_field_types():
        if hasattr(state, name):
            value = getattr(state, name)
            arrays = isinstance(value, np.ndarray)
            setattr(message, name, value.astype(getattr(message, name).dtype) if arrays else value)
    return message


def odometry_to_ros(state: VehicleStateData) -> Odometry:
    """Pose of ``base_link`` in ``map``, and its velocity in ``base_link`` (REP 105, REP 147), of a vehicle state."""
    message = Odometry(header=header_at(state.stamp_ns, MAP), child_frame_id="base_link")
    x, y, z = (float(v) for v in state.position_enu_m)
    message.pose.pose.position = Point(x=x, y=y, z=z)
    message.pose.pose.orientation = quaternion_to_ros(state.orientation_xyzw)
    velocity = state.velocity_enu_m_s @ matrix_from_quaternion(state.orientation_xyzw)
    x, y, z = (float(v) for v in velocity)
    message.twist.twist.linear = Vector3(x=x, y=y, z=z)
    x, y, z = (float(v) for v in state.angular_velocity_flu_rad_s)
    message.twist.twist.angular = Vector3(x=x, y=y, z=z)
    return message


def fix_to_ros(state: VehicleStateData) -> NavSatFix:
    """Position on earth of a vehicle state; its altitude above the ellipsoid is not known, NaN."""
    # By MAVLink's GPS_FIX_TYPE: 3D, differential, RTK.
    kinds = {3: NavSatStatus.STATUS_FIX, 4: NavSatStatus.STATUS_SBAS_FIX, 5: NavSatStatus.STATUS_GBAS_FIX}
    status = kinds.get(min(state.gps_fix_type, 5), NavSatStatus.STATUS_NO_FIX)
    return NavSatFix(
        header=header_at(state.stamp_ns, "base_link"),
        status=NavSatStatus(status=status, service=NavSatStatus.SERVICE_GPS),
        latitude=float(state.latitude_deg),
        longitude=float(state.longitude_deg),
        altitude=math.nan,
    )
