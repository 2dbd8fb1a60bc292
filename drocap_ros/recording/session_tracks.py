"""Tracks from a recording: keypoints with camera telemetry."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.geometry.rotations import unit_quaternions
from drocap_ros.perception.calibration import through_lens
from drocap_ros.recording import session as recorded
from drocap_ros.recording.other_poses import read_other_poses
from drocap_ros.recording.pose_messages import float_array, lens_of, read_fixed_points
from drocap_ros.recording.session import Message, Session, TopicInfo, header_stamp_ns, numbers_of, xyzw_of
from drocap_ros.recording.telemetry.log import VehicleTrack, with_camera
from drocap_ros.skeleton import joint_set
from drocap_ros.tracks import MAX_FRAMES, Tracks

#: Where other systems record poses that are not read: of trees of frames.
_OTHER_POSES = ("tf2_msgs/msg/TFMessage",)
#: Topics of images without distortion.
_RECTIFIED = re.compile(r"rect", re.IGNORECASE)
#: Calibrations that differ by a smaller share are one: the scale of the motion errs by as much.
_SAME_LENS = 0.01
#: A stamp farther from most others, in ns, is of another clock: a day, the longest flight and more.
_FAR_NS = 86_400 * 10**9


def read_pose2d(session: Session, mount_pitch_deg: float | None = None, *, telemetry: bool = True) -> Tracks:
    """Tracks of the subject in most images, keypoints exactly as in the recorded messages.

    Images without that subject are frames of NaN.  The tracks contain the camera's poses where the recording does, see
    :func:`drocap_ros.recording.telemetry.log.camera_poses`.  Missing parts are in ``session.warnings``.

    mount_pitch_deg : of a camera fixed to the body, negative down, for recordings without the camera's attitude
    telemetry : whether the states of the vehicle are used
    """
    chosen = session.choose_topic(recorded.POSE2D)
    poses: dict[int, Message] = {}
    repeated = 0
    for _, message in session.messages((chosen.name,)):
        stamp_ns = header_stamp_ns(message)
        if stamp_ns in poses:
            repeated += 1
            if not message.track_id or poses[stamp_ns].track_id:
                continue
        poses[stamp_ns] = message
        if len(poses) > MAX_FRAMES:
            raise InputError(f"{session.path}: expected at most {MAX_FRAMES} poses; cut the recording")
    if repeated:
        session.warn(f"{repeated} repeated poses of the same images were left out")
    if not poses:
        raise InputError(f"{session.path}: expected poses on {chosen.name}, none could be decoded; record it again")
    stamps = _of_one_clock(session, poses)
    ordered = [poses[stamp] for stamp in stamps]
    track_id = most_frequent_subject(session, ordered)
    try:
        tracks = _tracks_of(np.array(stamps, np.int64), ordered, track_id)
        if (points := _nearest(session.topics_of(recorded.BACKGROUND_TRACKS), chosen.name)) is not None:
            background = read_fixed_points(session, points.name, tracks.stamp_ns)
            tracks = dataclasses.replace(tracks, background=background)
        return with_recorded_camera(session, tracks, chosen.name, mount_pitch_deg, telemetry=telemetry)
    except InputError as error:
        raise InputError(f"{session.path}: {chosen.name}: {error}") from None


def _of_one_clock(session: Session, stamps: Iterable[int]) -> list[int]:
    """The stamps, sorted, without those far from most others: of a stray message, or from before a clock was set."""
    ordered = sorted(stamps)
    middle = ordered[len(ordered) // 2]
    kept = [stamp for stamp in ordered if abs(stamp - middle) <= _FAR_NS]
    if len(kept) < len(ordered):
        session.warn(f"{len(ordered) - len(kept)} poses with a stamp more than a day from most others were left out")
    return kept


def with_recorded_camera(
    session: Session, tracks: Tracks, near: str, mount_pitch_deg: float | None = None, *, telemetry: bool = True
) -> Tracks:
    """Tracks with the camera's matrix and poses where the recording holds them, those nearest to a topic's name."""
    camera = _recorded_lens(session, near, tracks.image_size)
    tracks = dataclasses.replace(tracks, camera_matrix=None) if camera is None else through_lens(tracks, camera)
    if not telemetry:
        return tracks
    vehicle = read_vehicle_track(session, near)
    if vehicle is None:
        vehicle = read_other_poses(session)
    if vehicle is None:
        if others := ", ".join(topic.name for topic in session.topics_of(*_OTHER_POSES)):
            session.warn(f"no camera telemetry: {others} is not read, {recorded.VEHICLE_STATE} is; add it to the bag")
        return tracks
    has_gimbal = bool(np.isfinite(vehicle.gimbal).all(axis=1).any())
    if mount_pitch_deg is not None and has_gimbal:
        raise InputError("--mount-pitch: expected no recorded camera attitude, found one; leave the option out")
    tracks, reason = with_camera(tracks, vehicle, tracks.stamp_ns, mount_pitch_deg)
    if reason:
        fixed = not has_gimbal and mount_pitch_deg is None
        remedy = "; for a camera fixed to the body: --mount-pitch DEG" if fixed else ""
        session.warn(f"camera telemetry incomplete: {reason}{remedy}")
    return tracks


def read_vehicle_track(session: Session, near: str = "") -> VehicleTrack | None:
    """States of the vehicle, or None where there are none.

    The topic with the namespace of ``near`` is preferred.
    """
    topic = _nearest(session.topics_of(recorded.VEHICLE_STATE), near)
    if topic is None:
        return None
    rows: dict[int, tuple[np.ndarray, ...]] = {}
    for _, message in session.messages((topic.name,)):
        position = np.asarray(message.position_enu_m, dtype=np.float64)
        rows[header_stamp_ns(message)] = (position, xyzw_of(message.orientation), xyzw_of(message.gimbal_orientation))
    if not rows:
        return None
    stamps = sorted(rows)
    position, orientation, gimbal = (np.array([rows[s][i] for s in stamps]) for i in range(3))
    stamp_ns = np.array(stamps, dtype=np.int64)
    return VehicleTrack(stamp_ns, position, unit_quaternions(orientation), unit_quaternions(gimbal))


def most_frequent_subject(session: Session, messages: Iterable[Message]) -> int:
    """Track id of the subject in most of the messages or observations, the first of equals; 0 where none has one."""
    count = Counter(int(m.track_id) for m in messages if m.track_id)
    if not count:
        return 0
    (track_id, most), *_ = count.most_common()
    if others := count.total() - most:
        session.warn(
            f"poses of {len(count)} persons: the one in {most} images is used, {others} poses of others are left out"
            " (--redetect --subject N chooses one)"
        )
    return track_id


def _tracks_of(stamp_ns: np.ndarray, messages: list[Message], track_id: int) -> Tracks:
    """Tracks from Pose2D messages of the stamps (F,): those of one track, 0 = none."""
    seen = next((m for m in messages if m.track_id == track_id), messages[0])
    joints = joint_set(seen.skeleton)
    size = (int(seen.image_width), int(seen.image_height))
    frames, count = len(messages), len(joints)
    keypoints = np.full((frames, count, 2), np.nan)
    covariance = np.full((frames, count, 3), np.nan)
    confidence = np.zeros((frames, count))
    for i, message in enumerate(messages):
        if not message.track_id or message.track_id != track_id:
            continue
        if message.skeleton != seen.skeleton:
            raise InputError(f"skeleton: expected {seen.skeleton} throughout, got {message.skeleton[:40]!r}")
        if (message.image_width, message.image_height) != size:
            raise InputError(
                f"image size: expected {size[0]}x{size[1]} px throughout, got "
                f"{message.image_width}x{message.image_height}; cut the recording where it changes"
            )
        keypoints[i] = float_array(message.keypoints, keypoints[i].shape, "keypoints")
        covariance[i] = float_array(message.covariance, covariance[i].shape, "covariance")
        confidence[i] = float_array(message.confidence, confidence[i].shape, "confidence")
    return Tracks(keypoints, joints.joints, stamp_ns, size, confidence, covariance, real_lens=True)


def _recorded_lens(session: Session, near: str, size: tuple[int, int]) -> CameraModel | None:
    """The lens of the first usable camera info, for images of ``size`` (width, height) px; or None."""
    info = _nearest(session.topics_of(*recorded.CALIBRATIONS), near)
    if info is None:
        return None
    camera = _first_calibration(session, info.name, size, rectified=bool(_RECTIFIED.search(near.rpartition("/")[2])))
    if camera is None:
        session.warn(f"no usable calibration on {info.name}: its matrix is not set")
        return None
    if (camera.width, camera.height) == size:
        return camera
    found = f"the calibration on {info.name} is for {camera.width}x{camera.height} px, the images have"
    if not camera.has_aspect_of(size):
        session.warn(f"{found} {size[0]}x{size[1]}: not used; record the calibration of this camera mode")
        return None
    session.warn(f"{found} {size[0]}x{size[1]}: taken as the same picture, resized")
    return camera.resized(*size)


def _first_calibration(session: Session, topic: str, size: tuple[int, int], *, rectified: bool) -> CameraModel | None:
    """The first usable calibration, of images of ``size`` where it states none; warns where it changes.

    rectified : of images without distortion: their matrix is P
    """
    camera: CameraModel | None = None
    for _, message in session.messages((topic,)):
        lens, unknown = lens_of(message)
        if lens is None:
            continue
        matrix, distortion = lens.matrix, lens.distortion
        if rectified:
            distortion, projection = distortion[:0], numbers_of(message, "p")
            matrix = projection.reshape(3, 4)[:, :3] if projection.size == 12 and projection.any() else matrix
        if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
            continue
        if camera is None:
            width, height = lens.width or size[0], lens.height or size[1]
            camera = CameraModel(width, height, matrix, distortion, lens.distortion_model)
            if unknown and not rectified:
                session.warn(f"{topic}: {unknown}")
            if distortion.any():
                session.warn(f"the distortion of the lens on {topic} is taken off the keypoints")
            part = getattr(message, "roi", None)  # Foxglove's has none
            if part is not None and (part.width, part.height) == size != (camera.width, camera.height):
                moved = camera.matrix - [[0, 0, part.x_offset], [0, 0, part.y_offset], [0, 0, 0]]
                camera = dataclasses.replace(camera, width=part.width, height=part.height, matrix=moved)
            first = matrix
        elif not np.allclose(matrix, first, rtol=_SAME_LENS):
            session.warn(f"the calibration on {topic} changes: the first one is used; cut the recording there")
            break
    return camera


def _nearest(topics: list[TopicInfo], near: str) -> TopicInfo | None:
    """The topic whose namespace agrees most with that of ``near``."""

    def shared(topic: TopicInfo) -> int:
        return sum(a == b for a, b in zip(topic.name.split("/")[:-1], near.split("/")[:-1], strict=False))

    return max(topics, key=shared, default=None)
