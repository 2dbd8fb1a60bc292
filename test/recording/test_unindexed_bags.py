"""rosbag1 recordings as a crash leaves them, and folders of them."""

from __future__ import annotations

import random
import shutil
import struct

import numpy as np
import pytest
from recorded import START_NS
from telemetry_logs import mutated
from test_open_session import write_with_rosbags

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.tracks import load_tracks


@pytest.fixture
def whole(tmp_path, messages, capture):
    """A bag of ten poses and five images."""
    return write_with_rosbags(tmp_path / "whole.bag", "bag", messages, capture)


def without_index(path, *, stated=False):
    """The bytes of a bag up to its index; ``stated``: its header still names the place."""
    data = path.read_bytes()
    field = data.index(b"index_pos=") + 10
    place = struct.unpack("<Q", data[field : field + 8])[0]
    cut = bytearray(data[:place])
    if not stated:
        cut[field : field + 8] = bytes(8)
        for name in (b"conn_count=", b"chunk_count="):
            at = cut.index(name) + len(name)
            cut[at : at + 4] = bytes(4)
    return bytes(cut)


@pytest.mark.parametrize("name", ["a.bag", "a.bag.active", "a"])
@pytest.mark.parametrize("stated", [False, True])
def test_every_message_is_read_without_an_index(tmp_path, whole, capture, capsys, name, stated):
    path = tmp_path / name
    path.write_bytes(without_index(whole, stated=stated))
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr()
    assert "messages: 15" in printed.out
    assert "duration: 0.090 s" in printed.out
    assert printed.err.count("no usable index") == 1
    words = ["--method", "initial", "--no-report", "--quiet"]
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), *words]) == 0
    tracks = load_tracks(tmp_path / "out" / "tracks.npz")
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[:10].astype(np.float32), equal_nan=True)
    assert np.array_equal(tracks.stamp_ns, START_NS + np.arange(10) * 10**7)
    with open_session(path) as session:
        assert len(list(read_images(session))) == 5


def test_a_bag_that_is_cut_off_gives_what_is_whole(tmp_path, whole):
    data = without_index(whole)
    counts = []
    for share in (0.5, 0.9):
        (tmp_path / "a.bag").write_bytes(data[: int(share * len(data))])
        with open_session(tmp_path / "a.bag") as session:
            counts.append(session.info.message_count)
            assert any("cut off or damaged at byte" in warning for warning in session.warnings)
    assert 0 < counts[0] < counts[1] < 15


def test_bags_of_a_folder_are_one_recording(tmp_path, whole, messages, capture):
    (tmp_path / "split").mkdir()
    shutil.copy(whole, tmp_path / "split" / "flight_0.bag")
    with open_session(tmp_path / "split") as session:
        assert len(read_pose2d(session)) == 10


def test_damaged_bags_end_in_one_line(tmp_path, whole):
    data, rng = without_index(whole), random.Random(5)
    for _ in range(40):
        (tmp_path / "a.bag").write_bytes(mutated(data, rng))
        try:
            with open_session(tmp_path / "a.bag") as session:
                assert len(list(read_images(session))) <= 5
                assert all("\n" not in warning for warning in session.warnings)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_compressed_files_without_their_description_are_named(tmp_path, capsys):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "s_0.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd" + bytes(40))
    assert main(["info", str(tmp_path / "s")]) == 2
    assert capsys.readouterr().err.endswith(
        "expected a usable metadata.yaml of compressed files, found none; unpack: zstd -d\n"
    )
