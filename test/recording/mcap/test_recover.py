import random
import shutil

import pytest
import yaml
from killed_recording import read_by_all
from recorded import NAMES, START_NS, write_poses

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.recover import recover_session
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.mcap.stream import DamageKind, McapStream
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import open_session, session_info
from drocap_ros.recording.session_tracks import read_pose2d

POSE2D = NAMES["pose2d"]


@pytest.mark.parametrize("share", [0.0005, 0.3, 0.7, 0.999])
def test_cut_off_file_keeps_every_readable_message(tmp_path, messages, capture, share):
    folder = tmp_path / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(chunk_kib=16))
    path = folder / "s_0.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: max(20, int(len(data) * share))])
    with open_session(folder) as session:
        before = [raw.log_time_ns for raw in session.raw_messages()]
    (file,) = recover_session(folder)
    assert file.repaired
    assert file.messages == len(before)
    assert file.kept is None
    assert read_by_all(folder).get("/drocap/pose2d", []) == before
    assert session_info(folder).warnings == ()
    assert sorted(p.name for p in folder.iterdir()) == ["metadata.yaml", "s_0.mcap"]
    (again,) = recover_session(folder)
    assert not again.repaired


def test_whole_session_is_unchanged(pose_session):
    before = (pose_session / "session_0.mcap").read_bytes()
    (file,) = recover_session(pose_session)
    assert not file.repaired
    assert (pose_session / "session_0.mcap").read_bytes() == before


def test_damage_in_the_middle_loses_one_chunk_and_keeps_the_damaged_file(tmp_path, messages, capture):
    folder = tmp_path / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(chunk_kib=16))
    path = folder / "s_0.mcap"
    data = bytearray(path.read_bytes())
    rng = random.Random(1)
    start = data.index(b"zstd", len(data) // 2)
    data[start - 40 : start - 32] = rng.randbytes(8)  # the length of a chunk: its end is unknown then
    path.write_bytes(data)
    with open_session(folder) as session:
        readable = len(list(session.raw_messages()))
    (file,) = recover_session(folder)
    # Reading goes on behind the damage, too.
    assert 0.7 * len(capture.tracks) < readable <= file.messages < len(capture.tracks)
    assert DamageKind.SKIPPED_BYTES in [d.kind for d in file.damage]
    assert file.kept.read_bytes() == bytes(data)
    assert len(read_by_all(folder)["/drocap/pose2d"]) == file.messages
    assert len(read_pose2d(open_session(folder))) == file.messages


@pytest.mark.parametrize("seed", range(12))
def test_flipped_bits_lose_no_message_outside_the_chunks_that_they_hit(tmp_path, messages, capture, seed):
    """One to three bits anywhere in the file: heads, lengths, declarations, chunks, indexes, summary."""
    folder = tmp_path / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(chunk_kib=16))
    path, rng = folder / "s_0.mcap", random.Random(seed)
    data = bytearray(path.read_bytes())
    chunks = McapStream(path).summary().chunk_indexes
    with open_session(folder) as session:
        stamps = [raw.log_time_ns for raw in session.raw_messages()]
    places = [rng.randrange(len(data)) if seed else chunks[0].chunk_start_offset + 200 for _ in range(1 + seed % 3)]
    for place in places:
        data[place] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
    recover_session(folder)
    hit = [c for c in chunks if any(0 <= p - c.chunk_start_offset < c.chunk_length for p in places)]
    lost = set(stamps) - set(read_by_all(folder).get("/drocap/pose2d", []))
    assert all(any(c.message_start_time <= stamp <= c.message_end_time for c in hit) for stamp in lost)


def test_metadata_is_kept_and_the_description_is_rebuilt(tmp_path, messages, capture):
    folder = tmp_path / "s"
    writer = SessionWriter(folder, metadata={"git_revision": "abc"})
    writer.register("/pose2d", POSE2D, schema_text(POSE2D))
    writer.write("/pose2d", messages.cdr(messages.pose2d(capture.tracks, 0, START_NS)), START_NS)
    writer.add_metadata({"configuration": "a: 1\n"})
    writer.close()
    path = folder / "s_0.mcap"
    path.write_bytes(path.read_bytes()[:-200])
    (folder / "metadata.yaml").unlink()
    (folder / "metadata.yaml.tmp").write_text("half")
    recover_session(folder)
    info = session_info(folder)
    assert info.metadata == {"git_revision": "abc", "configuration": "a: 1\n"}
    description = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert description["message_count"] == 1
    (topic,) = description["topics_with_message_count"]
    assert topic["topic_metadata"]["offered_qos_profiles"][0]["depth"] == 1000
    assert topic["topic_metadata"]["type_description_hash"].startswith("RIHS01_")
    assert not list(folder.glob("*.tmp"))


def test_metadata_of_a_session_without_messages_is_kept(tmp_path):
    SessionWriter(tmp_path / "s", metadata={"git_revision": "abc"}).close()
    path = tmp_path / "s" / "s_0.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    (file,) = recover_session(path)
    assert file.repaired
    assert session_info(path).metadata == {"git_revision": "abc"}


def test_split_session_cut_in_its_last_file_is_repaired(tmp_path, messages, capture):
    folder = tmp_path / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(split_s=1.0))
    assert len(list(folder.glob("*.mcap"))) == 4
    last = folder / "s_3.mcap"
    last.write_bytes(last.read_bytes()[:-400])
    (folder / "s_4.mcap").touch()  # created right before a power cut
    with open_session(folder) as session:
        before = len(read_pose2d(session))
        assert any("s_4.mcap is empty" in w for w in session.warnings)
    recover_session(folder)
    assert len(read_by_all(folder)["/drocap/pose2d"]) == before
    assert session_info(folder).warnings == ()


def test_full_disk_leaves_the_session_unchanged(small_disk, messages, capture):
    folder = small_disk / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(free_mib=0))
    path = folder / "s_0.mcap"
    path.write_bytes(path.read_bytes()[:-300])
    before = path.read_bytes()
    free = shutil.disk_usage(small_disk).free
    (small_disk / "filler").write_bytes(bytes(free - 8192))
    with pytest.raises(InputError, match="make room") as error:
        recover_session(folder)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == before
    assert len(list(folder.iterdir())) == 2
    (small_disk / "filler").unlink()
    assert recover_session(folder)[0].repaired


def test_files_that_are_no_session_are_refused_and_unchanged(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("not a recording, but long enough")
    (tmp_path / "zero.mcap").touch()
    (tmp_path / "old.bag").touch()
    for name in ("empty", "text.mcap", "zero.mcap", "old.bag", "missing"):
        assert main(["recover", str(tmp_path / name)]) == 2
        assert "expected" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "old.bag", "text.mcap", "zero.mcap"]


def test_command_prints_each_file_and_its_damage(pose_session, capsys):
    path = pose_session / "session_0.mcap"
    path.write_bytes(path.read_bytes()[:-500])
    assert main(["recover", str(pose_session)]) == 0
    out, err = capsys.readouterr()
    assert "session_0.mcap: repaired; 120 messages, each read back" in out
    assert "cut off" in err
