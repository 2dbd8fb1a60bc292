"""A recorded session through the live graph's own method, offline: ``drocap reconstruct SESSION --method live``."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.config import DrocapConfig, parse_config
from drocap_ros.errors import InputError
from drocap_ros.motion import Motion
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.live.effort import Effort
from drocap_ros.reconstruction.live.replay import LivePose, LiveWindow, live_poses
from drocap_ros.recording.pose_messages import read_observations
from drocap_ros.recording.provenance import CONFIGURATION
from drocap_ros.recording.session import POSE2D, POSE3D, POSE3D_WINDOW, Session
from drocap_ros.skeleton import BODY_15, indices
from drocap_ros.tracks import Tracks

logger = logging.getLogger(__name__)

_INITIAL = 1
Progress = Callable[[str, float], None]


@dataclass
class Agreement:
    """How what was computed offline compares with what the live graph published, bit for bit.

    initial, windows : compared, and of these equal
    """

    initial: list[int] = field(default_factory=lambda: [0, 0])
    windows: list[int] = field(default_factory=lambda: [0, 0])

    def __str__(self) -> str:
        return (
            f"equal to the live graph bit for bit: {self.initial[1]} of {self.initial[0]} initial poses,"
            f" {self.windows[1]} of {self.windows[0]} windows"
        )


def recorded_config(session: Session) -> DrocapConfig | None:
    """The configuration that the session was recorded with; None where it tells none that this version knows."""
    import yaml

    text = session.info.metadata.get(CONFIGURATION)
    if not text:
        return None
    try:
        return parse_config(yaml.safe_load(text) or {}, f"{session.path}: {CONFIGURATION}")
    except (InputError, yaml.YAMLError) as error:
        session.warn(f"the recorded configuration cannot be used ({error}); took the given one")
        return None


def reconstruct_live(
    session: Session, config: DrocapConfig, progress: Progress | None = None
) -> tuple[Motion, Tracks, Agreement]:
    """Motion by the sliding windows of the live graph, from the session's ``pose2d`` messages alone.

    A frame's pose is that of the last window that holds it, else its initial one; in frame "camera", as the graph
    publishes it.  The windows are those that the live graph adjusted where the session tells them, else all that are
    due.  Memory: the poses themselves and one window.

    Raises
    ------
    InputError
        When the session holds no keypoints of a person.
    """
    topic = session.choose_topic(None, POSE2D)
    published = _Published(session, topic.name)
    begin = time.perf_counter()
    frames: dict[int, tuple[PoseObservation, np.ndarray]] = {}
    last_window: LiveWindow | None = None
    iterations = 0
    results = live_poses(
        read_observations(session, topic.name),
        config.initializer,
        config.bundle_adjuster,
        published.adjusted if published.has_windows else None,
    )
    for done, result in enumerate(results):
        if isinstance(result, LivePose):
            stamp_ns = result.observation.stamp_ns
            published.compare_initial(stamp_ns, result.joints3d)
            frames[stamp_ns] = (result.observation, result.joints3d)
        else:
            published.compare_window(result)
            for stamp_ns, joints in zip(result.stamp_ns.tolist(), result.joints3d, strict=True):
                frames[stamp_ns] = (frames[stamp_ns][0], joints)
            last_window, iterations = result, iterations + result.iterations
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
        stop_reason=last_window.stop_reason if last_window is not None else "no window was due",
        live_agreement=str(published.agreement),
        seconds={"live": time.perf_counter() - begin},
    )
    return motion, tracks, published.agreement


class _Published:
    """What the live graph published; the same stamp may come again where a recording was played in a loop."""

    def __init__(self, session: Session, near: str) -> None:
        base = near.rsplit("/", 1)[0]
        # Fingerprints: the windows of half an hour overlap twelvefold.
        self._initial: defaultdict[int, deque[bytes]] = defaultdict(deque)
        self._windows: deque[_PublishedWindow] = deque()
        self._current: _PublishedWindow | None = None
        self.agreement = Agreement()
        for topic in session.topics_of(POSE3D):
            if topic.name == f"{base}/pose3d/initial":
                for _, m in session.messages((topic.name,)):
                    if m.stage == _INITIAL:
                        self._initial[_stamp_ns(m)].append(_fingerprint(_joints(m)))
        for topic in session.topics_of(POSE3D_WINDOW):
            if topic.name == f"{base}/pose3d/refined":
                for _, m in session.messages((topic.name,)):
                    stamps = np.array([_stamp_ns(pose) for pose in m.poses], np.int64)
                    joints = np.array([_joints(pose) for pose in m.poses])
                    published = _PublishedWindow(
                        _stamp_ns(m), _fingerprint(stamps, joints), Effort.parse(m.stop_reason)
                    )
                    self._windows.append(published)
        self.has_windows = bool(self._windows)

    def adjusted(self, stamp_ns: int) -> Effort | None:
        """How the window that ends here, the next in order, was adjusted; None when it was not."""
        ahead = next((i for i, w in enumerate(self._windows) if w.stamp_ns == stamp_ns), None)
        if ahead is None or any(w.stamp_ns > stamp_ns for w in islice(self._windows, ahead)):
            return None
        for _ in range(ahead + 1):
            self._current = self._windows.popleft()
        assert self._current is not None
        return self._current.effort

    def compare_initial(self, stamp_ns: int, joints: np.ndarray) -> None:
        """Count, and whether it is the same."""
        theirs = self._initial.get(stamp_ns)
        if theirs:
            _count(self.agreement.initial, theirs.popleft() == _fingerprint(joints))

    def compare_window(self, window: LiveWindow) -> None:
        """Count, and whether it is the same as the one that :meth:`adjusted` told last."""
        theirs, self._current = self._current, None
        if theirs is not None:
            _count(self.agreement.windows, theirs.fingerprint == _fingerprint(window.stamp_ns, window.joints3d))


class _PublishedWindow(NamedTuple):
    stamp_ns: int
    fingerprint: bytes
    effort: Effort


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
    order = indices(tracks.joints, BODY_15.joints)
    keypoints = tracks.keypoints[:, order]
    seen = np.isfinite(keypoints).all(axis=2)
    assert tracks.confidence is not None
    return Motion(
        joints3d=joints3d,
        joints=BODY_15.joints,
        parents=BODY_15.parents,
        stamp_ns=tracks.stamp_ns,
        frame="camera",
        metric=False,
        scale_source="assumed_height",
        camera_rotation=np.broadcast_to(np.eye(3), (len(tracks), 3, 3)).copy(),
        confidence=np.where(seen, np.nan_to_num(tracks.confidence[:, order]), 0.0),
        keypoints=np.where(seen[..., None], keypoints, np.nan),
        reprojection_px=_reprojection_px(joints3d, keypoints, seen),
        meta={"assumed_height_m": config.initializer.assumed_height_m},
    )


def _reprojection_px(joints3d: np.ndarray, keypoints: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(F, P) px to the keypoints, after the best scale and place of each image (weak perspective)."""
    weight = seen[..., None].astype(np.float64)
    count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    target = np.where(seen[..., None], keypoints, 0.0)
    x = joints3d[..., :2] - (weight * joints3d[..., :2]).sum(axis=1, keepdims=True) / count
    y = target - target.sum(axis=1, keepdims=True) / count
    scale = (weight * x * y).sum(axis=(1, 2)) / np.maximum((weight * x * x).sum(axis=(1, 2)), 1e-12)
    gap = np.linalg.norm(scale[:, None, None] * x - y, axis=-1)
    return np.where(seen, gap, np.nan)


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _joints(message: Any) -> np.ndarray:
    return np.asarray(message.joints, np.float32).reshape(-1, 3)
