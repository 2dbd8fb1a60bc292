"""A process that records pictures and poses until somebody kills it."""

import itertools
import time

import numpy as np
from recorded import NAMES, Messages

from drocap_ros.recording.mcap.recorder_config import SessionRecorderConfig
from drocap_ros.recording.mcap.schemas import schema_text
from drocap_ros.recording.mcap.writer import SessionWriter


def write_until_killed(folder):
    messages, rng = Messages(), np.random.default_rng(0)
    pose = messages.cdr(
        messages(
            NAMES["pose2d"], header=messages.header(10**9), track_id=1, skeleton="body15", image_width=1280,
            image_height=720, keypoints=rng.uniform(0, 700, 30).astype(np.float32),
        )
    )  # fmt: skip
    noise = rng.integers(0, 255, 100_000, dtype=np.uint8)
    picture = messages.cdr(messages(NAMES["compressed"], data=noise))
    writer = SessionWriter(folder, SessionRecorderConfig(split_s=1.0), {"configuration": "a: 1\n"})
    writer.register("/drocap/pose2d", NAMES["pose2d"], schema_text(NAMES["pose2d"]))
    image = "/drocap/image/compressed"
    writer.register(image, NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
    for i in itertools.count():
        now = time.time_ns()
        writer.write("/drocap/pose2d", pose, now)
        writer.write(image, picture, now)
        if i == 0:
            print("going", flush=True)
        time.sleep(0.02)
