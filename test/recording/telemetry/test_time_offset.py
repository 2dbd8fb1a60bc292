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
    assert np.diff(times).min() > 2 / 30  # images in between are passed over
    offset = find_offset(video, turning_log(40), None)
    assert offset.seconds == pytest.approx(12.34, abs=0.06)
    assert offset.source is OffsetSource.CORRELATION
    assert 0.7 < offset.correlation <= 1.0
    given = find_offset(video, turning_log(40), 3.5)
    assert given[:2] == (3.5, OffsetSource.GIVEN)
    assert math.isnan(given.correlation)


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


def created_at(video, utc_s):
    data = bytearray(video.read_bytes())
    struct.pack_into(">I", data, data.index(b"mvhd") + 8, round(2_082_844_800 + utc_s))
    video.write_bytes(data)
    return video


@pytest.mark.parametrize("zone_h", [-12, -9.5, -3.5, -1, 0, 0.5, 2, 5.5, 9, 14])
@pytest.mark.parametrize("seconds", [40, 1500])
def test_a_creation_time_in_local_time_is_one_of_its_zone(tmp_path, zone_h, seconds):
    video = created_at(turning_video(tmp_path / "v.mp4", 12.0, 8, even=True), 1_700_000_012 + 3600 * zone_h)
    offset = find_offset(video, turning_log(seconds, even=True), None)
    assert (offset.seconds, offset.zone_h) == (pytest.approx(12.0), zone_h)
    assert ("is taken as local time" in str(offset)) == (zone_h != 0)


@pytest.mark.parametrize("hours", [2.25, 2.4, 20, -15])
def test_a_creation_time_of_no_zone_is_none(tmp_path, hours):
    video = created_at(turning_video(tmp_path / "v.mp4", 12.0, 8, even=True), 1_700_000_012 + 3600 * hours)
    with pytest.raises(InputError, match="give --time-offset"):
        find_offset(video, turning_log(40, even=True), None)


def test_a_log_that_several_zones_fit_takes_whole_hours(tmp_path):
    log = turning_log(40, even=True)
    for seconds, zone_h in ((2500, 2.0), (8000, 0.0)):  # in the longer one the time fits as UTC
        stamp_ns = np.append(log.track.stamp_ns[:-1], log.track.stamp_ns[0] + seconds * 10**9)
        video = created_at(turning_video(tmp_path / "v.mp4", 12.0, 8, even=True), 1_700_000_012 + 7200)
        longer = log._replace(track=log.track._replace(stamp_ns=stamp_ns))
        assert find_offset(video, longer, None).zone_h == zone_h


def test_a_time_with_its_zone_is_read_first(tmp_path):
    from drocap_ros.perception.sources.video import pyav

    av = pyav()
    with av.open(str(tmp_path / "v.mov"), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update({"creation_time": "2024-05-01T12:00:00Z",
                                   "com.apple.quicktime.creationdate": "2024-05-01T12:00:00+0200"})  # fmt: skip
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(5):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), "bgr24")))
        container.mux(stream.encode())
    assert stated_times(tmp_path / "v.mov")[0] == 1_714_557_600 * 10**9
