"""Kills a recording process and compares what is left with other libraries."""

import itertools
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from recorded import NAMES, Messages

from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.recover import recover_session
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.mcap.writer import SessionWriter

CHILD = """
import sys
sys.path[:0] = [{helpers!r}]
from killed_recording import write_until_killed
write_until_killed({folder!r}, {chunk_s})
"""


def write_until_killed(folder, chunk_s):
    """Record images and poses for ever."""
    messages, rng = Messages(), np.random.default_rng(0)
    pose = messages.cdr(
        messages(
            NAMES["pose2d"], header=messages.header(10**9), track_id=1, skeleton="body15", image_width=1280,
            image_height=720, keypoints=rng.uniform(0, 700, 30).astype(np.float32),
        )
    )  # fmt: skip
    noise = rng.integers(0, 255, 100_000, dtype=np.uint8)
    image_cdr = messages.cdr(messages(NAMES["compressed"], data=noise))
    writer = SessionWriter(folder, SessionRecorderConfig(split_s=1.0, chunk_s=chunk_s), {"configuration": "a: 1\n"})
    writer.register("/drocap/pose2d", NAMES["pose2d"], schema_text(NAMES["pose2d"]))
    image = "/drocap/image/compressed"
    writer.register(image, NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
    for i in itertools.count():
        now = time.time_ns()
        writer.write("/drocap/pose2d", pose, now)
        writer.write(image, image_cdr, now)
        if i == 0:
            print("going", flush=True)
        time.sleep(0.02)


def killed_session(folder, delay_s, chunk_s=0.5):
    """Kill a recording process after ``delay_s``; returns the times of its first message and of the kill, ns."""
    code = CHILD.format(helpers=str(Path(__file__).parent), folder=str(folder), chunk_s=chunk_s)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    process.stdout.readline()
    begun_ns = time.time_ns()
    time.sleep(delay_s)
    killed_ns = time.time_ns()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    return begun_ns, killed_ns


def read_by_all(folder):
    """Log times of all messages by topic, equal in three libraries."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.highlevel import AnyReader

    by_mcap, by_ros2 = {}, {}
    for path in sorted(folder.glob("*.mcap"), key=lambda p: int(p.stem.rsplit("_", 1)[1])):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                by_mcap.setdefault(channel.topic, []).append(message.log_time)
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                assert decoded.header.stamp.sec >= 0
                by_ros2.setdefault(channel.topic, []).append(message.log_time)
    by_rosbags = {}
    with AnyReader([folder]) as bag:
        for connection, log_ns, data in bag.messages():
            assert bag.deserialize(data, connection.msgtype).header.stamp.sec >= 0
            by_rosbags.setdefault(connection.topic, []).append(log_ns)
    assert by_mcap == by_ros2
    assert {t: sorted(v) for t, v in by_mcap.items()} == by_rosbags
    return by_mcap


def check_recovered(folder, begun_ns, killed_ns):
    """All messages up to 1.5 s before the kill are there, numbered without a gap; returns count and last gap, s."""
    from mcap.reader import make_reader

    recover_session(folder)
    times = read_by_all(folder)
    numbers = {}
    for path in sorted(folder.glob("*.mcap"), key=lambda p: int(p.stem.rsplit("_", 1)[1])):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                numbers.setdefault(channel.topic, []).append(message.sequence)
    for topic in ("/drocap/pose2d", "/drocap/image/compressed"):
        sequence = numbers.get(topic, [])
        assert sequence == list(range(len(sequence)))
        assert killed_ns - max([begun_ns, *times.get(topic, [])]) < 1.5e9
    return sum(map(len, times.values())), (
        killed_ns - max(begun_ns, *map(max, times.values()))
    ) * 1e-9 if times else 0.0
