"""The same images in three formats of recordings, written by rosbags, give identical keypoints."""

from pathlib import Path

import numpy as np
import pytest
from recorded import NAMES, START_NS, Messages

from drocap_ros.config import DrocapConfig
from drocap_ros.perception.sources.video import VideoSource
from drocap_ros.pipeline import read_input

SHARED = Path(__file__).parents[2].parent / "shared"
COUNT = 4


def video_images():
    import cv2

    source = VideoSource(SHARED / "media" / "pose_squats.mp4")
    frames = [source.read() for _ in range(COUNT)]
    source.close()
    return [(START_NS + f.stamp_ns, cv2.imencode(".jpg", f.image)[1].ravel()) for f in frames]


def write(path, kind, frames, messages):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    name = NAMES["compressed"]
    if kind == "bag":
        store = get_typestore(Stores.ROS1_NOETIC)
        with Writer1(path) as writer:
            connection = writer.add_connection("/camera/image/compressed", name, typestore=store)
            for i, (stamp_ns, data) in enumerate(frames):
                stamp = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
                header = store.types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="camera")
                message = store.types[name](header=header, format="jpeg", data=data)
                writer.write(connection, stamp_ns, bytes(store.serialize_ros1(message, name)))
        return path
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/camera/image/compressed", name, typestore=messages.store)
        for stamp_ns, data in frames:
            message = messages(name, header=messages.header(stamp_ns), format="jpeg", data=data)
            writer.write(connection, stamp_ns, messages.cdr(message))
    return path


def test_keypoints_do_not_depend_on_the_format_of_the_recording(tmp_path):
    if not (SHARED / "models").is_dir() or not (SHARED / "media").is_dir():
        pytest.skip("no models and media (../shared)")
    frames, messages = video_images(), Messages()
    tracks = [
        read_input(write(tmp_path / name, kind, frames, messages), DrocapConfig(), SHARED / "models")[0]
        for kind, name in (("bag", "x.bag"), ("sqlite3", "x"), ("mcap", "y"))
    ]
    assert len(tracks[0]) == COUNT
    assert np.isfinite(tracks[0].keypoints).any()
    for other in tracks[1:]:
        assert np.array_equal(tracks[0].keypoints, other.keypoints, equal_nan=True)
        assert np.array_equal(tracks[0].stamp_ns, other.stamp_ns)
        assert np.array_equal(tracks[0].confidence, other.confidence)
