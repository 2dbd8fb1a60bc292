"""What messages of the live graph carry, decoded by rclpy there or by rosbags."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from drocap_ros.background import Background, FixedPoints, of_images
from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import optical_orientation
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.geometry.lens import LENS_MODELS, CameraModel, coefficients_of
from drocap_ros.keypoints import PoseObservation
from drocap_ros.recording.session import Message, Session, header_stamp_ns, numbers_of, xyzw_of
from drocap_ros.skeleton import joint_set
from drocap_ros.stamps import StampValidator
from drocap_ros.tracks import check_camera_matrix, check_keypoints


def observation_from_message(message: Message) -> PoseObservation:
    """Message -> observation; its arrays stay float32, as they were sent."""
    joints = joint_set(message.skeleton)
    count = len(joints) if message.track_id else 0
    stamp_ns = header_stamp_ns(message)
    if stamp_ns < 0:
        raise InputError(f"stamp: expected a time after 1970, got {stamp_ns} ns; set the sender's clock")
    if message.image_width < 1 or message.image_height < 1:
        raise InputError(f"image size: expected at least 1x1 px, got {message.image_width}x{message.image_height}")
    keypoints = float_array(message.keypoints, (count, 2), "keypoints")
    covariance = float_array(message.covariance, (count, 3), "covariance")
    check_keypoints(keypoints, covariance)
    confidence = float_array(message.confidence, (count,), "confidence")
    if (covariance[:, [0, 2]] < 0).any():
        raise InputError(f"covariance: expected variances xx, yy of at least 0 px^2, got {np.nanmin(covariance):g}")
    if ((confidence < 0) | (confidence > 1)).any():
        raise InputError(f"confidence: expected 0 to 1, got {confidence.min():g} to {confidence.max():g}")
    return PoseObservation(
        stamp_ns=stamp_ns,
        track_id=message.track_id,
        joints=joints,
        image_size=(message.image_width, message.image_height),
        roi=np.array(message.roi, np.float32),
        detection_score=message.detection_score,
        keypoints=keypoints,
        covariance=covariance,
        confidence=confidence,
    )


def fixed_points_from_message(message: Message) -> FixedPoints:
    """``BackgroundTracks`` -> the scene's fixed points."""
    track = np.array(message.track, np.int64)
    point = float_array(message.point, (len(track), 2), "point")
    if not np.isfinite(point).all():
        raise InputError("point: expected finite px, got NaN; leave lost points out")
    if len(np.unique(track)) < len(track):
        raise InputError("track: expected distinct numbers in one image, got a repeated one; number the points")
    return FixedPoints(track, point)


def read_fixed_points(session: Session, topic: str, stamp_ns: np.ndarray) -> Background | None:
    """Fixed points in the images of the stamps (F,); None = the topic has none.  Unusable messages are left out."""
    images: list[FixedPoints | None] = [None] * len(stamp_ns)
    place, refused = {stamp: i for i, stamp in enumerate(stamp_ns.tolist())}, 0
    for _, message in session.messages((topic,)):
        frame = place.get(header_stamp_ns(message))
        if frame is None:
            continue
        try:
            images[frame] = fixed_points_from_message(message)
        except InputError:
            refused += 1
    if refused:
        session.warn(f"{refused} messages on {topic} were refused")
    return of_images(images)


def add_state(history: CameraHistory, message: Message) -> None:
    """Give a camera's history a ``VehicleState``; one without position or camera attitude changes nothing."""
    orientation = optical_orientation(xyzw_of(message.gimbal_orientation))
    history.add_pose(header_stamp_ns(message), np.asarray(message.position_enu_m, np.float64), orientation)


def add_calibration(history: CameraHistory, message: Message) -> None:
    """Give a camera's history a ``CameraInfo``; an uncalibrated one changes nothing.

    Where its distortion is of no known form the lens counts without it, and an InputError says so.
    """
    lens, unknown = lens_of(message)
    if lens is not None:
        if lens.matrix[0, 0] > 0 and min(lens.width, lens.height) > 0:
            check_camera_matrix(lens.matrix, (lens.width, lens.height))
        history.add_lens(header_stamp_ns(message), lens)
    if unknown:
        raise InputError(unknown)


#: Names of lenses that others write.
_LENS_NAMES = {"": "plumb_bob", "radtan": "plumb_bob", "fisheye": "equidistant", "kannala_brandt": "equidistant"}


def lens_of(message: Message) -> tuple[CameraModel | None, str]:
    """The lens of a ``CameraInfo``, None where it holds no matrix; and in words what of it has no known form."""
    matrix, found, model = numbers_of(message, "k"), numbers_of(message, "d"), str(message.distortion_model)
    model = _LENS_NAMES.get(model.lower(), model)
    if matrix.size != 9:
        return None, ""
    lens = CameraModel(int(message.width), int(message.height), matrix.reshape(3, 3))
    if not found.any():
        return lens, ""
    if model not in LENS_MODELS or found.size not in coefficients_of(model) or not np.isfinite(found).all():
        return lens, f"the distortion ({model[:40]!r}, {found.size} values) is of no known form: not used"
    return dataclasses.replace(lens, distortion=found, distortion_model=model), ""


def float_array(values: Sequence[float] | np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Flat ``float32[]`` of a message -> array of a shape."""
    wanted = int(np.prod(shape))
    if len(values) != wanted:
        raise InputError(f"{name}: expected {wanted} values for shape {shape}, got {len(values)}")
    result = np.array(values, np.float32).reshape(shape)
    if np.isinf(result).any():
        raise InputError(f"{name}: expected finite values or NaN where unknown, got infinity")
    return result


def read_observations(session: Session, topic: str) -> Iterator[PoseObservation]:
    """Observations of a topic in the order of the recording; messages that a live node refuses are skipped."""
    refused, stamps = 0, StampValidator()
    for _, message in session.messages((topic,)):
        try:
            stamps.check(message.header.stamp.sec, message.header.stamp.nanosec)
            observation = observation_from_message(message)
        except InputError:
            refused += 1
            continue
        yield observation
    if refused:
        session.warn(f"{refused} messages on {topic} were refused, as in the live graph")
