"""Airdata's CSV beside a video."""

import random
import re

import numpy as np
import pytest
from airdata_tables import COLUMNS, airdata_flight, write_airdata
from djmd_clips import plain_video
from telemetry_logs import angles_of, mutated, wrapped

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.recording.telemetry.log import Lack
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.video_telemetry import OffsetSource, find_offset


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


def litchi(folder):
    t, gimbal, body, geodetic = airdata_flight()
    g, b = np.rad2deg(gimbal), np.rad2deg(body)
    rows = ["latitude,longitude,altitude(m),time(millisecond),pitch(deg),roll(deg),yaw(deg),gimbalPitchRaw,"
            "gimbalRollRaw,gimbalYawRaw,isVideo"]  # fmt: skip
    rows += [f"{p[0]:.7f},{p[1]:.7f},{p[2]:.3f},{1000 * s:.0f},{y[1]:.5f},{y[0]:.5f},{y[2]:.5f},"
             f"{10 * x[1]:.4f},{10 * x[0]:.4f},{10 * x[2]:.4f},1"
             for s, p, y, x in zip(t, geodetic, b, g, strict=True)]  # fmt: skip
    return "\n".join(rows)


def flight_record(folder):
    t, gimbal, body, geodetic = airdata_flight()
    g, b = np.rad2deg(gimbal), np.rad2deg(body)
    rows = ["CUSTOM.date [local],OSD.flyTime [s],OSD.latitude,OSD.longitude,OSD.height [ft],OSD.pitch,OSD.roll,OSD.yaw,"
            "GIMBAL.pitch,GIMBAL.roll,GIMBAL.yaw,CAMERA.isVideo"]  # fmt: skip
    rows += [f"5/1/2024,{s:.3f},{p[0]:.7f},{p[1]:.7f},{p[2] / 0.3048:.4f},{y[1]:.5f},{y[0]:.5f},{y[2]:.5f},"
             f"{x[1]:.5f},{x[0]:.5f},{x[2]:.5f},True"
             for s, p, y, x in zip(t, geodetic, b, g, strict=True)]  # fmt: skip
    return "\n".join(rows)


def airdata(folder):
    return write_airdata(folder / "whole.csv", [(0.0, 39.9)]).read_text(encoding="utf-8-sig")


@pytest.mark.parametrize("form", [airdata, litchi, flight_record])
@pytest.mark.parametrize("save", [lambda s: s.encode(), lambda s: s.encode("utf-16"),
                                  lambda s: s.replace(",", ";").replace(".", ",").encode()])  # fmt: skip
def test_every_flight_log_in_every_saving_is_one_flight(tmp_path, form, save):
    content = form(tmp_path)
    head, rest = content.split("\n", 1)
    saved = save(rest)
    # A spreadsheet keeps the points in the names of the columns.
    head = head.replace(",", ";").encode() if b";" in saved else save(head)
    parts = save(content) if saved[:2] in (b"\xff\xfe", b"\xfe\xff") else head + b"\n" + saved
    (tmp_path / "f.csv").write_bytes(parts)
    _, gimbal, body, geodetic = airdata_flight()
    assert main(["info", str(tmp_path / "f.csv")]) == 0
    log = read_telemetry(tmp_path / "f.csv")
    assert wrapped(angles_of(log.track.gimbal) - gimbal).max() < 1e-5
    assert wrapped(angles_of(log.track.orientation) - body).max() < 1e-5
    enu = geodetic_to_enu(geodetic, np.array([*geodetic[0, :2], 0.0]))
    assert np.abs(log.track.position - enu).max() < 0.02
    assert len(log.video_parts) == 1


def in_metric_words(content):
    """The same log with the units, titles and times of another reader."""
    table = [line.split(",") for line in content.split("\n")]
    for i, title in enumerate(table[0]):
        if title == "OSD.height [ft]":
            for row in table[1:]:
                row[i] = f"{float(row[i]) * 0.3048:.6f}"
        if title == "OSD.flyTime [s]":
            for row in table[1:]:
                row[i] = f"0m {row[i]}s"
    table[0] = [re.sub(r" \[(s|ft)\]", "", title) for title in table[0]]
    return "\n".join(map(",".join, table))


@pytest.mark.parametrize("save", [
    in_metric_words,
    lambda s: "sep=,\n" + s.replace("[ft]", "(feet)"),
    lambda s: s.replace(",", "\t"),
    lambda s: "\n".join(",".join(f'"{cell.replace(".", ",")}"' for cell in line.split(",")) if i else line
                        for i, line in enumerate(s.split("\n"))),
], ids=["metres", "named separator", "tabs", "quoted decimal commas"])  # fmt: skip
def test_units_and_separators_of_other_programs_are_read(tmp_path, save):
    (tmp_path / "f.csv").write_text(save(flight_record(tmp_path)), encoding="utf-8")
    _, gimbal, _, geodetic = airdata_flight()
    assert main(["info", str(tmp_path / "f.csv")]) == 0
    track = read_telemetry(tmp_path / "f.csv").track
    assert wrapped(angles_of(track.gimbal) - gimbal).max() < 1e-5
    assert np.abs(track.position[:, 2] - geodetic[:, 2]).max() < 0.02


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
        "no column of its time": lambda: path.write_text("a,b\n1,2\n"),
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


@pytest.mark.parametrize("form", ["{}", "{}Z", "{}.250"])
@pytest.mark.parametrize("day", [lambda y, m, d: f"{y}-{m}-{d} ", lambda y, m, d: f"{y}/{m}/{d} ",
                                 lambda y, m, d: f"{d}.{m}.{y} ", lambda y, m, d: f"{y}-{m}-{d}T"])  # fmt: skip
def test_dates_of_a_spreadsheet_are_times(tmp_path, form, day):
    path = write_airdata(tmp_path / "f.csv", [(1.0, 30.0)])
    text = re.sub(
        r"2026-05-01 ([\d:]+)", lambda m: form.format(day("2026", "05", "01") + m[1]), path.read_text("utf-8-sig")
    )
    path.write_text(text)
    assert read_telemetry(path).utc_minus_stamp_ns * 1e-9 == pytest.approx(1_777_629_600.0, abs=0.8)


@pytest.mark.parametrize(
    ("first", "last", "steady"), [(70, 70, True), (70, 70.3, True), (70, 30, False), (84, 60, False)]
)
def test_a_view_that_changes_is_no_lens(tmp_path, first, last, steady):
    lines = write_airdata(tmp_path / "f.csv", [(1.0, 30.0)]).read_text("utf-8-sig").splitlines()
    views = np.linspace(first, last, len(lines) - 1)
    rows = [f"{v:.2f},{line}" for v, line in zip(views, lines[1:], strict=True)]
    (tmp_path / "z.csv").write_text("\n".join([f"hfov,{lines[0]}", *rows]))
    log = read_telemetry(tmp_path / "z.csv")
    assert (log.lens is not None) == steady
    assert any(lack.kind is Lack.ZOOM for lack in log.lacks) != steady


@pytest.mark.parametrize("lengths", [(400, 120), (60, 400), (100, 90, 400, 30)])
def test_the_longest_of_several_flights_in_a_table_is_used(tmp_path, lengths):
    lines = write_airdata(tmp_path / "f.csv", [(1.0, 30.0)]).read_text("utf-8-sig").splitlines()
    (tmp_path / "all.csv").write_text("\n".join([lines[0], *(line for n in lengths for line in lines[1 : n + 1])]))
    log = read_telemetry(tmp_path / "all.csv")
    alone = read_telemetry(tmp_path / "f.csv")
    assert np.array_equal(log.track.stamp_ns, alone.track.stamp_ns[: max(lengths)])
    assert np.allclose(log.track.gimbal, alone.track.gimbal[: max(lengths)])
    assert any(lack.kind is Lack.SEVERAL for lack in log.lacks)
    (tmp_path / "turned.csv").write_text("\n".join([lines[0], *lines[:0:-1]]))
    assert np.array_equal(read_telemetry(tmp_path / "turned.csv").track.stamp_ns, alone.track.stamp_ns)
