"""Interface of all image sources, their parameters and prefetching."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class ImageIngestConfig(Parameters):
    """Image source, and how its images are published."""

    source: str = param("", "video file, image folder, /dev/videoN, rtsp://, udp://, or topic:NAME of an image topic")
    loop: bool = param(False, "restart a file at its end; stamps continue to increase")
    realtime: bool = param(True, "publish a file at the pace of its stamps; false: as fast as it decodes")
    max_rate_hz: float = param(0.0, "images beyond this rate are skipped; 0 = none", unit="Hz", minimum=0, maximum=1000)
    folder_rate_hz: float = param(
        30.0, "rate of an image folder whose file names are not stamps", unit="Hz", minimum=0.01, maximum=1000
    )
    jpeg_quality: int = param(90, "quality of the published JPEG", minimum=1, maximum=100)
    width_px: int = param(0, "requested from a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    height_px: int = param(0, "requested from a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    rate_hz: float = param(0.0, "requested from a V4L2 camera; 0 = its default", unit="Hz", minimum=0, maximum=1000)
    stall_timeout_s: float = param(
        1.5, "a live source without an image for this long is reported as stalled", unit="s", minimum=0.1, maximum=60
    )
    reconnect_max_s: float = param(
        10.0, "longest pause between attempts to reconnect to a live source", unit="s", minimum=0.1, maximum=600
    )
    calibration_file: str = param(
        "", "calibration: YAML of camera_calibration or OpenCV, TOML of Pose2Sim (FILE#CAMERA); empty: none"
    )
    horizontal_fov_deg: float = param(
        0.0, "horizontal field of view where there is no calibration; 0 = unknown", unit="deg", minimum=0, maximum=170
    )
    focal_px: float = param(0.0, "focal length of these images instead; 0 = unknown", unit="px", minimum=0, maximum=1e6)
    frame_id: str = param("camera_optical", "optical frame of the images")


@dataclass(frozen=True)
class Frame:
    """One image and its exposure time.

    stamp_ns : int, the container's or driver's presentation time, strictly increasing within a source
    image : (H, W, 3) uint8, BGR
    """

    stamp_ns: int
    image: np.ndarray


class SourceEventKind(Enum):
    """Kinds of source events; the values are keys of the diagnostics and, with spaces, the words of the log."""

    STALLED = "stalled"
    RECONNECTING = "reconnecting"
    RECOVERED = "recovered"
    ENDED_EARLY = "ended_early"
    DAMAGED = "damaged"
    NO_TIMES = "no_presentation_times"


@dataclass(frozen=True)
class SourceEvent:
    """Event of a source that a user should see."""

    kind: SourceEventKind
    source: str
    detail: str

    def __str__(self) -> str:
        return f"{self.source}: {self.kind.value.replace('_', ' ')}: {self.detail}"


class ImageSource(AbstractContextManager["ImageSource"]):
    """Iterator of :class:`Frame` and context manager.

    size : (width, height) px of every frame
    length : number of frames where the source states it (for progress only), else None
    duration_s : from the first frame to the last where the source states it, else None
    live : whether frames arrive at their own pace and unread ones are lost
    """

    size: tuple[int, int]
    length: int | None = None
    duration_s: float | None = None
    live: bool = False

    def __init__(self) -> None:
        self._events: list[SourceEvent] = []

    @abstractmethod
    def read(self) -> Frame | None:
        """Next frame, or None at the end."""

    @abstractmethod
    def close(self) -> None:
        """Release the file or device; may be called twice."""

    def events(self) -> list[SourceEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the end."""
        while (frame := self.read()) is not None:
            yield frame

    def __exit__(self, *_: object) -> None:
        """Close on leaving the context."""
        self.close()


def prefetch(frames: Iterable[Frame], ahead: int = 4) -> Generator[Frame, None, None]:
    """The same frames in the same order, up to ``ahead`` of them decoded in advance.

    An error of the source is raised in place of its frame.  Closing the generator stops the thread.
    """
    iterator = iter(frames)
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        pending = deque(pool.submit(next, iterator, None) for _ in range(ahead))
        while (frame := pending.popleft().result()) is not None:
            pending.append(pool.submit(next, iterator, None))
            yield frame
    finally:
        # A file must not be closed during a read; the read of a live source ends only by its closing.
        pool.shutdown(wait=not getattr(frames, "live", False), cancel_futures=True)


def with_next(frames: Iterable[Frame]) -> Iterator[tuple[Frame, Frame | None]]:
    """Each frame with the one after it; None after the last one."""
    last: Frame | None = None
    for frame in frames:
        if last is not None:
            yield last, frame
        last = frame
    if last is not None:
        yield last, None


@contextlib.contextmanager
def in_order(call: Callable[..., None], waiting: int = 4) -> Iterator[Callable[..., None]]:
    """A function that hands its arguments to ``call`` in another thread, in order.

    waiting : most calls that wait for that thread; a further one waits for the first of them

    An error of a call is raised by a later one, or at the end.
    """
    pending: deque[Future[None]] = deque()

    def submit(*arguments: object) -> None:
        if len(pending) >= waiting:
            pending.popleft().result()
        pending.append(pool.submit(call, *arguments))

    with ThreadPoolExecutor(1, thread_name_prefix="in_order") as pool:
        yield submit
        for done in pending:
            done.result()
