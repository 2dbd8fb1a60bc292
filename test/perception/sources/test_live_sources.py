"""Live sources that stall and recover, over loopback UDP as MPEG-TS and through a named pipe."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.perception.sources import SourceEventKind, open_source
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.perception.sources.live_source import StreamClock

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Three seconds of MPEG-TS."""
    path: Path = tmp_path_factory.mktemp("ts") / "a.ts"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MPG2"), 25, (160, 120))
    rng = np.random.default_rng(0)
    for _ in range(75):
        writer.write(rng.integers(0, 255, (120, 160, 3), np.uint8))
    writer.release()
    data = path.read_bytes()
    if not data or data[0] != 0x47:
        pytest.skip("this OpenCV writes no MPEG-TS")
    return data


class Sender:
    """Plays a stream in a loop to a UDP port; ``paused`` interrupts it."""

    def __init__(self, port: int, data: bytes) -> None:
        self.port, self.data = port, data
        self.paused, self.stopped = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        packets = [self.data[i : i + 1316] for i in range(0, len(self.data), 1316)]
        pause = 3.0 / len(packets)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            while not self.stopped.is_set():
                for packet in packets:
                    if self.stopped.is_set():
                        return
                    while self.paused.is_set() and not self.stopped.is_set():
                        time.sleep(0.02)
                    sock.sendto(packet, ("127.0.0.1", self.port))
                    time.sleep(pause)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def wait_for(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def test_stalled_stream_is_reported_within_two_seconds_and_recovers(stream):
    port = free_port()
    sender = Sender(port, stream)
    try:
        source = open_source(f"udp://127.0.0.1:{port}", ImageIngestConfig(stall_timeout_s=0.8, reconnect_max_s=0.5))
        with source:
            assert source.live
            assert source.size == (160, 120)
            stamps = [source.read().stamp_ns for _ in range(5)]
            assert (np.diff(stamps) > 0).all()
            assert abs(stamps[-1] - time.time_ns()) < 3e9  # system clock, not stream time
            kinds: list[SourceEventKind] = []

            def received(kind: SourceEventKind) -> bool:
                kinds.extend(e.kind for e in source.events())
                return kind in kinds

            sender.paused.set()
            begin = time.monotonic()
            assert wait_for(lambda: received(SourceEventKind.STALLED), 5.0)
            assert time.monotonic() - begin < 2.0
            sender.paused.clear()
            assert wait_for(lambda: received(SourceEventKind.RECOVERED), 20.0), kinds
            assert source.read() is not None
    finally:
        sender.stopped.set()
        sender.thread.join()


def test_ended_pipe_is_reported_and_reopened(stream, tmp_path):
    pipe = tmp_path / "camera.ts"
    os.mkfifo(pipe)
    stopped = threading.Event()

    def feed() -> None:
        while not stopped.is_set():
            try:
                with pipe.open("wb") as sink:
                    sink.write(stream)
            except BrokenPipeError:
                pass
            time.sleep(0.3)  # the camera is unplugged: the reader meets the end

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    source = open_source(pipe, ImageIngestConfig(stall_timeout_s=1.0, reconnect_max_s=0.5))
    try:
        kinds: list[SourceEventKind] = []

        def received() -> bool:
            kinds.extend(e.kind for e in source.events())
            return kinds.count(SourceEventKind.RECONNECTING) >= 2  # so it was opened again in between

        assert wait_for(received, 20.0), kinds
    finally:
        stopped.set()
        source.close()
        rest = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # lets a blocked writer go
        os.close(rest)
        thread.join(timeout=2.0)


def test_address_without_a_stream_is_refused_in_one_line():
    with pytest.raises(InputError, match="expected a camera or stream") as caught:
        open_source("tcp://127.0.0.1:9", ImageIngestConfig(stall_timeout_s=0.5))
    assert "\n" not in str(caught.value)


def test_stream_clock_removes_the_network_jitter():
    rng = np.random.default_rng(0)
    clock = StreamClock()
    exposure = 40_000_000 * np.arange(400)
    arrival = 1_000_000_000_000 + exposure + 5_000_000 + rng.exponential(30e6, 400).astype(np.int64)
    stamps = np.array([clock.stamp(int(p), int(a)) for p, a in zip(exposure, arrival, strict=True)])
    assert (np.diff(stamps) > 0).all()
    error = stamps - (1_000_000_000_000 + exposure)
    assert np.abs(error[100:] - 5_000_000).max() < 5_000_000  # steady to 5 ms though arrivals scatter by 30


@pytest.mark.parametrize("set_s", [2.0, -2.0, 86400.0])
def test_stamps_follow_a_system_clock_that_is_set(set_s):
    """Else the pictures would be 2 s old for hours, and a day old where NTP comes after the start."""
    clock, set_ns = StreamClock(), round(set_s * 1e9)
    for i in range(100):
        exposure = 40_000_000 * i
        steady = exposure + 5_000_000
        now = 1_000_000_000_000 + steady + (set_ns if i >= 50 else 0)
        assert abs(clock.stamp(exposure, now, steady) - now) < 1_000_000
