import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from recorded import NAMES, START_NS, write_poses

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.recorder_config import SessionRecorderConfig
from drocap_ros.recording.mcap.recover import recover_session
from drocap_ros.recording.mcap.schemas import schema_text
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import open_session, session_info
from drocap_ros.recording.session_tracks import read_pose2d

POSE2D = NAMES["pose2d"]


def read_by_all(folder):
    """Log times of every message by topic, as three libraries read them; they agree."""
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


@pytest.mark.parametrize("share", [0.0005, 0.3, 0.7, 0.999])
def test_a_file_that_was_cut_off(tmp_path, messages, capture, share):
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


def test_a_whole_session_is_left_alone(pose_session):
    before = (pose_session / "session_0.mcap").read_bytes()
    (file,) = recover_session(pose_session)
    assert not file.repaired
    assert (pose_session / "session_0.mcap").read_bytes() == before


def test_damage_in_the_middle_loses_one_chunk_and_keeps_the_old_file(tmp_path, messages, capture):
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
    assert file.messages > readable + 10
    assert 0.7 * len(capture.tracks) < file.messages < len(capture.tracks)
    assert file.kept.read_bytes() == bytes(data)
    assert len(read_by_all(folder)["/drocap/pose2d"]) == file.messages
    assert len(read_pose2d(open_session(folder))) == file.messages


def test_metadata_is_kept_and_the_description_made_anew(tmp_path, messages, capture):
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


def test_a_split_session_cut_at_its_last_file(tmp_path, messages, capture):
    folder = tmp_path / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(split_s=1.0))
    assert len(list(folder.glob("*.mcap"))) == 4
    last = folder / "s_3.mcap"
    last.write_bytes(last.read_bytes()[:-400])
    (folder / "s_4.mcap").touch()  # made, and then the power went
    with open_session(folder) as session:
        before = len(read_pose2d(session))
        assert any("s_4.mcap is empty" in w for w in session.warnings)
    recover_session(folder)
    assert len(read_by_all(folder)["/drocap/pose2d"]) == before
    assert session_info(folder).warnings == ()


def test_no_room_for_the_mended_file(small_disk, messages, capture):
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


def test_what_is_no_session_is_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("not a recording, but long enough to look at")
    (tmp_path / "zero.mcap").touch()
    (tmp_path / "old.bag").touch()
    for name in ("empty", "text.mcap", "zero.mcap", "old.bag", "missing"):
        assert main(["recover", str(tmp_path / name)]) == 2
        assert "expected" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "old.bag", "text.mcap", "zero.mcap"]


def test_the_command_says_what_it_did(pose_session, capsys):
    path = pose_session / "session_0.mcap"
    path.write_bytes(path.read_bytes()[:-500])
    assert main(["recover", str(pose_session)]) == 0
    out, err = capsys.readouterr()
    assert "session_0.mcap: repaired; 120 messages, each read back" in out
    assert "cut off" in err


KILLED = """
import sys
sys.path[:0] = [{tests!r}]
from writes_until_killed import write_until_killed
write_until_killed({folder!r})
"""


def killed_session(folder, delay_s):
    """Kill a recording process after a while; tells when it had begun and when it was killed, ns."""
    code = KILLED.format(tests=str(Path(__file__).parents[2] / "helpers"), folder=str(folder))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    process.stdout.readline()
    begun_ns = time.time_ns()
    time.sleep(delay_s)
    killed_ns = time.time_ns()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    return begun_ns, killed_ns


@pytest.mark.parametrize("delay_s", np.random.default_rng(7).uniform(0.05, 2.5, 4).round(3))
def test_killed_at_a_random_moment(tmp_path, delay_s):
    folder = tmp_path / "s"
    begun_ns, killed_ns = killed_session(folder, float(delay_s))
    check_recovered(folder, begun_ns, killed_ns)


def check_recovered(folder, begun_ns, killed_ns):
    """All messages older than 1.5 s before the kill are there: numbered without a hole, up to then."""
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
