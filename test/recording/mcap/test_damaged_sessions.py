import random
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded import write_poses

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d


@pytest.fixture(scope="module")
def whole(tmp_path_factory, messages, capture):
    folder = tmp_path_factory.mktemp("damage") / "s"
    write_poses(folder, messages, capture.tracks, SessionRecorderConfig(chunk_kib=16))
    return (folder / "s_0.mcap").read_bytes()


def read(path):
    with open_session(path) as session:
        info = session.info
        return read_pose2d(session), info, session.warnings


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 0.99])
def test_truncated_file_is_read_as_far_as_it_goes(tmp_path, whole, capture, share):
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(len(whole) * share)])
    tracks, info, warnings = read(path)
    assert 0 < len(tracks) <= len(capture.tracks)
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[: len(tracks)].astype(np.float32), equal_nan=True)
    assert info.message_count == len(tracks)
    assert any("cut off or damaged at byte" in w and f"read the {len(tracks)} messages" in w for w in warnings)


def test_file_truncated_before_its_first_chunk_has_no_topics(tmp_path, whole):
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:120])
    with pytest.raises(InputError, match="expected a topic of type"):
        read(path)


def test_damaged_chunk_is_skipped_and_the_rest_is_read(tmp_path, whole, capture):
    data = bytearray(whole)
    place = len(data) // 3
    data[place : place + 4] = b"\0\0\0\0"
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    tracks, _, warnings = read(path)
    assert 0.3 * len(capture.tracks) < len(tracks) < len(capture.tracks)
    assert any("1 damaged chunks" in w for w in warnings)


def _attempt(path):
    try:
        tracks, _, _ = read(path)
    except InputError as refusal:
        text = str(refusal)
    else:
        assert len(tracks) > 0
        return
    assert "\n" not in text


@settings(max_examples=80, deadline=5000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_mutated_files_give_a_result_or_one_clear_line(tmp_path, whole, seed):
    rng = random.Random(seed)
    data = bytearray(whole)
    for _ in range(rng.randrange(1, 6)):
        kind, place = rng.randrange(5), rng.randrange(len(data))
        if kind == 0:
            data[place] = rng.randrange(256)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 200)]
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randrange(1, 200))
        elif kind == 3:
            data[place : place + 8] = (2 ** rng.randrange(64) - 1).to_bytes(8, "little")
        else:
            del data[max(place, 100) :]
    path = tmp_path / "mutated.mcap"
    path.write_bytes(data)
    _attempt(path)


def test_wrong_lengths_take_no_memory(tmp_path, whole):
    tracemalloc.start()
    rng = random.Random(3)
    for i in range(40):
        data = bytearray(whole)
        place = rng.randrange(8, 600) if i % 2 else rng.randrange(8, len(data) - 8)
        data[place : place + 8] = (2 ** rng.choice([30, 33, 40, 62])).to_bytes(8, "little")
        path = tmp_path / "wrong_length.mcap"
        path.write_bytes(data)
        _attempt(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200e6


@settings(max_examples=30, deadline=5000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(max_size=300) | st.binary(max_size=300).map(lambda b: b.decode("latin-1")))
def test_any_metadata_file_gives_a_result_or_one_clear_line(tmp_path, whole, text):
    folder = tmp_path / "folder"
    folder.mkdir(exist_ok=True)
    (folder / "folder_0.mcap").write_bytes(whole)
    (folder / "metadata.yaml").write_text(text, encoding="utf-8", errors="replace")
    _attempt(folder)
