"""Observations and published poses from messages, decoded by rclpy in the live graph or by rosbags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.background import Background, FixedPoints, of_images
from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import optical_orientation
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.keypoints import PoseObservation
from drocap_ros.recording.session import Message, calibration_of, header_stamp_ns, xyzw_of
from drocap_ros.skeleton import joint_set
from drocap_ros.stamps import StampValidator
from drocap_ros.tracks import check_camera_matrix, check_keypoints

if TYPE_CHECKING:
    from drocap_ros.recording.session import Session
import contextlib
import hashlib
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import NamedTuple, TypeAlias

from drocap_ros.background import PointHistory
from drocap_ros.camera_path import CameraPath
from drocap_ros.recording import session as recorded
from drocap_ros.recording.session import Session, stamp_of

_INITIAL = 1  # Pose3D.INITIAL
Take: TypeAlias = Callable[[Message], None]


@dataclass
class Agreement:
    """Offline results compared with the published ones, bit for bit.

    initial, windows : number compared, number equal
    """

    initial: list[int] = field(default_factory=lambda: [0, 0])
    windows: list[int] = field(default_factory=lambda: [0, 0])

    def __str__(self) -> str:
        return (
            f"equal to the live graph bit for bit: {self.initial[1]} of {self.initial[0]} initial poses,"
            f" {self.windows[1]} of {self.windows[0]} windows"
        )


class PublishedWindow(NamedTuple):
    """A window of the live graph.

    stamp_ns : of its last image
    fingerprint : of its stamps and joints
    stride, steps : the effort of its adjustment: of the images, and of its two solutions where they were limited
    telemetry_ns, background_ns : stamps of the newest state of the vehicle and fixed points that it knew, 0 = none
    """

    stamp_ns: int
    fingerprint: bytes
    stride: int
    steps: tuple[int, int] | None
    telemetry_ns: int
    background_ns: int


class _UpTo:
    """Gives a history the messages of a topic, in their order, up to one of a stamp."""

    def __init__(self, history: CameraHistory | PointHistory, messages: Iterator[Message], take: Take) -> None:
        self._history, self._messages, self._take = history, messages, take
        self._next = next(messages, None)

    def go(self, newest_ns: int) -> None:
        while self._next is not None and self._history.newest_ns != newest_ns:
            if self._history.newest_ns < newest_ns < header_stamp_ns(self._next):
                break  # the recording lacks that message
            with contextlib.suppress(InputError):  # the live graph refused it too
                self._take(self._next)
            self._next = next(self._messages, None)


class RecordedPoints:
    """The scene's fixed points as the live graph had them at each of its adjustments; messages are streamed."""

    def __init__(self, session: Session, near: str, keep_s: float) -> None:
        self._history = history = PointHistory(keep_s)
        name = f"{near.rsplit('/', 1)[0]}/background"
        self._messages = _UpTo(
            history,
            _accepted(_messages(session, recorded.BACKGROUND_TRACKS, name)),
            lambda message: history.add(header_stamp_ns(message), fixed_points_from_message(message)),
        )

    def along(self, stamp_ns: np.ndarray, newest_ns: int) -> Background | None:
        """The points in a window's images (F,), by the messages up to that of the stamp ``newest_ns``."""
        self._messages.go(newest_ns)
        return self._history.along(stamp_ns)


class RecordedCamera:
    """The camera's history as the live graph had it at each of its adjustments; messages are streamed."""

    def __init__(self, session: Session, near: str, keep_s: float) -> None:
        base = near.rsplit("/", 1)[0]
        self._history = CameraHistory(keep_s)
        states = _accepted(_messages(session, recorded.VEHICLE_STATE, f"{base}/vehicle/state"))
        self._states = _UpTo(self._history, states, partial(add_state, self._history))
        for message in _accepted(_messages(session, recorded.CAMERA_INFO, f"{base}/camera_info")):
            with contextlib.suppress(InputError):  # the live graph refused it too
                add_calibration(self._history, message)
        self.matrix: np.ndarray | None = None

    def along(self, stamp_ns: np.ndarray, size: tuple[int, int], newest_ns: int) -> CameraPath | None:
        """The camera at a window's images (F,) of a size, by the states up to that of the stamp ``newest_ns``."""
        self._states.go(newest_ns)
        camera = self._history.along(stamp_ns, size)
        self.matrix = self.matrix if camera is None else camera.matrix
        return camera


class PublishedPoses:
    """Results of the live graph; a stamp repeats where a recording was played in a loop."""

    def __init__(self, session: Session, near: str) -> None:
        base = near.rsplit("/", 1)[0]
        # Fingerprints save memory: the windows of half an hour overlap twelvefold.
        self._initial: defaultdict[int, deque[bytes]] = defaultdict(deque)
        self._windows: deque[PublishedWindow] = deque()
        self._current: PublishedWindow | None = None
        self.agreement = Agreement()
        for m in _messages(session, recorded.POSE3D, f"{base}/pose3d/initial"):
            if m.stage == _INITIAL:
                self._initial[header_stamp_ns(m)].append(_fingerprint(_joints(m)))
        for m in _messages(session, recorded.POSE3D_WINDOW, f"{base}/pose3d/refined"):
            stamps = np.array([header_stamp_ns(pose) for pose in m.poses], np.int64)
            joints = np.array([_joints(pose) for pose in m.poses])
            steps = (int(m.steps[0]), int(m.steps[1])) if len(m.steps) else None
            # Windows of before did not use fixed points.
            points_ns = stamp_of(m.background_stamp) if hasattr(m, "background_stamp") else 0
            of = header_stamp_ns(m), _fingerprint(stamps, joints), int(m.stride)
            self._windows.append(PublishedWindow(*of, steps, stamp_of(m.telemetry_stamp), points_ns))
        self.has_windows = bool(self._windows)

    def next_window(self, stamp_ns: int) -> PublishedWindow | None:
        """The window that ends here, the next in order; None when the graph adjusted none."""
        ahead = next((i for i, w in enumerate(self._windows) if w.stamp_ns == stamp_ns), None)
        if ahead is None or any(w.stamp_ns > stamp_ns for w in islice(self._windows, ahead)):
            return None
        for _ in range(ahead + 1):
            self._current = self._windows.popleft()
        return self._current

    def known_ns(self, newest_ns: int) -> tuple[int, int]:
        """Of the window that :meth:`next_window` returned last: stamps of the newest state and fixed points it knew.

        0 = none; without any windows what is as old as the newest image is known.
        """
        if not self.has_windows:
            return newest_ns, newest_ns
        return (0, 0) if self._current is None else (self._current.telemetry_ns, self._current.background_ns)

    def compare_initial(self, stamp_ns: int, joints: np.ndarray) -> None:
        """Compare with the published pose of the same stamp, if any."""
        theirs = self._initial.get(stamp_ns)
        if theirs:
            compared, equal = self.agreement.initial
            self.agreement.initial = [compared + 1, equal + (theirs.popleft() == _fingerprint(joints))]

    def compare_window(self, stamp_ns: np.ndarray, joints: np.ndarray) -> None:
        """Compare the joints (F, P, 3) at the stamps (F,) with the window that :meth:`next_window` returned last."""
        theirs, self._current = self._current, None
        if theirs is not None:
            compared, equal = self.agreement.windows
            self.agreement.windows = [compared + 1, equal + (theirs.fingerprint == _fingerprint(stamp_ns, joints))]


def _messages(session: Session, kind: str, name: str) -> Iterator[Message]:
    """Messages of a topic, none when the session lacks it."""
    if any(topic.name == name for topic in session.topics_of(kind)):
        yield from (message for _, message in session.messages((name,)))


def _accepted(messages: Iterator[Message]) -> Iterator[Message]:
    """Messages whose stamps the live graph did not refuse."""
    stamps = StampValidator()
    for message in messages:
        try:
            stamps.check(message.header.stamp.sec, message.header.stamp.nanosec)
        except InputError:
            continue
        yield message


def _fingerprint(*arrays: np.ndarray) -> bytes:
    """Equal only where every bit is; any NaN counts as any other."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(str(array.shape).encode())
        digest.update(np.where(np.isnan(array), np.float32(np.nan), array).astype(array.dtype).tobytes())
    return digest.digest()


def _joints(message: Message) -> np.ndarray:
    return np.asarray(message.joints, np.float32).reshape(-1, 3)


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
    """Give a camera's history a ``CameraInfo``; an uncalibrated one changes nothing."""
    matrix = calibration_of(message)
    if matrix is not None:
        size = (message.width, message.height)
        if matrix[0, 0] > 0 and min(size) > 0:
            check_camera_matrix(matrix, size)
        history.add_matrix(header_stamp_ns(message), matrix, size)


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
