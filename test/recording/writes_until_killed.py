"""A process that records pictures and poses until somebody kills it."""

import itertools
import time

import numpy as np
from recorded import NAMES, Messages

from drocap_ros.recording.config import SessionRecorderConfig
from drocap_ros.recording.schemas import schema_text
from drocap_ros.recording.session_writer import SessionWriter
from drocap_ros.simulation.capture import simulate_capture


def write_until_killed(folder):
    messages, tracks = Messages(), simulate_capture(1, 30, seed=1).tracks
    writer = SessionWriter(folder, SessionRecorderConfig(split_s=1.0), {"configuration": "a: 1\n"})
    writer.register("/drocap/pose2d", NAMES["pose2d"], schema_text(NAMES["pose2d"]))
    image = "/drocap/image/compressed"
    writer.register(image, NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
    noise = np.random.default_rng(0).integers(0, 255, 100_000, dtype=np.uint8)
    poses = [messages.cdr(messages.pose2d(tracks, i, 10**9)) for i in range(30)]
    blob = messages.cdr(messages(NAMES["compressed"], data=noise))
    for i in itertools.count():
        now = time.time_ns()
        writer.write("/drocap/pose2d", poses[i % 30], now)
        writer.write(image, blob, now)
        if i == 0:
            print("going", flush=True)
        time.sleep(0.02)
