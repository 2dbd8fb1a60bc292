"""Airdata's CSV beside a video."""

import random

import numpy as np
import pytest
from djmd_clips import plain_video
from telemetry_logs import angles_of, mutated, wrapped

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import geodetic_to_enu
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.time_offset import OffsetSource, find_offset

COLUMNS = (
    "time(millisecond)", "datetime(utc)", "latitude", "longitude", "height_above_takeoff({})", "speed(mph)",
    "compass_heading(degrees)", " pitch(degrees)", " roll(degrees)", "isPhoto", "isVideo", "gimbal_heading(degrees)",
    "gimbal_pitch(degrees)", "gimbal_roll(degrees)", "message",
)  # fmt: skip


def flight(seconds=40.0):
    t = np.arange(0, seconds, 0.1).round(1)
    gimbal = np.stack([0 * t, -0.4 + 0.05 * np.sin(t), (0.1 * t + 1) % (2 * np.pi)], axis=1)  # roll, pitch, yaw
    body = np.stack([0.05 * np.cos(t), 0.03 * np.sin(t), (0.1 * t + 1.02) % (2 * np.pi)], axis=1)
    return t, gimbal, body, np.stack([47 + 1e-5 * np.sin(t), 8 + 1e-5 * np.cos(t), 10 + 0.1 * t], axis=1)


def write(path, video, unit="feet", flown=None, columns=COLUMNS):
    t, gimbal, body, geodetic = flown or flight()
    factor = {"feet": 0.3048, "meters": 1.0}.get(unit, 1.0)
    g, b = np.rad2deg(gimbal), np.rad2deg(body)
    lines = [",".join(columns).format(unit)]
    for i, s in enumerate(t):
        row = (
            f"{1000 * s:.0f}", f"2026-05-01 10:{int(s) // 60:02d}:{int(s) % 60:02d}", f"{geodetic[i, 0]:.9f}",
            f"{geodetic[i, 1]:.9f}", f"{geodetic[i, 2] / factor:.3f}", "3.1", f"{b[i, 2]:.4f}", f"{b[i, 1]:.4f}",
            f"{b[i, 0]:.4f}", "0", str(int(any(first <= s <= last for first, last in video))), f"{g[i, 2]:.4f}",
            f"{g[i, 1]:.4f}", f"{g[i, 0]:.4f}", '"Take-off, ""home"" set"' if i == 0 else "",
        )  # fmt: skip
        lines.append(",".join(row[: len(columns)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    return path


@pytest.mark.parametrize("unit", ["feet", "meters"])
def test_columns_give_attitudes_and_position_in_their_units(tmp_path, unit):
    _, gimbal, body, geodetic = flight()
    log = read_telemetry(write(tmp_path / "f.csv", [(12.0, 14.5), (30.0, 39.9)], unit))
    assert wrapped(angles_of(log.track.gimbal) - gimbal).max() < 1e-5
    assert wrapped(angles_of(log.track.orientation) - body).max() < 1e-5
    enu = geodetic_to_enu(geodetic, np.array([*geodetic[0, :2], 0.0]))
    assert np.abs(log.track.position - enu).max() < 0.01
    assert log.video_parts == ((12_000_000_000, 14_500_000_000), (30_000_000_000, 39_900_000_000))
    assert log.utc_minus_stamp_ns * 1e-9 == pytest.approx(1_777_629_600.0, abs=0.6)
    assert log.lacks == ()


def test_video_belongs_to_the_part_of_its_length(tmp_path):
    video = plain_video(tmp_path / "v.mp4", 75)  # 2.5 s
    log = read_telemetry(write(tmp_path / "f.csv", [(12.0, 14.5), (20.0, 31.0)]))
    offset = find_offset(video, log, None)
    assert (offset.seconds, offset.source) == (pytest.approx(12.0), OffsetSource.RECORDED_PART)
    both = read_telemetry(write(tmp_path / "f.csv", [(12.0, 14.5), (20.0, 22.6)]))
    with pytest.raises(InputError, match="give --time-offset"):
        find_offset(video, both, None)


def test_tables_that_cannot_be_used_are_refused_in_one_line(tmp_path):
    path = tmp_path / "f.csv"
    t, gimbal, body, geodetic = flight()
    refusals = {
        "zeros throughout": lambda: write(path, [], flown=(t, 0 * gimbal, body, geodetic)),
        "found another unit": lambda: write(path, [], unit="furlongs"),
        "expected a flight log of Airdata": lambda: path.write_text("a,b\n1,2\n"),
        "expected rows": lambda: write(path, [], flown=(t[:0], gimbal[:0], body[:0], geodetic[:0])),
        "jumps": lambda: write(
            path, [], flown=(t, gimbal, body, geodetic + np.outer(np.arange(len(t)) > 99, [1, 0, 0]))
        ),
        "found neither": lambda: write(path, [], columns=COLUMNS[:2]),
    }
    for words, make in refusals.items():
        make()
        with pytest.raises(InputError, match=words) as error:
            read_telemetry(path)
        assert "\n" not in str(error.value)


def test_damaged_tables_give_a_result_or_one_clear_line(tmp_path):
    whole, rng = write(tmp_path / "f.csv", [(12.0, 14.5)]).read_bytes(), random.Random(2)
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
