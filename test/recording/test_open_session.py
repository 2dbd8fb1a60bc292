import numpy as np
import pytest
from recorded import NAMES, START_NS, image_message, random_image, record

from drocap_ros.errors import InputError
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import is_recording, open_session, session_info
from drocap_ros.recording.session_tracks import read_pose2d

POSE2D = NAMES["pose2d"]


def test_single_mcap_gives_the_tracks_of_its_folder(pose_session):
    with open_session(pose_session) as a, open_session(pose_session / "session_0.mcap") as b:
        assert np.array_equal(read_pose2d(a).keypoints, read_pose2d(b).keypoints, equal_nan=True)


def write_with_rosbags(path, kind, messages, capture):
    """Images and poses, recorded by rosbags."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    poses = [messages.pose2d(capture.tracks, i, START_NS + i * 10**7) for i in range(10)]
    images = [image_message(messages, random_image(i), START_NS + i * 10**7) for i in range(5)]
    if kind == "bag":
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        text = schema_text(POSE2D).split("=" * 80)[0]
        from rosbags.typesys import get_types_from_msg

        store.register(get_types_from_msg(text, POSE2D))
        with Writer1(path) as writer:
            for topic, group in (("/drocap/pose2d", poses), ("/camera", images)):
                connection = writer.add_connection(topic, group[0].__msgtype__, typestore=store)
                for i, message in enumerate(group):
                    old = ros1_copy(store, message, i)
                    writer.write(
                        connection, START_NS + i * 10**7, bytes(store.serialize_ros1(old, message.__msgtype__))
                    )
        return path
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        for topic, group in (("/drocap/pose2d", poses), ("/camera", images)):
            connection = writer.add_connection(topic, group[0].__msgtype__, typestore=messages.store)
            for i, message in enumerate(group):
                writer.write(connection, START_NS + i * 10**7, messages.cdr(message))
    return path


def ros1_copy(store, message, i):
    values = {name: getattr(message, name) for name, _ in store.fielddefs[message.__msgtype__][1] if name != "header"}
    time = store.types["builtin_interfaces/msg/Time"]
    stamp = START_NS + i * 10**7
    header = store.types["std_msgs/msg/Header"](seq=i, stamp=time(stamp // 10**9, stamp % 10**9), frame_id="camera")
    return store.types[message.__msgtype__](header=header, **values)


@pytest.mark.parametrize("kind", ["bag", "sqlite3", "mcap"])
def test_recordings_of_other_writers_are_read(tmp_path, messages, capture, kind):
    path = write_with_rosbags(tmp_path / ("other.bag" if kind == "bag" else "other"), kind, messages, capture)
    assert is_recording(path)
    with open_session(path) as session:
        tracks = read_pose2d(session)
        frames = list(read_images(session))
        info = session.info
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[:10].astype(np.float32), equal_nan=True)
    assert np.array_equal(tracks.stamp_ns, START_NS + np.arange(10) * 10**7)
    assert len(frames) == 5
    assert all(np.array_equal(frame.image, random_image(i)) for i, frame in enumerate(frames))
    assert {t.name: t.count for t in info.topics} == {"/drocap/pose2d": 10, "/camera": 5}
    assert info.duration_s == pytest.approx(0.09)


def test_sqlite3_without_embedded_definitions_is_read(tmp_path, messages, capture):
    import sqlite3

    path = write_with_rosbags(tmp_path / "old", "sqlite3", messages, capture)
    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("DELETE FROM message_definitions")
    connection.close()
    with open_session(path) as session:
        assert len(read_pose2d(session)) == 10


def test_an_mcap_is_known_by_its_first_bytes_or_its_name(pose_session, tmp_path):
    data = (pose_session / "session_0.mcap").read_bytes()
    (tmp_path / "walk.bag").write_bytes(data)
    with open_session(pose_session) as a, open_session(tmp_path / "walk.bag") as b:
        assert np.array_equal(read_pose2d(a).keypoints, read_pose2d(b).keypoints, equal_nan=True)
    (tmp_path / "walk.mcap").write_bytes(bytes(3) + data[3:])
    with pytest.raises(InputError, match="expected an MCAP file, found other content at its start"):
        open_session(tmp_path / "walk.mcap")


def test_session_without_its_metadata_file_is_read(pose_session, capture):
    (pose_session / "metadata.yaml").unlink()
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)
        assert any("metadata.yaml is missing" in warning for warning in session.warnings)
    (pose_session / "metadata.yaml").write_text("{[broken")
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)


def test_info_gives_topics_types_counts_and_duration(pose_session, capture):
    info = session_info(pose_session)
    assert info.message_count == len(capture.tracks)
    assert info.topics[0].type_name == POSE2D
    assert info.duration_s == pytest.approx(len(capture.tracks) / 30, abs=0.05)
    assert info.warnings == ()


def test_missing_and_other_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("not a recording, but long enough")
    (tmp_path / "zero.mcap").write_bytes(b"")
    (tmp_path / "text.bag").write_text("neither is this")
    (tmp_path / "text.db3").write_text("nor this")
    (tmp_path / "notes.txt").write_text("x")
    for name in ("missing", "missing.mcap", "empty", "text.mcap", "zero.mcap", "text.bag", "text.db3", "notes.txt"):
        with pytest.raises(InputError, match="expected") as error, open_session(tmp_path / name) as session:
            read_pose2d(session)
        assert "\n" not in str(error.value)
        assert name in str(error.value)


def test_folder_of_a_newer_version_is_read(pose_session, capture):
    text = (pose_session / "metadata.yaml").read_text()
    (pose_session / "metadata.yaml").write_text(text.replace("version: 9", "version: 42"))
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)


def test_topic_of_an_unknown_type_is_listed_and_readable(tmp_path, messages, capture):
    old_type, old_schema = "drocap_ros/msg/RemovedCommand", "std_msgs/Header header\nuint8 action\n"
    old_schema += "".join(f"{'=' * 80}\nMSG: {part}" for part in schema_text("std_msgs/msg/Header").split("MSG: ")[1:])
    old_schema += f"{'=' * 80}\nMSG: std_msgs/Header\n" + schema_text("std_msgs/msg/Header").split("=" * 80)[0]
    header = messages.cdr(messages.header(START_NS, "map"))
    with SessionWriter(tmp_path / "s") as writer:
        writer.register("/drocap/orbit/command", old_type, old_schema)
        writer.register("/drocap/pose2d", POSE2D, schema_text(POSE2D))
        writer.write("/drocap/orbit/command", header + b"\x03", START_NS)
        writer.write("/drocap/pose2d", messages.cdr(messages.pose2d(capture.tracks, 0, START_NS)), START_NS)
    with open_session(tmp_path / "s") as session:
        assert {t.name: t.type_name for t in session.info.topics}["/drocap/orbit/command"] == old_type
        ((_, command),) = session.messages(("/drocap/orbit/command",))
        assert (command.header.frame_id, command.action) == ("map", 3)
        assert len(read_pose2d(session)) == 1
        assert session.warnings == []


def test_topic_with_most_messages_is_read(tmp_path, messages, capture):
    tracks = capture.tracks
    entries = [("/a/pose2d", messages.pose2d(tracks, i, START_NS + i * 10**7), START_NS + i) for i in range(3)]
    entries += [("/b/pose2d", messages.pose2d(tracks, i, START_NS + i * 10**7), START_NS + i) for i in range(5)]
    record(tmp_path / "s", [(t, m, s, messages.cdr(m)) for t, m, s in entries])
    with open_session(tmp_path / "s") as session:
        assert len(read_pose2d(session)) == 5
        assert any("several topics" in warning for warning in session.warnings)
