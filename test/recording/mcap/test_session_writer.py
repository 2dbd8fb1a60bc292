import os
import threading
import time

import numpy as np
import pytest
import yaml
from killed_recording import killed_session
from recorded import NAMES, START_NS, write_poses

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.file import CommittedFile, McapFile
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import open_session, session_info
from drocap_ros.recording.session_tracks import read_pose2d

POSE2D = NAMES["pose2d"]


def test_read_by_mcap_rosbags_and_mcap_ros2(pose_session, capture, messages):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import Reader

    expected = capture.tracks.keypoints.astype(np.float32)
    path = pose_session / "session_0.mcap"
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        raw = [m for _, _, m in reader.iter_messages()]
        assert reader.get_header().profile == "ros2"
    assert summary.statistics.message_count == len(raw) == len(expected)
    assert summary.statistics.chunk_count >= 1
    schema = next(iter(summary.schemas.values()))
    assert (schema.name, schema.encoding) == (POSE2D, "ros2msg")
    assert [m.sequence for m in raw] == list(range(len(expected)))
    assert [m.log_time for m in raw] == (capture.tracks.stamp_ns + 5_000_000).tolist()

    with Reader(pose_session) as bag:
        assert bag.message_count == len(expected)
        assert (bag.start_time, bag.end_time) == (raw[0].log_time, raw[-1].log_time + 1)
        (connection,) = bag.connections
        assert connection.digest.startswith("RIHS01_")
        assert connection.ext.offered_qos_profiles[0].depth == 1000
    with AnyReader([pose_session]) as bag:
        theirs = [bag.deserialize(data, c.msgtype) for c, _, data in bag.messages()]
    assert np.array_equal(np.array([m.keypoints for m in theirs]).reshape(expected.shape), expected, equal_nan=True)
    with path.open("rb") as file:
        decoded = [m for *_, m in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()]
    assert np.array_equal(
        np.array([m.keypoints for m in decoded], np.float32).reshape(expected.shape), expected, equal_nan=True
    )


def test_metadata_file_exists_from_the_start_and_is_complete_at_the_end(tmp_path, messages, capture):
    folder = tmp_path / "deep" / "session"
    writer = SessionWriter(folder, metadata={"vehicle": "test"})
    early = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert early["message_count"] == 0
    writer.register("/pose2d", POSE2D, schema_text(POSE2D))
    writer.write("/pose2d", messages.cdr(messages.pose2d(capture.tracks, 0, START_NS)), START_NS)
    writer.write("/pose2d", messages.cdr(messages.pose2d(capture.tracks, 1, START_NS)), START_NS + 10**9)
    writer.close()
    writer.close()
    late = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert late["message_count"] == 2
    assert late["duration"]["nanoseconds"] == 10**9
    assert late["starting_time"]["nanoseconds_since_epoch"] == START_NS
    assert late["custom_data"] == {"vehicle": "test"}
    assert (late["version"], late["storage_identifier"]) == (9, "mcap")
    assert sorted(p.name for p in folder.iterdir()) == ["metadata.yaml", "session_0.mcap"]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_every_compression_reads_back(tmp_path, messages, capture, compression):
    write_poses(tmp_path / "s", messages, capture.tracks, SessionRecorderConfig(compression=compression, chunk_kib=16))
    with open_session(tmp_path / "s") as session:
        assert len(read_pose2d(session)) == len(capture.tracks)
        assert session.warnings == []


def test_empty_session_is_whole(tmp_path):
    with SessionWriter(tmp_path / "s") as writer:
        writer.register("/drocap/pose2d", "drocap_ros/msg/Pose2D", schema_text("drocap_ros/msg/Pose2D"))
    with open_session(tmp_path / "s") as session:
        assert session.info.message_count == 0
        with pytest.raises(InputError, match=r"expected a topic of type .*, found no messages"):
            read_pose2d(session)


@pytest.mark.parametrize("stamps", [(-1, 5), (5, -(2**40)), (1 << 64, 5)])
def test_message_of_a_time_that_no_file_holds_is_counted_and_ends_no_recording(tmp_path, messages, capture, stamps):
    message = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS, 1))
    with SessionWriter(tmp_path / "s") as writer:
        writer.register("/drocap/pose2d", POSE2D, schema_text(POSE2D))
        kept = [writer.write("/drocap/pose2d", message, *times) for times in ((START_NS,), stamps, (START_NS + 1,))]
    assert kept == [True, False, True]
    assert (writer.error, writer.dropped, writer.written) == (None, 1, 2)


def test_non_empty_folder_is_refused(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="new or empty folder"):
        SessionWriter(tmp_path / "s")
    with pytest.raises(InputError, match="new or empty folder"):
        SessionWriter(tmp_path / "s" / "notes.txt")
    with pytest.raises(InputError, match="expected a folder to write to"):
        SessionWriter(tmp_path / "s" / "notes.txt" / "below")
    assert (tmp_path / "s" / "notes.txt").read_text() == "mine"


def test_full_disk_is_refused_before_recording(tmp_path):
    with pytest.raises(InputError, match="MiB free on the disk"):
        SessionWriter(tmp_path / "s", SessionRecorderConfig(free_mib=1_000_000))


def test_unknown_topic_and_changed_type_are_refused(tmp_path):
    with SessionWriter(tmp_path / "s") as writer:
        with pytest.raises(InputError, match="registered topic"):
            writer.write("/pose2d", b"", 0)
        writer.register("/a", POSE2D, schema_text(POSE2D))
        writer.register("/a", POSE2D, schema_text(POSE2D))
        with pytest.raises(InputError, match="expected type"):
            writer.register("/a", NAMES["info"], schema_text(NAMES["info"]))


def test_many_threads_lose_nothing(tmp_path, messages, capture):
    data = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    with SessionWriter(tmp_path / "s") as writer:
        writer.register("/a", POSE2D, schema_text(POSE2D))

        def send(k):
            for i in range(500):
                writer.write("/a", data, START_NS + 1000 * i + k)

        threads = [threading.Thread(target=send, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert (writer.written, writer.dropped) == (2000, 0)
    with open_session(tmp_path / "s") as session:
        assert session.info.message_count == 2000


def test_messages_reach_the_disk_within_the_chunk_time(tmp_path, messages, capture):
    writer = SessionWriter(tmp_path / "s", SessionRecorderConfig(chunk_s=0.1))
    writer.register("/a", POSE2D, schema_text(POSE2D))
    writer.write("/a", messages.cdr(messages.pose2d(capture.tracks, 0, START_NS)), START_NS)
    end = time.monotonic() + 10
    while time.monotonic() < end:  # the writer is still open, as after a crash
        with open_session(writer.path) as session:
            if session.topics_of(POSE2D):
                break
        time.sleep(0.05)
    with open_session(writer.path) as session:
        assert len(read_pose2d(session)) == 1
    writer.close()


def test_messages_that_come_during_a_slow_save_are_kept_by_a_close_at_that_moment(
    tmp_path, messages, capture, monkeypatch
):
    save, saving, go_on = McapFile.save, threading.Event(), threading.Event()

    def slow(file, sync):
        saving.set()
        go_on.wait(10)
        save(file, sync)

    monkeypatch.setattr(McapFile, "save", slow)
    data = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    writer = SessionWriter(tmp_path / "s", SessionRecorderConfig(chunk_s=0.05))
    writer.register("/a", POSE2D, schema_text(POSE2D))
    writer.write("/a", data, START_NS)
    assert saving.wait(10)
    writer.write("/a", data, START_NS + 1)
    closing = threading.Thread(target=writer.close)
    closing.start()
    closing.join(0.2)  # it waits for the save, and has said by now that nothing more comes
    go_on.set()
    closing.join(10)
    with open_session(tmp_path / "s") as session:
        assert session.info.message_count == 2


def test_killed_writer_loses_only_the_last_chunk(tmp_path):
    for attempt, delay_s in enumerate((0.35, 0.52, 0.78)):
        folder = tmp_path / f"killed{attempt}"
        begun_ns, killed_ns = killed_session(folder, delay_s, chunk_s=0.1)
        with open_session(folder) as session:
            log_ns = [raw.log_time_ns for raw in session.raw_messages()]
            assert session.info.warnings
        assert killed_ns - log_ns[-1] < 0.35e9
        assert log_ns[-1] > log_ns[0]
        assert log_ns[0] <= begun_ns
        assert not list(folder.glob("*.tmp"))


def test_disk_full_while_recording_keeps_earlier_messages(tmp_path, messages, capture, monkeypatch):
    data = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    writer = SessionWriter(tmp_path / "s", SessionRecorderConfig(chunk_s=0.05))
    writer.register("/a", POSE2D, schema_text(POSE2D))
    for i in range(20):
        writer.write("/a", data, START_NS + i)
    _until(lambda: writer.written == 20 and writer._unsaved_s is None)
    real = os.write

    def half_then_full(fd, view):
        if fd != writer._file._file._fd:
            return real(fd, view)
        if len(view) > 10:
            return real(fd, view[: len(view) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", half_then_full)
    writer.write("/a", data, START_NS + 50)
    _until(lambda: writer.error is not None)
    monkeypatch.setattr(os, "write", real)
    assert "No space left" in writer.error
    assert "\n" not in writer.error
    assert writer.write("/a", data, START_NS + 60)  # nothing raises; it is dropped and counted
    _until(lambda: writer.dropped >= 1)
    writer.close()
    with open_session(tmp_path / "s") as session:
        assert [raw.log_time_ns for raw in session.raw_messages()] == [START_NS + i for i in range(20)]


def test_real_full_disk_keeps_or_counts_every_message(small_disk, messages, capture):
    folder = small_disk / "s"
    writer = SessionWriter(folder, SessionRecorderConfig(chunk_s=0.05, free_mib=0, compression="none"))
    writer.register("/a", POSE2D, schema_text(POSE2D))
    writer.register("/image", NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
    pose = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    image_cdr = messages.cdr(messages(NAMES["compressed"], data=np.zeros(100_000, np.uint8)))
    sent = 0
    while writer.error is None and sent < 1000:
        writer.write("/a", pose, START_NS + sent)
        writer.write("/image", image_cdr, START_NS + sent)
        sent += 1
        time.sleep(0.005)
    writer.close()
    assert "No space left" in writer.error
    assert writer.written + writer.dropped == 2 * sent  # each message is either there or counted as lost
    with open_session(folder) as session:
        there = list(session.raw_messages())
    assert len(there) == writer.written > 50
    # The messages as they were sent, without a gap; the last chunk may end between a pose and its image.
    expected = [(topic, START_NS + i) for i in range(sent) for topic in ("/a", "/image")]
    assert [(raw.topic, raw.log_time_ns) for raw in there] == expected[: len(there)]


def test_low_disk_space_finishes_the_session_early(small_disk, messages, capture):
    from mcap.reader import make_reader

    folder = small_disk / "s"
    writer = SessionWriter(folder, SessionRecorderConfig(chunk_s=0.05, free_mib=4))
    writer.register("/a", POSE2D, schema_text(POSE2D))
    (small_disk / "filler").write_bytes(bytes(5 << 20))
    pose = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    end = time.monotonic() + 10
    while writer.error is None and time.monotonic() < end:
        writer.write("/a", pose, time.time_ns())
        time.sleep(0.01)
    assert "less than 4 MiB left" in writer.error
    written = writer.written
    writer.write("/a", pose, time.time_ns())
    writer.close()
    assert writer.dropped_by_topic["/a"] >= 1
    with writer.path.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == written > 0
    assert session_info(folder).warnings == ()


@pytest.mark.parametrize("by", [{"split_s": 1.0}, {"split_mib": 1}])
def test_split_files_are_independent(tmp_path, messages, capture, by):
    from mcap.reader import make_reader
    from rosbags.highlevel import AnyReader

    folder = tmp_path / "s"
    config = SessionRecorderConfig(compression="none", chunk_kib=64, **by)
    image_cdr = messages.cdr(messages(NAMES["compressed"], data=np.zeros(30_000, np.uint8)))
    with SessionWriter(folder, config, {"git_revision": "abc"}) as writer:
        writer.register("/pose2d", POSE2D, schema_text(POSE2D))
        writer.register("/image", NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
        for i, stamp_ns in enumerate(capture.tracks.stamp_ns.tolist()):
            writer.write("/pose2d", messages.cdr(messages.pose2d(capture.tracks, i, stamp_ns)), stamp_ns)
            writer.write("/image", image_cdr, stamp_ns)
    files = sorted(folder.glob("*.mcap"))
    assert [p.name for p in files] == [f"s_{i}.mcap" for i in range(4)]
    for path in files:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert len(list(reader.iter_messages())) == reader.get_summary().statistics.message_count > 0
            assert {m.name: m.metadata for m in reader.iter_metadata()}["drocap_ros"] == {"git_revision": "abc"}
    with AnyReader([folder]) as bag:
        assert bag.message_count == 240
    with open_session(folder) as session:
        assert session.info.message_count == 240
        assert np.array_equal(read_pose2d(session).stamp_ns, capture.tracks.stamp_ns)
        assert session.warnings == []
        sequences = [raw.log_time_ns for raw in session.raw_messages(("/image",))]
    assert sequences == capture.tracks.stamp_ns.tolist()


def test_committed_file_ends_at_a_commit_after_an_error(tmp_path, monkeypatch):
    file = CommittedFile(tmp_path / "f")
    file.write(b"whole")
    file.commit()
    file.write(b"piece" * 100)
    monkeypatch.setattr(os, "write", lambda fd, view: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(OSError, match="full"):
        file.commit()
    monkeypatch.undo()
    file.write(b"+next")
    assert file.tell() == 10
    file.commit(sync=True)
    file.close()
    assert (tmp_path / "f").read_bytes() == b"whole+next"
    with pytest.raises(FileExistsError):
        CommittedFile(tmp_path / "f")


def test_slow_disk_drops_images_not_poses(tmp_path, messages, capture, monkeypatch):
    real = os.write

    def slow(fd, view):
        time.sleep(0.02)
        return real(fd, view)

    monkeypatch.setattr(os, "write", slow)
    image_cdr = messages.cdr(messages(NAMES["compressed"], data=np.zeros(200_000, np.uint8)))
    pose = messages.cdr(messages.pose2d(capture.tracks, 0, START_NS))
    config = SessionRecorderConfig(queue_mib=1, chunk_kib=16, compression="none", sync=False)
    with SessionWriter(tmp_path / "s", config) as writer:
        writer.register("/image", NAMES["compressed"], schema_text(NAMES["compressed"]), image=True)
        writer.register("/pose2d", POSE2D, schema_text(POSE2D))
        for i in range(60):
            writer.write("/image", image_cdr, START_NS + i)
            writer.write("/pose2d", pose, START_NS + i)
    assert writer.dropped_by_topic.keys() == {"/image"}
    with open_session(tmp_path / "s") as session:
        counts = {topic.name: topic.count for topic in session.info.topics}
    assert counts["/pose2d"] == 60
    assert counts["/image"] == 60 - writer.dropped


def _until(predicate, seconds=10.0):
    end = time.monotonic() + seconds
    while not predicate():
        assert time.monotonic() < end
        time.sleep(0.01)
