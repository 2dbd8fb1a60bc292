"""What a recording holds of the live graph's results, and of the camera as the graph knew it at each of them."""

from __future__ import annotations

import contextlib
import hashlib
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.camera_history import CameraHistory, WindowCamera
from drocap_ros.recording import session as recorded
from drocap_ros.recording.pose_messages import add_calibration, add_state
from drocap_ros.recording.session import Message, Session, header_stamp_ns, stamp_of
from drocap_ros.stamps import StampValidator

_INITIAL = 1  # Pose3D.INITIAL


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
    telemetry_ns : stamp of the newest state of the vehicle that it knew, 0 = none
    """

    stamp_ns: int
    fingerprint: bytes
    stride: int
    steps: tuple[int, int] | None
    telemetry_ns: int


class RecordedCamera:
    """The camera's history as the live graph had it at each of its adjustments; messages are streamed."""

    def __init__(self, session: Session, near: str, keep_s: float) -> None:
        base = near.rsplit("/", 1)[0]
        self._history = CameraHistory(keep_s)
        self._states = _accepted(_messages(session, recorded.VEHICLE_STATE, f"{base}/vehicle/state"))
        self._next = next(self._states, None)
        for message in _accepted(_messages(session, recorded.CAMERA_INFO, f"{base}/camera_info")):
            with contextlib.suppress(InputError):  # the live graph refused it too
                add_calibration(self._history, message)
        self.matrix: np.ndarray | None = None

    def along(self, stamp_ns: np.ndarray, size: tuple[int, int], newest_ns: int) -> WindowCamera | None:
        """The camera at a window's images (F,) of a size, by the states up to that of the stamp ``newest_ns``."""
        history = self._history
        while self._next is not None and history.newest_ns != newest_ns:
            if history.newest_ns < newest_ns < header_stamp_ns(self._next):
                break  # the recording lacks that state
            add_state(history, self._next)
            self._next = next(self._states, None)
        camera = history.along(stamp_ns, size)
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
            known_ns = stamp_of(m.telemetry_stamp)
            self._windows.append(
                PublishedWindow(header_stamp_ns(m), _fingerprint(stamps, joints), int(m.stride), steps, known_ns)
            )
        self.has_windows = bool(self._windows)

    def next_window(self, stamp_ns: int) -> PublishedWindow | None:
        """The window that ends here, the next in order; None when the graph adjusted none."""
        ahead = next((i for i, w in enumerate(self._windows) if w.stamp_ns == stamp_ns), None)
        if ahead is None or any(w.stamp_ns > stamp_ns for w in islice(self._windows, ahead)):
            return None
        for _ in range(ahead + 1):
            self._current = self._windows.popleft()
        return self._current

    @property
    def telemetry_ns(self) -> int:
        """Of the window that :meth:`next_window` returned last: stamp of the newest state that it knew, 0 = none."""
        return 0 if self._current is None else self._current.telemetry_ns

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
