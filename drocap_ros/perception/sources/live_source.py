"""Cameras and network streams: a thread keeps the newest image and reconnects with back-off."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.perception.sources.base import Frame, ImageIngestConfig, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.image_files import to_bgr
from drocap_ros.perception.sources.video import Decoder, pyav

if TYPE_CHECKING:
    import cv2
    from av.container import InputContainer

#: Presentation times in ns, where known, and images; closing it releases the device.
Images = Generator[tuple["int | None", np.ndarray], None, None]

log = logging.getLogger(__name__)

#: First pause before the next attempt to connect; it doubles up to ``reconnect_max_s``.
_FIRST_BACKOFF_S = 0.25
#: Longest wait for an answer, and for the first image: the answer and the first key frame.
_ANSWER_TIMEOUT_S = 8.0
_OPEN_TIMEOUT_S = 12.0
#: Largest relative drift of a slower stream clock; crystals are accurate to 50 ppm.
_DRIFT = 2e-4
#: Beyond this the system clock was set; less is a pause between two readings of the clocks.
_SET_NS = 100_000_000

_STREAM_OPTIONS = {
    "rtsp_transport": "tcp",
    "fflags": "nobuffer",
    "protocol_whitelist": "file,pipe,rtp,udp,tcp,http,https,tls,rtsp,rtsps,srt,rtmp,crypto",
}


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

    name : in messages
    connect : opens the device, or raises InputError
    config : stall time-out and longest reconnection pause
    """

    live = True

    def __init__(self, name: str, connect: Callable[[], Images], config: ImageIngestConfig) -> None:
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
                arriving = self._connect()
            except InputError as error:
                if self._received == 0:
                    self._fail(str(error))
                    return
            else:
                images = self._drain(arriving)
                arriving.close()
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

    def _drain(self, arriving: Images) -> int:
        """Read until the connection ends; returns the number of images."""
        clock = StreamClock()
        images = 0
        for position_ns, image in arriving:
            if self._closed:
                break
            steady_ns = time.monotonic_ns()
            stamp = clock.stamp(steady_ns if position_ns is None else position_ns, time.time_ns(), steady_ns)
            images += 1
            self._last_arrival = time.monotonic()
            if self._stalled:
                self._stalled = False
                self._event(SourceEventKind.RECOVERED, "images arrive again")
            with self._condition:
                self._received += 1
                self._newest = Frame(stamp, image)
                self._condition.notify_all()
        return images


def open_camera(index: int, config: ImageIngestConfig) -> LiveSource:
    """V4L2 camera ``/dev/videoN``; its stamps are the driver's buffer times.

    OpenCV reads it: PyAV's wheels hold no V4L2.
    """

    def connect() -> Images:
        import cv2

        if hasattr(cv2.utils, "logging"):  # drocap reports each failure once
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
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
        return _captured(capture)

    def _captured(capture: cv2.VideoCapture) -> Images:
        import cv2

        try:
            while (read := capture.read())[0]:
                yield round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6), to_bgr(np.asarray(read[1]))
        finally:
            capture.release()

    return LiveSource(f"/dev/video{index}", connect, config)


def open_stream(url: str, config: ImageIngestConfig) -> LiveSource:
    """RTSP (over TCP), UDP or HTTP stream, a named pipe, or an ``.sdp`` file that describes an RTP stream."""

    def connect() -> Images:
        av = pyav()
        wait_s = max(1.0, 2 * config.stall_timeout_s)
        try:
            container = av.open(
                url, options=_STREAM_OPTIONS, timeout=(_ANSWER_TIMEOUT_S, wait_s), metadata_errors="replace"
            )
        except av.error.FFmpegError as error:
            raise InputError(f"FFmpeg found no stream there ({first_line(error)})") from None
        return _decoded(container)

    def _decoded(container: InputContainer) -> Images:
        with container:
            stream = next((s for s in container.streams.video if s.codec_context is not None), None)
            if stream is None:
                return
            stream.thread_type = "SLICE"  # threads by frames are late by as many frames
            decoder = Decoder(stream.codec_context, stream.time_base or Fraction(1, 90_000), stream.sample_aspect_ratio)
            with contextlib.suppress(pyav().error.FFmpegError):  # the connection ended
                for packet in container.demux(stream):
                    yield from decoder.images(packet)

    return LiveSource(url, connect, config)
