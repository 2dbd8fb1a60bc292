"""Airdata's CSV beside a video."""

import random

import numpy as np
import pytest
from airdata_tables import COLUMNS, airdata_flight, write_airdata
from djmd_clips import plain_video
from telemetry_logs import angles_of, mutated, wrapped

from drocap_ros.errors import InputError
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.time_offset import OffsetSource, find_offset


@pytest.mark.parametrize("unit", ["feet", "meters"])
def test_columns_give_attitudes_and_position_in_their_units(tmp_path, unit):
    _, gimbal, body, geodetic = airdata_flight()
    log = read_telemetry(write_airdata(tmp_path / "f.csv", [(12.0, 14.5), (30.0, 39.9)], unit))
    assert wrapped(angles_of(log.track.gimbal) - gimbal).max() < 1e-5
    assert wrapped(angles_of(log.track.orientation) - body).max() < 1e-5
    enu = geodetic_to_enu(geodetic, np.array([*geodetic[0, :2], 0.0]))
    assert np.abs(log.track.position - enu).max() < 0.01
    assert log.video_parts == ((12_000_000_000, 14_500_000_000), (30_000_000_000, 39_900_000_000))
    assert log.utc_minus_stamp_ns * 1e-9 == pytest.approx(1_777_629_600.0, abs=0.6)
    assert log.lacks == ()


def test_video_belongs_to_the_part_of_its_length(tmp_path):
    video = plain_video(tmp_path / "v.mp4", 75)  # 2.5 s
    log = read_telemetry(write_airdata(tmp_path / "f.csv", [(12.0, 14.5), (20.0, 31.0)]))
    offset = find_offset(video, log, None)
    assert (offset.seconds, offset.source) == (pytest.approx(12.0), OffsetSource.RECORDED_PART)
    both = read_telemetry(write_airdata(tmp_path / "f.csv", [(12.0, 14.5), (20.0, 22.6)]))
    with pytest.raises(InputError, match="give --time-offset"):
        find_offset(video, both, None)


def test_tables_that_cannot_be_used_are_refused_in_one_line(tmp_path):
    path = tmp_path / "f.csv"
    t, gimbal, body, geodetic = airdata_flight()
    refusals = {
        "zeros throughout": lambda: write_airdata(path, [], flown=(t, 0 * gimbal, body, geodetic)),
        "found another unit": lambda: write_airdata(path, [], unit="furlongs"),
        "expected a flight log of Airdata": lambda: path.write_text("a,b\n1,2\n"),
        "expected rows": lambda: write_airdata(path, [], flown=(t[:0], gimbal[:0], body[:0], geodetic[:0])),
        "jumps": lambda: write_airdata(
            path, [], flown=(t, gimbal, body, geodetic + np.outer(np.arange(len(t)) > 99, [1, 0, 0]))
        ),
        "found neither": lambda: write_airdata(path, [], columns=COLUMNS[:2]),
    }
    for words, make in refusals.items():
        make()
        with pytest.raises(InputError, match=words) as error:
            read_telemetry(path)
        assert "\n" not in str(error.value)


def test_damaged_tables_give_a_result_or_one_clear_line(tmp_path):
    whole, rng = write_airdata(tmp_path / "f.csv", [(12.0, 14.5)]).read_bytes(), random.Random(2)
    for _ in range(15):
        (tmp_path / "f.csv").write_bytes(mutated(whole, rng))
        stamp_ns, refusal = attempt(tmp_path / "f.csv")
        assert "\n" not in refusal
        assert (np.diff(stamp_ns) > 0).all()


def attempt(path):
    """Stamps of a log, or the text of its refusal; other exceptions pass."""
    try:
        return read_telemetry(path).track.stamp_ns, ""
    except InputError as error:
        return np.zeros(0), str(error)
