"""Runs a recorded session through the live method offline: ``drocap reconstruct SESSION --method live``."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.background import PointHistory
from drocap_ros.clip import Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.keypoints import Keypoints2D, PoseObservation
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.poses import NO_WINDOW
from drocap_ros.reconstruction.in_metres import reprojection_px
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort
from drocap_ros.recording import session as recorded
from drocap_ros.recording.open_session import is_recording, open_session
from drocap_ros.recording.pose_messages import (
    add_calibration,
    add_state,
    fixed_points_from_message,
    read_observations,
)
from drocap_ros.recording.provenance import CONFIGURATION
from drocap_ros.recording.session import POSE2D, Message, Session, header_stamp_ns, stamp_of
from drocap_ros.recording.session_tracks import most_frequent_subject
from drocap_ros.skeleton import BODY_17
from drocap_ros.stamps import StampValidator
from drocap_ros.tracks import Tracks

logger = logging.getLogger(__name__)
_INITIAL = 1  # Pose3D.INITIAL


def replay(path: Path, config: DrocapConfig, progress: Progress | None = None) -> tuple[Motion, Tracks]:
    """Motion and tracks of a recording by the live method, with its own parameters where ``config`` is the default."""
    if not path.exists() or not is_recording(path):
        raise InputError(f"{path}: expected a recording with pose2d for method live, found none; use another method")
    with open_session(path) as session:
        if config == DrocapConfig():
            config = recorded_config(session) or config
        motion, tracks, _ = reconstruct_live(session, config, progress)
        for warning in session.warnings:
            logger.warning("%s: %s", path.name, warning)
    return dataclasses.replace(motion, meta={**motion.meta, "input": path.name}), tracks


def recorded_config(session: Session) -> DrocapConfig | None:
    """The recorded parameters of the live method, defaults elsewhere; None when the session holds no usable ones.

    Parameters that this version does not have are ignored with a warning.
    """
    import yaml

    text = session.info.metadata.get(CONFIGURATION)
    if not text:
        return None
    config = DrocapConfig()
    try:
        recorded = yaml.safe_load(text)
        for name in ("initializer", "bundle_adjuster"):
            values = recorded.get(f"/**/{name}", {}).get("ros__parameters", {})
            known = {field.name for field in dataclasses.fields(config.section(name))}
            if retired := sorted(f"{name}.{key}={values[key]}" for key in values.keys() - known):
                session.warn(f"recorded parameters that this version does not have are ignored: {', '.join(retired)}")
            if name == "bundle_adjuster":  # before there was one, no lens was assumed
                values = {"assumed_focal": 0.0, **values}
            config = config.replace(name, **{key: values[key] for key in values.keys() & known})
    except (InputError, yaml.YAMLError, AttributeError) as error:
        session.warn(f"the recorded configuration cannot be used ({error}); the given one is used")
        return None
    return config


def reconstruct_live(
    session: Session, config: DrocapConfig, progress: Progress | None = None
) -> tuple[Motion, Tracks, LiveGraph]:
    """Motion by the live method, from the session's messages ``pose2d`` and what the adjuster hears beside them.

    The motion is that of the subject in most images.  A frame's pose is that of the last window that holds it, one in
    ``map`` or ``odom`` first, else its initial one.  Where at least half of the frames are there, the motion has these,
    in frame "world"; else all, in frame "camera".  The windows are those that the live graph adjusted where the session
    holds them, else all that are due.  Memory: the poses and one window.
    """
    topic = session.choose_topic(POSE2D)
    core = LiveCore(config.bundle_adjuster)
    live = LiveGraph(session, topic.name, core)
    begin = time.perf_counter()
    frames: dict[int, _Frame] = {}
    matrix: np.ndarray | None = None
    stop_reason, iterations = NO_WINDOW, 0
    results = live_results(
        read_observations(session, topic.name),
        LiveInitializer(config.initializer),
        core,
        LiveAdjuster(config.bundle_adjuster),
        live.effort_at,
    )
    for done, result in enumerate(results):
        if isinstance(result, Step):
            stamp_ns, joints = result.initial.stamp_ns, result.initial.joints3d.astype(np.float32)
            live.compare_initial(stamp_ns, joints)
            frames[stamp_ns] = _Frame(result.observation, joints)
        else:
            window, solved = result
            live.compare_window(solved.stamp_ns, solved.joints3d.astype(np.float32))
            _take_window(frames, solved)
            matrix = matrix if window.camera is None else window.camera.matrix
            stop_reason, iterations = solved.stop_reason, iterations + solved.iterations
        if progress is not None and done % 50 == 0:
            progress("live", min(1.0, done / max(topic.count, 1)))
    subject = most_frequent_subject(session, (frame.observation for frame in frames.values()))
    frames = {stamp: frame for stamp, frame in frames.items() if frame.observation.track_id == subject}
    motion, tracks = _motion_of(session, frames, matrix, config)
    motion.meta.update(
        method="live",
        parameters={
            "initializer": dataclasses.asdict(config.initializer),
            "adjuster": dataclasses.asdict(config.bundle_adjuster),
        },
        frames=len(tracks),
        iterations=iterations,
        stop_reason=stop_reason,
        live_agreement=str(live),
        seconds={"live": time.perf_counter() - begin},
    )
    return motion, tracks, live


class _Window(NamedTuple):
    """A published window: stamp of its last image, fingerprint of its stamps and joints, and as in its message."""

    stamp_ns: int
    fingerprint: bytes
    effort: Effort
    known_ns: tuple[int, int]


class LiveGraph:
    """What the live graph published and what it knew then; a stamp repeats where a recording was played in a loop.

    initial, windows : number of offline results that were compared with published ones, and number equal bit for bit
    """

    def __init__(self, session: Session, near: str, core: LiveCore) -> None:
        base = near.rsplit("/", 1)[0]
        self.initial, self.windows = [0, 0], [0, 0]
        # Fingerprints save memory: the windows of half an hour overlap twelvefold.
        self._initial: defaultdict[int, deque[bytes]] = defaultdict(deque)
        self._windows: deque[_Window] = deque()
        self._current: _Window | None = None
        for m in _messages(session, recorded.POSE3D, f"{base}/pose3d/initial"):
            if m.stage == _INITIAL:
                self._initial[header_stamp_ns(m)].append(_fingerprint(_joints(m)))
        for m in _messages(session, recorded.POSE3D_WINDOW, f"{base}/pose3d/refined"):
            stamps = np.array([header_stamp_ns(pose) for pose in m.poses], np.int64)
            joints = np.array([_joints(pose) for pose in m.poses])
            effort = Effort(int(m.stride), (int(m.steps[0]), int(m.steps[1])) if len(m.steps) else None)
            # Windows of before did not use fixed points.
            known_ns = (
                stamp_of(m.telemetry_stamp),
                stamp_of(m.background_stamp) if hasattr(m, "background_stamp") else 0,
            )
            self._windows.append(_Window(header_stamp_ns(m), _fingerprint(stamps, joints), effort, known_ns))
        self._has_windows = bool(self._windows)
        cameras, points = core.cameras, core.points
        for message in _accepted(_messages(session, recorded.CAMERA_INFO, f"{base}/camera_info")):
            with contextlib.suppress(InputError):  # the live graph refused it too
                add_calibration(cameras, message)
        states = _accepted(_messages(session, recorded.VEHICLE_STATE, f"{base}/vehicle/state"))
        tracks = _accepted(_messages(session, recorded.BACKGROUND_TRACKS, f"{base}/background"))
        self._known = (
            _UpTo(cameras, states, partial(add_state, cameras)),
            _UpTo(points, tracks, lambda m: points.add(header_stamp_ns(m), fixed_points_from_message(m))),
        )

    def __str__(self) -> str:
        return (
            f"equal to the live graph bit for bit: {self.initial[1]} of {self.initial[0]} initial poses,"
            f" {self.windows[1]} of {self.windows[0]} windows"
        )

    def effort_at(self, stamp_ns: int) -> Effort | None:
        """Effort of the window that ends here, the next in order; None where the graph adjusted none.

        The core is given what the graph knew of the camera and of the scene then; without any windows that is all up
        to the newest image.
        """
        if self._has_windows and not self._next_window(stamp_ns):
            return None
        known_ns = (stamp_ns, stamp_ns) if self._current is None else self._current.known_ns
        for history, newest_ns in zip(self._known, known_ns, strict=True):
            history.go(newest_ns)
        return Effort() if self._current is None else self._current.effort

    def _next_window(self, stamp_ns: int) -> bool:
        ahead = next((i for i, w in enumerate(self._windows) if w.stamp_ns == stamp_ns), None)
        if ahead is None or any(w.stamp_ns > stamp_ns for w in islice(self._windows, ahead)):
            return False
        for _ in range(ahead + 1):
            self._current = self._windows.popleft()
        return True

    def compare_initial(self, stamp_ns: int, joints: np.ndarray) -> None:
        """Compare with the published pose of the same stamp, if any."""
        theirs = self._initial.get(stamp_ns)
        if theirs:
            self.initial[0] += 1
            self.initial[1] += theirs.popleft() == _fingerprint(joints)

    def compare_window(self, stamp_ns: np.ndarray, joints: np.ndarray) -> None:
        """Compare the joints (F, P, 3) at the stamps (F,) with the window that :meth:`effort_at` found last."""
        theirs, self._current = self._current, None
        if theirs is not None:
            self.windows[0] += 1
            self.windows[1] += theirs.fingerprint == _fingerprint(stamp_ns, joints)


class _UpTo:
    """Gives a history the messages of a topic, in their order, up to one of a stamp; messages are streamed."""

    def __init__(
        self, history: CameraHistory | PointHistory, messages: Iterator[Message], take: Callable[[Message], None]
    ) -> None:
        self._history, self._messages, self._take = history, messages, take
        self._next = next(messages, None)

    def go(self, newest_ns: int) -> None:
        while self._next is not None and self._history.newest_ns != newest_ns:
            if self._history.newest_ns < newest_ns < header_stamp_ns(self._next):
                break  # the recording lacks that message
            with contextlib.suppress(InputError):  # the live graph refused it too
                self._take(self._next)
            self._next = next(self._messages, None)


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


class _Frame(NamedTuple):
    """A frame's pose (17, 3) m: in ``map`` with the camera's rotation and position there, or in camera axes.

    path : 0 = in ``map``, else the number of the path in ``odom``
    """

    observation: PoseObservation
    joints: np.ndarray
    camera: tuple[np.ndarray, np.ndarray] | None = None
    path: int = 0

    def in_camera_axes(self) -> _Frame:
        """The pose with its pelvis at the origin."""
        if self.camera is None:
            return self
        rotation, _ = self.camera
        return _Frame(self.observation, (self.joints - self.joints[0]) @ rotation.T)


def _take_window(frames: dict[int, _Frame], window: AdjustedWindow) -> None:
    """Take the window's poses; a pose in ``map`` stays, as a window after the end of the telemetry holds it too."""
    path, joints = 0 if window.in_map is None else window.in_map.path, window.joints3d.astype(np.float32)
    for i, stamp_ns in enumerate(window.stamp_ns.tolist()):
        if window.in_map is not None or frames[stamp_ns].camera is None:
            frames[stamp_ns] = _Frame(frames[stamp_ns].observation, joints[i], _camera_of(window, i), path)


def _motion_of(
    session: Session, frames: dict[int, _Frame], matrix: np.ndarray | None, config: DrocapConfig
) -> tuple[Motion, Tracks]:
    """The motion in ``map``, or of one path in ``odom``, where at least half of the frames are there; else of all in
    camera axes.
    """
    paths = [frame.path for frame in frames.values() if frame.camera is not None]
    path = max(sorted(set(paths)), key=paths.count, default=0)
    there = {stamp: frame for stamp, frame in frames.items() if frame.camera is not None and frame.path == path}
    if there and 2 * len(there) >= len(frames):
        tracks, joints3d = _arrays(session, there, matrix)
        return _motion_in_world(tracks, joints3d, config, metric=path == 0), tracks
    tracks, joints3d = _arrays(session, {stamp: frame.in_camera_axes() for stamp, frame in frames.items()})
    return _motion(tracks, joints3d, config), tracks


def _camera_of(window: AdjustedWindow, frame: int) -> tuple[np.ndarray, np.ndarray] | None:
    return None if window.in_map is None else (window.in_map.rotation[frame], window.in_map.position[frame])


def _arrays(session: Session, frames: dict[int, _Frame], matrix: np.ndarray | None = None) -> tuple[Tracks, np.ndarray]:
    """Tracks of the frames with a pose, with the camera's poses where all have one, and their poses."""
    stamps = sorted(stamp for stamp, frame in frames.items() if np.isfinite(frame.joints).all())
    if not stamps:
        raise InputError(f"{session.path}: expected keypoints of a person, found none that gives a pose; check them")
    used = [frames[stamp] for stamp in stamps]
    first = used[0].observation
    for other in (frame.observation for frame in used):
        if (other.joints, other.image_size) != (first.joints, first.image_size):
            raise InputError(
                f"{session.path}: expected {_format(first)} throughout, got {_format(other)}; cut the recording where"
                " that changes"
            )
    return _tracks(stamps, used, matrix), np.array([frame.joints for frame in used], np.float64)


def _tracks(stamps: list[int], frames: list[_Frame], matrix: np.ndarray | None) -> Tracks:
    observations = [frame.observation for frame in frames]
    known = [frame.camera for frame in frames if frame.camera is not None]
    rotation, position = map(np.array, zip(*known, strict=True)) if known else (None, None)
    return Tracks(
        keypoints=np.array([o.keypoints for o in observations], np.float64),
        joints=observations[0].joints.joints,
        stamp_ns=np.array(stamps, np.int64),
        image_size=observations[0].image_size,
        confidence=np.array([o.confidence for o in observations], np.float64),
        covariance=np.array([o.covariance for o in observations], np.float64),
        camera_rotation=rotation,
        camera_position=position,
        camera_matrix=matrix,
        real_lens=True,
    )


def _format(observation: PoseObservation) -> str:
    width, height = observation.image_size
    return f"{observation.joints.name} in images of {width}x{height} px"


def _motion_in_world(tracks: Tracks, joints3d: np.ndarray, config: DrocapConfig, *, metric: bool) -> Motion:
    assert tracks.camera_rotation is not None
    assert tracks.camera_position is not None
    seen = (joints3d - joints3d[:, :1]) @ np.swapaxes(tracks.camera_rotation, 1, 2)
    motion = _motion(tracks, seen, config)
    camera = tracks.camera_rotation, tracks.camera_position, tracks.camera_matrix
    off = motion.reprojection_px if camera[2] is None else reprojection_px(joints3d, *camera, motion.keypoints)
    return dataclasses.replace(
        motion,
        joints3d=joints3d,
        frame="world",
        metric=metric,
        scale_source="telemetry" if metric else "assumed_height",
        camera_rotation=tracks.camera_rotation,
        camera_position=tracks.camera_position,
        reprojection_px=off,
    )


def _motion(tracks: Tracks, joints3d: np.ndarray, config: DrocapConfig) -> Motion:
    keypoints = Keypoints2D(tracks.keypoints, tracks.confidence).with_joints(len(BODY_17))
    seen = keypoints.seen
    return Motion(
        joints3d=joints3d,
        joints=BODY_17.joints,
        parents=BODY_17.parents,
        stamp_ns=tracks.stamp_ns,
        frame="camera",
        metric=False,
        scale_source="assumed_height",
        camera_rotation=np.broadcast_to(np.eye(3), (len(tracks), 3, 3)).copy(),
        confidence=keypoints.weights,
        keypoints=np.where(seen[..., None], keypoints.xy, np.nan),
        reprojection_px=_reprojection_px(joints3d, keypoints.xy, seen),
        meta={"assumed_height_m": config.initializer.assumed_height_m},
    )


def _reprojection_px(joints3d: np.ndarray, keypoints: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(F, P) px to the keypoints, after the best scale and translation of each image (weak perspective)."""
    weight = seen[..., None].astype(np.float64)
    count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    target = np.where(seen[..., None], keypoints, 0.0)
    x = joints3d[..., :2] - (weight * joints3d[..., :2]).sum(axis=1, keepdims=True) / count
    y = target - target.sum(axis=1, keepdims=True) / count
    scale = (weight * x * y).sum(axis=(1, 2)) / np.maximum((weight * x * x).sum(axis=(1, 2)), 1e-12)
    gap = np.linalg.norm(scale[:, None, None] * x - y, axis=-1)
    return np.where(seen, gap, np.nan)
