"""Cameras and network streams: a thread keeps the newest image and reconnects with back-off."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.image_ingest_config import ImageIngestConfig
from drocap_ros.perception.sources.pixels import to_bgr
from drocap_ros.perception.sources.video import ffmpeg_options, quiet_ffmpeg

if TYPE_CHECKING:
    import cv2

log = logging.getLogger(__name__)

#: First pause before the next attempt to connect; it doubles up to ``reconnect_max_s``.
_FIRST_BACKOFF_S = 0.25
#: Longest wait for the first image: FFmpeg's own time-out of 8 s (below) and the first key frame.
_OPEN_TIMEOUT_S = 12.0
#: Largest relative drift of a slower stream clock; crystals are accurate to 50 ppm.
_DRIFT = 2e-4
#: Beyond this the system clock was set; less is a pause between two readings of the clocks.
_SET_NS = 100_000_000

_STREAM_OPTIONS = (
    "rtsp_transport;tcp|fflags;nobuffer"
    "|protocol_whitelist;file,pipe,rtp,udp,tcp,http,https,tls,rtsp,rtsps,srt,rtmp,crypto"
)


class StreamClock:
    """Maps presentation times to the system clock.

    The offset is the smallest difference between arrival and presentation time so far, because network and decoder
    only add delay.  It grows by 0.2 per mille of the elapsed time, to follow a slower stream clock.  A system clock
    that is set (NTP, after a start without a battery clock) is no delay: stamps follow it at once, also back.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._position = 0
        self._last = 0
        self._system_ns: int | None = None  # system clock minus steady clock

    def stamp(self, position_ns: int, now_ns: int, steady_ns: int | None = None) -> int:
        """Stamp of an image with presentation time ``position_ns`` that arrived at ``now_ns``; strictly increasing
        while nobody sets the clock.

        steady_ns : arrival by a clock that nobody sets; None = nobody sets the system clock
        """
        system_ns = now_ns - (now_ns if steady_ns is None else steady_ns)
        set_ns = 0 if self._system_ns is None else system_ns - self._system_ns
        self._system_ns = system_ns
        if abs(set_ns) > _SET_NS and self._offset is not None:
            self._offset += set_ns
            self._last += min(set_ns, 0)
        difference = now_ns - position_ns
        if self._offset is None or position_ns < self._position:  # first image, or the stream restarted
            self._offset = difference
        else:
            self._offset = min(self._offset + _DRIFT * (position_ns - self._position), difference)
        self._position = position_ns
        self._last = max(position_ns + round(self._offset), self._last + 1)
        return self._last


class LiveSource(ImageSource):
    """Frames of a camera or stream that may stall or disconnect.

    A thread reads every image and keeps the newest, so that a slow reader gets fresh images and the driver's queue
    stays empty.  A ``STALLED`` event follows ``stall_timeout_s`` without an image.  A connection that ended is opened
    again with doubling pauses, and a ``RECOVERED`` event follows the next image.

    Parameters
    ----------
    name : in messages
    connect : opens an OpenCV capture, or raises InputError
    config : stall time-out and longest reconnection pause
    """

    live = True

    def __init__(self, name: str, connect: Callable[[], cv2.VideoCapture], config: ImageIngestConfig) -> None:
        super().__init__()
        self.name = name
        self._connect = connect
        self._stall_s = config.stall_timeout_s
        self._backoff_max_s = config.reconnect_max_s
        self._condition = threading.Condition()
        self._newest: Frame | None = None
        self._received = 0
        self._error: str | None = None
        self._stalled = False
        self._closed = False
        self._last_arrival = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"source {name}", daemon=True)
        self._thread.start()
        self._watch = threading.Thread(target=self._watch_stall, name=f"watch {name}", daemon=True)
        with self._condition:
            self._condition.wait_for(lambda: self._newest or self._error, timeout=_OPEN_TIMEOUT_S)
            first = self._newest
        if first is None:
            self.close()
            why = self._error or f"no image within {_OPEN_TIMEOUT_S:g} s"
            raise InputError(
                f"{name}: expected a camera or stream that gives images; {why}; check its address and power"
            )
        self.size = (first.image.shape[1], first.image.shape[0])
        self._watch.start()

    def read(self) -> Frame | None:
        """Newest unread frame; waits for one; None after :meth:`close`."""
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

    def _event(self, kind: SourceEventKind, detail: str) -> None:
        event = SourceEvent(kind, self.name, detail)
        log.warning(str(event))
        with self._condition:
            self._events.append(event)

    def _watch_stall(self) -> None:
        while not self._closed:
            time.sleep(min(0.1, self._stall_s / 4))
            silence = time.monotonic() - self._last_arrival
            if silence > self._stall_s and not self._stalled and not self._closed:
                self._stalled = True
                self._event(SourceEventKind.STALLED, f"no image for {silence:.1f} s")

    def _run(self) -> None:
        pause = _FIRST_BACKOFF_S
        while not self._closed:
            try:
                capture = self._connect()
            except InputError as error:
                if self._received == 0:
                    self._fail(str(error))
                    return
            else:
                images = self._drain(capture)
                capture.release()
                if images:
                    pause = _FIRST_BACKOFF_S
                elif self._received == 0:
                    self._fail("it opened but gave no image")
                    return
            if self._closed:
                return
            words = f"connection ended after {self._received} images; next attempt in {pause:.2g} s"
            self._event(SourceEventKind.RECONNECTING, words)
            with self._condition:
                self._condition.wait_for(lambda: self._closed, timeout=pause)
            pause = min(2 * pause, self._backoff_max_s)

    def _fail(self, why: str) -> None:
        with self._condition:
            self._error = why
            self._condition.notify_all()

    def _drain(self, capture: cv2.VideoCapture) -> int:
        """Read until the connection ends; returns the number of images."""
        import cv2

        clock = StreamClock()
        images = 0
        while not self._closed:
            ok, image = capture.read()
            if not ok or image is None:
                break
            position_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            stamp = clock.stamp(position_ns, time.time_ns(), time.monotonic_ns())
            images += 1
            self._last_arrival = time.monotonic()
            if self._stalled:
                self._stalled = False
                self._event(SourceEventKind.RECOVERED, "images arrive again")
            with self._condition:
                self._received += 1
                self._newest = Frame(stamp, to_bgr(image))
                self._condition.notify_all()
        return images


def open_camera(index: int, config: ImageIngestConfig) -> LiveSource:
    """V4L2 camera ``/dev/videoN``; its stamps are the driver's buffer times."""

    def connect() -> cv2.VideoCapture:
        import cv2

        quiet_ffmpeg()
        capture = cv2.VideoCapture(index, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise InputError(f"/dev/video{index}: expected a V4L2 camera, none could be opened")
        requested = {
            cv2.CAP_PROP_FRAME_WIDTH: config.width_px,
            cv2.CAP_PROP_FRAME_HEIGHT: config.height_px,
            cv2.CAP_PROP_FPS: config.rate_hz,
        }
        for key, value in requested.items():
            if value:
                capture.set(key, value)
        return capture

    return LiveSource(f"/dev/video{index}", connect, config)


def open_stream(url: str, config: ImageIngestConfig) -> LiveSource:
    """RTSP (over TCP), UDP or HTTP stream, a named pipe, or an ``.sdp`` file that describes an RTP stream.

    ``OPENCV_FFMPEG_CAPTURE_OPTIONS`` of the environment replaces the options for FFmpeg.
    """

    def connect() -> cv2.VideoCapture:
        import cv2

        quiet_ffmpeg()
        wait_ms = max(1000, round(2000 * config.stall_timeout_s))
        options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 8000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait_ms]
        with ffmpeg_options(_STREAM_OPTIONS):
            capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, options)
        if not capture.isOpened():
            raise InputError("FFmpeg found no stream there")
        return capture

    return LiveSource(url, connect, config)
