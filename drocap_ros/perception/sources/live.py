"""Cameras and network streams: read in a thread, newest image first, reconnected with back-off."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.perception_config import ImageIngestConfig
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent
from drocap_ros.perception.sources.pictures import to_bgr
from drocap_ros.perception.sources.stamps import StreamClock

log = logging.getLogger(__name__)

_FIRST_BACKOFF_S = 0.25

_STREAM_OPTIONS = (
    "rtsp_transport;tcp|fflags;nobuffer"
    "|protocol_whitelist;file,pipe,rtp,udp,tcp,http,https,tls,rtsp,rtsps,srt,rtmp,crypto"
)


class Connection(Protocol):
    """An open camera or stream."""

    def read(self) -> tuple[int, np.ndarray] | None:
        """(presentation time in ns, image), or None when the connection has ended."""

    def close(self) -> None:
        """Release it."""


class LiveSource(ImageSource):
    """Frames of a camera or stream that may stop and come back.

    A thread takes every image and keeps the newest, so a slow reader sees fresh images and the driver's
    queue never fills.  Without an image for ``stall_timeout_s`` a ``stalled`` event is raised (also to the
    log and to ``on_event``); a connection that has ended is opened again with doubling pauses, and a
    ``recovered`` event tells when images flow again.

    Raises
    ------
    InputError
        When the first connection fails or gives no image within ``open_timeout_s``.
    """

    live = True

    def __init__(
        self,
        name: str,
        connect: Callable[[], Connection],
        *,
        stall_timeout_s: float = 1.5,
        reconnect_max_s: float = 10.0,
        open_timeout_s: float = 10.0,
        clock: Callable[[], int] = time.time_ns,
        on_event: Callable[[SourceEvent], None] | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.on_event = on_event
        self._connect = connect
        self._stall_s = stall_timeout_s
        self._backoff_max_s = reconnect_max_s
        self._clock = clock
        self._condition = threading.Condition()
        self._newest: Frame | None = None
        self._seen = 0
        self._error: str | None = None
        self._stalled = False
        self._closed = False
        self._last_arrival = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"source {name}", daemon=True)
        self._thread.start()
        self._watch = threading.Thread(target=self._watch_stall, name=f"watch {name}", daemon=True)
        with self._condition:
            self._condition.wait_for(lambda: self._newest or self._error, timeout=open_timeout_s)
            first = self._newest
        if first is None:
            self.close()
            why = self._error or f"no image within {open_timeout_s:g} s"
            raise InputError(
                f"{name}: expected a camera or stream that gives images; {why}; check its address and power"
            )
        self.size = (first.image.shape[1], first.image.shape[0])
        self._watch.start()

    def read(self) -> Frame | None:
        """Newest frame not yet taken; waits for one; None after :meth:`close`."""
        with self._condition:
            self._condition.wait_for(lambda: self._newest is not None or self._closed)
            frame, self._newest = self._newest, None
            return None if self._closed else frame

    def close(self) -> None:
        """Stop the threads and release the device."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2.0)

    def _event(self, kind: str, text: str) -> None:
        event = SourceEvent(kind, f"{self.name}: {text}")
        log.warning(event.text)
        with self._condition:
            self._events.append(event)
        if self.on_event is not None:
            self.on_event(event)

    def _watch_stall(self) -> None:
        while not self._closed:
            time.sleep(min(0.1, self._stall_s / 4))
            silence = time.monotonic() - self._last_arrival
            if silence > self._stall_s and not self._stalled and not self._closed:
                self._stalled = True
                self._event("stalled", f"no image for {silence:.1f} s")

    def _run(self) -> None:
        pause = _FIRST_BACKOFF_S
        while not self._closed:
            try:
                connection = self._connect()
            except InputError as error:
                if self._seen == 0:
                    self._fail(str(error))
                    return
            else:
                images = self._drain(connection)
                connection.close()
                if images:
                    pause = _FIRST_BACKOFF_S
                elif self._seen == 0:
                    self._fail("it opened but gave no image")
                    return
            if self._closed:
                return
            self._event("reconnecting", f"connection ended after {self._seen} images; trying again in {pause:.2g} s")
            with self._condition:
                self._condition.wait_for(lambda: self._closed, timeout=pause)
            pause = min(2 * pause, self._backoff_max_s)

    def _fail(self, why: str) -> None:
        with self._condition:
            self._error = why
            self._condition.notify_all()

    def _drain(self, connection: Connection) -> int:
        clock = StreamClock()
        images = 0
        while not self._closed and (item := connection.read()) is not None:
            position_ns, image = item
            stamp = clock.stamp(position_ns, self._clock())
            images += 1
            self._last_arrival = time.monotonic()
            if self._stalled:
                self._stalled = False
                self._event("recovered", "images flow again")
            with self._condition:
                self._seen += 1
                self._newest = Frame(stamp, to_bgr(image))
                self._condition.notify_all()
        return images


class CaptureConnection:
    """An OpenCV capture as a :class:`Connection`."""

    def __init__(self, capture: Any) -> None:
        self._capture = capture

    def read(self) -> tuple[int, np.ndarray] | None:
        """Next image and the driver's or container's time of it."""
        import cv2

        ok, image = self._capture.read()
        if not ok or image is None:
            return None
        return round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6), image

    def close(self) -> None:
        """Release it."""
        self._capture.release()


def open_camera(index: int, config: ImageIngestConfig) -> LiveSource:
    """V4L2 camera ``/dev/videoN``; its stamps are the driver's buffer times."""

    def connect() -> Connection:
        import cv2

        from drocap_ros.perception.sources.video import quiet_ffmpeg

        quiet_ffmpeg()
        capture = cv2.VideoCapture(index, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise InputError(f"/dev/video{index}: expected a V4L2 camera, none could be opened")
        wishes = {
            cv2.CAP_PROP_FRAME_WIDTH: config.width_px,
            cv2.CAP_PROP_FRAME_HEIGHT: config.height_px,
            cv2.CAP_PROP_FPS: config.rate_hz,
        }
        for key, value in wishes.items():
            if value:
                capture.set(key, value)
        return CaptureConnection(capture)

    return _live(f"/dev/video{index}", connect, config)


def open_stream(url: str, config: ImageIngestConfig) -> LiveSource:
    """RTSP (over TCP), UDP or HTTP stream, a named pipe, or an ``.sdp`` file that describes an RTP stream.

    ``OPENCV_FFMPEG_CAPTURE_OPTIONS`` of the environment, where set, replaces the options given to FFmpeg.
    """

    def connect() -> Connection:
        import cv2

        from drocap_ros.perception.sources.video import ffmpeg_options, quiet_ffmpeg

        quiet_ffmpeg()
        wait_ms = max(1000, round(2000 * config.stall_timeout_s))
        options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 8000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait_ms]
        with ffmpeg_options(_STREAM_OPTIONS):
            capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, options)
        if not capture.isOpened():
            raise InputError("nothing answers there in a form that FFmpeg reads")
        return CaptureConnection(capture)

    return _live(url, connect, config)


def _live(name: str, connect: Callable[[], Connection], config: ImageIngestConfig) -> LiveSource:
    return LiveSource(
        name,
        connect,
        stall_timeout_s=config.stall_timeout_s,
        reconnect_max_s=config.reconnect_max_s,
        open_timeout_s=12.0,
    )
