import math
import struct

import numpy as np
import pytest
from telemetry_logs import heading_at, turning_log, turning_video

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.video_tracks import stated_times
from drocap_ros.recording.video_telemetry import OffsetSource, find_offset, image_motion


def test_offset_is_estimated_from_the_cameras_turning(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.34, 12)
    times, motion = image_motion(video)
    rate = np.gradient(heading_at(12.34 + times), times)
    assert np.corrcoef(motion, rate)[0, 1] > 0.9
    offset = find_offset(video, turning_log(40), None)
    assert offset.seconds == pytest.approx(12.34, abs=0.06)
    assert offset.source is OffsetSource.CORRELATION
    assert 0.7 < offset.correlation <= 1.0
    assert find_offset(video, turning_log(40), 3.5) == (3.5, OffsetSource.GIVEN, pytest.approx(math.nan, nan_ok=True))


def test_even_orbit_without_creation_time_is_refused(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.0, 8, even=True)
    with pytest.raises(InputError, match="give --time-offset") as error:
        find_offset(video, turning_log(40, even=True), None)
    assert "\n" not in str(error.value)


def test_creation_time_gives_the_offset_of_an_even_orbit(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.0, 8, even=True)
    data = bytearray(video.read_bytes())
    place = data.index(b"mvhd") + 4
    struct.pack_into(">I", data, place + 4, 2_082_844_800 + 1_700_000_012)
    video.write_bytes(data)
    assert stated_times(video)[0] == 1_700_000_012 * 10**9
    offset = find_offset(video, turning_log(40, even=True), None)
    assert offset.seconds == pytest.approx(12.0)
    assert offset.source is OffsetSource.CREATION_TIME
    for junk in (b"", data[:100], bytes(5000), b"\0\0\0\0moov" * 100):
        (tmp_path / "junk.mp4").write_bytes(junk)
        assert stated_times(tmp_path / "junk.mp4") == (None, None)
