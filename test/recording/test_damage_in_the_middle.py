"""Damage in the middle of a recording is a gap: what stands behind it is read, and a line says so."""

from __future__ import annotations

import contextlib
import random
import sqlite3

import numpy as np
import pytest
from recorded import NAMES, START_NS, random_image

from drocap_ros.recording.damaged_bags import SqliteScan
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import open_session

cv2 = pytest.importorskip("cv2")
COUNT, STEP_NS = 120, 50_000_000


def jpeg(i):
    return cv2.imencode(".jpg", random_image(i), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel()


def ros2_folder(folder, plugin):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kind, time, header = (store.types[name] for name in (
        "sensor_msgs/msg/CompressedImage", "builtin_interfaces/msg/Time", "std_msgs/msg/Header"))  # fmt: skip
    with Writer(folder, version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        topic = writer.add_connection("/camera", kind.__msgtype__, typestore=store)
        for i in range(COUNT):
            stamp_ns = START_NS + i * STEP_NS
            message = kind(header(time(stamp_ns // 10**9, stamp_ns % 10**9), "c"), "jpeg", jpeg(i))
            writer.write(topic, stamp_ns, store.serialize_cdr(message, kind.__msgtype__))
    return next(path for path in folder.iterdir() if path.suffix in (".db3", ".mcap"))


def ros1_bag(path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind, time, header = (store.types[name] for name in (
        "sensor_msgs/msg/CompressedImage", "builtin_interfaces/msg/Time", "std_msgs/msg/Header"))  # fmt: skip
    with Writer(path) as writer:
        writer.chunk_threshold = 40_000
        topic = writer.add_connection("/camera", kind.__msgtype__, typestore=store)
        for i in range(COUNT):
            stamp_ns = START_NS + i * STEP_NS
            message = kind(header(i, time(stamp_ns // 10**9, stamp_ns % 10**9), "c"), "jpeg", jpeg(i))
            writer.write(topic, stamp_ns, bytes(store.serialize_ros1(message, kind.__msgtype__)))
    return path


@pytest.mark.parametrize("kind", ["SQLITE3", "MCAP", "bag"])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("length", [60, 3000, 20_000])
def test_what_stands_behind_damage_is_read(tmp_path, messages, kind, share, length):
    if kind == "MCAP":
        entries = []
        for i in range(COUNT):
            values = {"header": messages.header(START_NS + i * STEP_NS), "format": "jpeg", "data": jpeg(i)}
            message = messages(NAMES["compressed"], **values)
            entries.append(("/camera", message, START_NS + i * STEP_NS, messages.cdr(message)))
        with SessionWriter(tmp_path / "s", SessionRecorderConfig(chunk_kib=16)) as writer:
            writer.register("/camera", NAMES["compressed"], schema_text(NAMES["compressed"]))
            for topic, _, log_ns, data in entries:
                writer.write(topic, data, log_ns)
        path = next((tmp_path / "s").glob("*.mcap"))
    else:
        path = ros1_bag(tmp_path / "a.bag") if kind == "bag" else ros2_folder(tmp_path / "s", kind)
    data = bytearray(path.read_bytes())
    place = int(share * len(data))
    data[place : place + length] = random.Random(length).randbytes(length)
    path.write_bytes(data)
    with open_session(path if kind == "bag" else tmp_path / "s") as session:
        found = np.array([frame.stamp_ns for frame in read_images(session)])
        assert session.warnings or length == 60  # a few bytes may be those of a picture alone
    lost = COUNT - len(found)
    assert lost < 0.1 * COUNT + 3 * length / (len(data) / COUNT)
    assert found[-1] > START_NS + 0.9 * COUNT * STEP_NS
    assert (np.diff(found) > 0).all()


def test_a_damaged_number_of_a_row_is_not_waited_for(tmp_path):
    """It may be any of 64 bits: rows are sought among as many as fit into the file."""
    path = ros2_folder(tmp_path / "s", "SQLITE3")
    with contextlib.closing(sqlite3.connect(path)) as base, base:
        base.execute("UPDATE messages SET id = ? WHERE id = ?", (2**62, COUNT))
    with contextlib.closing(SqliteScan(path, [path])) as session:
        found = [raw.log_time_ns for raw in session.raw_messages()]
    assert found == [START_NS + i * STEP_NS for i in range(COUNT - 1)]
