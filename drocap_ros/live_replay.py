"""Runs a recorded session through the live method offline: ``drocap reconstruct SESSION --method live``."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.live.effort import Effort
from drocap_ros.reconstruction.live.replay import LivePose, LiveWindow, live_poses
from drocap_ros.reconstruction.stop_reason import NO_WINDOW
from drocap_ros.recording.pose_messages import read_observations
from drocap_ros.recording.provenance import CONFIGURATION
from drocap_ros.recording.session import POSE2D, POSE3D, POSE3D_WINDOW, Session, header_stamp_ns
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks

_INITIAL = 1  # Pose3D.INITIAL
Progress = Callable[[str, float], None]


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
            config = config.replace(name, **{key: values[key] for key in values.keys() & known})
    except (InputError, yaml.YAMLError, AttributeError) as error:
        session.warn(f"the recorded configuration cannot be used ({error}); the given one is used")
        return None
    return config


def reconstruct_live(
    session: Session, config: DrocapConfig, progress: Progress | None = None
) -> tuple[Motion, Tracks, Agreement]:
    """Motion by the live method, from the session's ``pose2d`` messages alone.

    A frame's pose is that of the last window that holds it, else its initial one; in frame "camera", as the graph
    publishes it.  The windows are those that the live graph adjusted where the session holds them, else all that are
    due.  Memory: the poses and one window.

    Raises
    ------
    InputError
        When the session holds no keypoints of a person.
    """
    topic = session.choose_topic(POSE2D)
    published = _Published(session, topic.name)
    begin = time.perf_counter()
    frames: dict[int, tuple[PoseObservation, np.ndarray]] = {}
    stop_reason, iterations = NO_WINDOW, 0
    results = live_poses(
        read_observations(session, topic.name),
        config.initializer,
        config.bundle_adjuster,
        published.effort_at if published.has_windows else None,
    )
    for done, result in enumerate(results):
        if isinstance(result, LivePose):
            stamp_ns = result.observation.stamp_ns
            published.compare_initial(stamp_ns, result.joints3d)
            frames[stamp_ns] = (result.observation, result.joints3d)
        else:
            published.compare_window(result)
            window = result.window
            for stamp_ns, joints in zip(window.stamp_ns.tolist(), result.joints3d, strict=True):
                frames[stamp_ns] = (frames[stamp_ns][0], joints)
            stop_reason, iterations = window.stop_reason, iterations + window.iterations
        if progress is not None and done % 50 == 0:
            progress("live", min(1.0, done / max(topic.count, 1)))
    tracks, joints3d = _arrays(session, frames)
    motion = _motion(tracks, joints3d, config)
    motion.meta.update(
        method="live",
        parameters={
            "initializer": dataclasses.asdict(config.initializer),
            "adjuster": dataclasses.asdict(config.bundle_adjuster),
        },
        frames=len(tracks),
        iterations=iterations,
        stop_reason=stop_reason,
        live_agreement=str(published.agreement),
        seconds={"live": time.perf_counter() - begin},
    )
    return motion, tracks, published.agreement


class _Published:
    """Results of the live graph; a stamp repeats where a recording was played in a loop."""

    def __init__(self, session: Session, near: str) -> None:
        base = near.rsplit("/", 1)[0]
        # Fingerprints save memory: the windows of half an hour overlap twelvefold.
        self._initial: defaultdict[int, deque[bytes]] = defaultdict(deque)
        self._windows: deque[_PublishedWindow] = deque()
        self._current: _PublishedWindow | None = None
        self.agreement = Agreement()
        for m in _messages(session, POSE3D, f"{base}/pose3d/initial"):
            if m.stage == _INITIAL:
                self._initial[header_stamp_ns(m)].append(_fingerprint(_joints(m)))
        for m in _messages(session, POSE3D_WINDOW, f"{base}/pose3d/refined"):
            stamps = np.array([header_stamp_ns(pose) for pose in m.poses], np.int64)
            joints = np.array([_joints(pose) for pose in m.poses])
            self._windows.append(_PublishedWindow(header_stamp_ns(m), _fingerprint(stamps, joints), _effort(m)))
        self.has_windows = bool(self._windows)

    def effort_at(self, stamp_ns: int) -> Effort | None:
        """Effort of the window that ends here, the next in order; None when the graph adjusted none."""
        ahead = next((i for i, w in enumerate(self._windows) if w.stamp_ns == stamp_ns), None)
        if ahead is None or any(w.stamp_ns > stamp_ns for w in islice(self._windows, ahead)):
            return None
        for _ in range(ahead + 1):
            self._current = self._windows.popleft()
        assert self._current is not None
        return self._current.effort

    def compare_initial(self, stamp_ns: int, joints: np.ndarray) -> None:
        """Compare with the published pose of the same stamp, if any."""
        theirs = self._initial.get(stamp_ns)
        if theirs:
            _count(self.agreement.initial, theirs.popleft() == _fingerprint(joints))

    def compare_window(self, result: LiveWindow) -> None:
        """Compare with the window that :meth:`effort_at` returned last."""
        theirs, self._current = self._current, None
        if theirs is not None:
            equal = theirs.fingerprint == _fingerprint(result.window.stamp_ns, result.joints3d)
            _count(self.agreement.windows, equal)


class _PublishedWindow(NamedTuple):
    stamp_ns: int
    fingerprint: bytes
    effort: Effort


def _effort(window: Any) -> Effort:
    """Effort of a Pose3DWindow; recordings older than its field ``stride`` hold it in the stop reason."""
    if hasattr(window, "stride"):
        return Effort(int(window.stride), (int(window.steps[0]), int(window.steps[1])) if len(window.steps) else None)
    stride = re.search(r"every (\d+)\. image", window.stop_reason)
    steps = re.search(r"(\d+) \+ (\d+) steps", window.stop_reason)
    return Effort(int(stride[1]) if stride else 1, (int(steps[1]), int(steps[2])) if steps else None)


def _messages(session: Session, kind: str, name: str) -> Iterator[Any]:
    """Messages of a topic, none when the session lacks it."""
    if any(topic.name == name for topic in session.topics_of(kind)):
        yield from (message for _, message in session.messages((name,)))


def _fingerprint(*arrays: np.ndarray) -> bytes:
    """Equal only where every bit is; any NaN counts as any other."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(str(array.shape).encode())
        digest.update(np.where(np.isnan(array), np.float32(np.nan), array).astype(array.dtype).tobytes())
    return digest.digest()


def _count(pair: list[int], equal: bool) -> None:
    pair[0] += 1
    pair[1] += equal


def _arrays(session: Session, frames: dict[int, tuple[PoseObservation, np.ndarray]]) -> tuple[Tracks, np.ndarray]:
    stamps = sorted(stamp for stamp, (_, joints) in frames.items() if np.isfinite(joints).all())
    if not stamps:
        raise InputError(f"{session.path}: expected keypoints of a person, found none that gives a pose; check them")
    observations = [frames[stamp][0] for stamp in stamps]
    first = observations[0]
    return (
        Tracks(
            keypoints=np.array([o.keypoints for o in observations], np.float64),
            joints=first.joints.joints,
            stamp_ns=np.array(stamps, np.int64),
            image_size=first.image_size,
            confidence=np.array([o.confidence for o in observations], np.float64),
            covariance=np.array([o.covariance for o in observations], np.float64),
        ),
        np.array([frames[stamp][1] for stamp in stamps], np.float64),
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


def _joints(message: Any) -> np.ndarray:
    return np.asarray(message.joints, np.float32).reshape(-1, 3)
