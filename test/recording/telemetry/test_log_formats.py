"""Telemetry logs against the output of their own libraries, and against flights of which the truth is known."""

import math
import random
import struct

import numpy as np
import pytest
from angles import angle_between
from dataflash import write_dataflash
from djmd_clips import plain_video
from telemetry_logs import angles_of, dji_subtitle, mutated, srt_text, with_track, wrapped

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import ned_to_enu, orientation_to_aviation, quaternion_from_euler, yaw_of
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.recording.telemetry.log import Lack, LogLack, camera_attitude, camera_poses
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.video_telemetry import find_offset, read_own


def test_tlog_states_equal_what_pymavlink_reads(shared):
    from pymavlink import mavutil

    path = shared / "media" / "arduplane_vtol_sitl.tlog"
    log = read_telemetry(path)
    theirs = mavutil.mavlink_connection(str(path))
    attitude, position = [], []
    while (m := theirs.recv_match(type=["ATTITUDE", "LOCAL_POSITION_NED"])) is not None:
        (attitude if m.get_type() == "ATTITUDE" else position).append(m)
    boot = {m.time_boot_ms: (m.roll, m.pitch, m.yaw) for m in attitude}
    ours = angles_of(log.track.orientation)
    assert (log.kind, log.utc_minus_stamp_ns) == ("MAVLink tlog", 0)
    assert len(ours) > 0.98 * len(boot)
    # The estimator stamps by time of reception, so rows are matched by value; both are ordered by time.
    expected_angles = np.array(list(boot.values()))
    boot_ms, place = [], 0
    for row in ours:
        while wrapped(expected_angles[place] - row).max() > 1e-5:
            place += 1
        boot_ms.append(list(boot)[place])
        place += 1
    # The estimator propagates positions by velocity, so they agree to a few decimetres at 30 m/s.
    known_ms = np.array([m.time_boot_ms for m in position])
    enu = ned_to_enu(np.array([(m.x, m.y, m.z) for m in position]))
    expected = np.stack([np.interp(boot_ms, known_ms, enu[:, i]) for i in range(3)], axis=1)
    error = np.linalg.norm(log.track.position - expected, axis=1)
    known = np.isfinite(error)
    assert known.sum() > 800
    assert np.median(error[known]) < 0.3
    assert np.ptp(np.diff(log.track.stamp_ns * 1e-6 - boot_ms)) < 300  # one clock for all
    assert log.lacks == (LogLack(Lack.CAMERA_ATTITUDE),)


def test_ulog_states_equal_what_pyulog_reads(shared):
    from pyulog import ULog

    path = shared / "media" / "px4_sample_small.ulg"
    log = read_telemetry(path)
    theirs = {d.name: d.data for d in ULog(str(path)).data_list if d.multi_id == 0}
    attitude, gps = theirs["vehicle_attitude"], theirs["vehicle_gps_position"]
    assert np.array_equal(log.track.stamp_ns, attitude["timestamp"].astype(np.int64) * 1000)
    w, x, y, z = (attitude[f"q[{i}]"].astype(float) for i in range(4))
    assert (
        np.abs(np.sum(orientation_to_aviation(log.track.orientation) * np.stack([x, y, z, w], 1), 1)).min() > 1 - 1e-6
    )
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert wrapped(yaw_of(orientation_to_aviation(log.track.orientation)) - yaw).max() < 1e-5
    # The estimator marks its local position as invalid in this log: the GPS's position replaces it.
    assert (theirs["vehicle_local_position"]["xy_valid"] == 0).all()
    assert LogLack(Lack.LOCAL_POSITION, "vehicle_gps_position") in log.lacks
    geodetic = np.stack([gps["lat"] * 1e-7, gps["lon"] * 1e-7, gps["alt"] * 1e-3], axis=1)
    enu = geodetic_to_enu(geodetic, geodetic[0])
    known = np.isfinite(log.track.position).all(axis=1)
    assert known.mean() > 0.9
    for i in range(3):
        expected = np.interp(attitude["timestamp"][known], gps["timestamp"], enu[:, i])
        assert np.abs(log.track.position[known, i] - expected).max() < 1e-3
    assert log.utc_minus_stamp_ns // 1000 == pytest.approx(
        gps["time_utc_usec"][0].astype(float) - gps["timestamp"][0], abs=3e5
    )


def test_dataflash_states_equal_the_flight_they_were_written_from(tmp_path, invented_flight):
    t, angles, geodetic, mount = invented_flight
    path = write_dataflash(tmp_path / "x.bin", t, angles, geodetic, mount)
    log = read_telemetry(path)
    assert np.array_equal(log.track.stamp_ns, np.round((10 + t) * 1e6).astype(np.int64) * 1000)
    assert wrapped(angles_of(log.track.orientation) - angles).max() < 1e-5
    assert wrapped(angles_of(log.track.gimbal) - mount).max() < 1e-4
    assert (
        np.abs(log.track.position - geodetic_to_enu(geodetic, geodetic[0]))[np.isfinite(log.track.position)].max()
        < 0.02
    )
    assert log.utc_minus_stamp_ns / 1e9 == pytest.approx(1_700_000_000 - 10, abs=0.1)
    without = read_telemetry(write_dataflash(tmp_path / "y.bin", t, angles))
    assert without.lacks == (LogLack(Lack.CAMERA_ATTITUDE), LogLack(Lack.POSITION))
    assert without.utc_minus_stamp_ns is None


def test_dataflash_angles_of_servos_are_against_the_body(tmp_path, invented_flight):
    t, angles, geodetic, _ = invented_flight
    demanded = np.tile([0.0, math.radians(-20.0), 0.0], (len(t), 1))
    log = read_telemetry(write_dataflash(tmp_path / "s.bin", t, angles, geodetic, demanded, mount_type=1))
    level = read_telemetry(write_dataflash(tmp_path / "l.bin", t, angles, geodetic, demanded, mount_type=4))
    fixed = camera_attitude(log.track._replace(gimbal=np.full((len(t), 4), np.nan)), -20.0)
    assert np.rad2deg(angle_between(*map(matrix_from_quaternion, (log.track.gimbal, fixed)))).max() < 0.01
    assert wrapped(angles_of(level.track.gimbal) - demanded).max() < 1e-4


def test_dji_subtitles_give_gimbal_and_position(tmp_path, invented_flight):
    t, _, geodetic, mount = invented_flight
    t = t.round(3)
    (tmp_path / "x.srt").write_text(
        srt_text(t, [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    log = read_telemetry(tmp_path / "x.srt")
    assert (log.video_clock, log.lacks) == (True, (LogLack(Lack.VEHICLE_ATTITUDE),))
    assert np.array_equal(log.track.stamp_ns, np.round(t * 1e9).astype(np.int64))
    assert wrapped(angles_of(log.track.gimbal) - mount).max() < 1e-4
    origin = geodetic[0].copy()
    origin[2] = 500  # heights are relative to take-off
    assert np.abs(log.track.position - geodetic_to_enu(geodetic, origin)).max() < 0.02
    assert find_offset(tmp_path / "x.mp4", log, None).seconds == 0.0


def test_dji_subtitles_of_older_models_are_read(tmp_path):
    t = np.arange(30) / 10
    old = [
        f"HOME(8.0000,47.0000) 2017.05.01 10:00:00\nGPS(8.000{i:02d},47.0001,17) BAROMETER:{i / 10}" for i in range(30)
    ]
    (tmp_path / "old.SRT").write_text(srt_text(t, old))
    log = read_telemetry(tmp_path / "old.SRT")
    assert log.lacks == (
        LogLack(Lack.CAMERA_ATTITUDE), LogLack(Lack.VEHICLE_ATTITUDE), LogLack(Lack.HEIGHT, "barometer"),
    )  # fmt: skip
    assert np.ptp(log.track.position[:, 2]) == pytest.approx(2.9, abs=1e-4)
    assert np.ptp(log.track.position[:, 0]) == pytest.approx(29e-5 * 111_320 * math.cos(math.radians(47)), rel=0.01)
    assert camera_poses(log.track, log.track.stamp_ns).rotation is None
    pry = [
        "F/2.8, SS 500, ISO 100, EV 0, GPS (8.0, 47.0, 20), D 5m, H 12.50m,"
        f" F_PRY (1.0°, 2.0°, {i}.0°), G_PRY (-30.0°, 0.0°, {i}.5°)"
        for i in range(30)
    ]
    (tmp_path / "pry.srt").write_text(srt_text(t, pry))
    log = read_telemetry(tmp_path / "pry.srt")
    assert np.rad2deg(angles_of(log.track.gimbal))[7] == pytest.approx([0, -30, 7.5], abs=1e-6)
    assert np.rad2deg(angles_of(log.track.orientation))[7] == pytest.approx([2, 1, 7], abs=1e-6)
    assert (log.track.position[:, 2] == 0).all()
    misspelt = ["[latitude : 47.0] [longtitude : 8.0] [altitude: 10.0]"] * 30
    (tmp_path / "m.srt").write_text(srt_text(t, misspelt))
    assert np.isfinite(read_telemetry(tmp_path / "m.srt").track.position).all()


@pytest.mark.parametrize(
    "place",
    [
        "GPS(8.00{i:02d}00,47.000000,17) BAROMETER:5.0",
        "GPS(47.000000,8.00{i:02d}00,0.0M) BAROMETER:5.0M",
        "GPS(E:8.00{i:02d}00, N:47.000000, 5.00m)",
        "GPS(N:47.000000, E:8.00{i:02d}00, 5.00m)",
        "GPS (8.00{i:02d}00, 47.000000, 17), D 8.00m, H 5.00m",
    ],
)
@pytest.mark.parametrize(
    "angles",
    [
        "F_PRY ({0}), G_PRY ({1})",
        "F.PRY ({0}), G.PRY ({1})",
        "F PRY({0}) G PRY({1})",
        "f_pry: ({0}), g_pry: ({1})",
        "[gb_yaw : {i}.5 gb_pitch : -20.0 gb_roll : 0.0] [drone_yaw: {i}.0 drone_pitch: -3.0 drone_roll: 0.5]",
        "GimbalPitchDegree: -20.0 GimbalYawDegree: +{i}.5 FlightYawDegree: {i}.0 FlightPitchDegree: -3.0"
        " FlightRollDegree: 0.5",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_every_spelling_of_subtitles_is_one_flight(tmp_path, place, angles, encoding):
    pry = "-3.0°, 0.5°, {i}.0°", "-20.0°, 0.0°, {i}.5°"
    lines = [
        f"{place}\n{angles}".replace("{0}", pry[0]).replace("{1}", pry[1]).replace("{i:02d}", f"{i:02d}")
        .replace("{i}", str(i))
        for i in range(20)
    ]  # fmt: skip
    (tmp_path / "x.SRT").write_text(srt_text(np.arange(20.0), lines), encoding=encoding)
    track = read_telemetry(tmp_path / "x.SRT").track
    metres = 19e-4 * 111_320 * math.cos(math.radians(47))
    assert np.ptp(track.position, axis=0) == pytest.approx([metres, 0, 0], abs=0.01 * metres)
    assert np.rad2deg(angles_of(track.gimbal))[7] == pytest.approx([0, -20, 7.5], abs=1e-6)
    assert np.rad2deg(angles_of(track.orientation))[7] == pytest.approx([0.5, -3, 7], abs=1e-6)


def test_subtitles_inside_a_video_are_read_as_those_beside_it(tmp_path, invented_flight, capsys):
    _, _, geodetic, mount = invented_flight
    lines = [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))]
    (tmp_path / "x.srt").write_text(srt_text(np.arange(len(lines)) * 0.1, lines))
    video = plain_video(tmp_path / "v.mp4", 10)
    (tmp_path / "s.mp4").write_bytes(
        with_track(video, [struct.pack(">H", len(line.encode())) + line.encode() for line in lines])
    )
    inside, beside = read_telemetry(tmp_path / "s.mp4"), read_telemetry(tmp_path / "x.srt")
    assert np.array_equal(inside.track.stamp_ns, beside.track.stamp_ns)
    assert np.array_equal(inside.track.gimbal, beside.track.gimbal)
    assert main(["info", str(tmp_path / "s.mp4")]) == 0
    assert "source: DJI subtitles" in capsys.readouterr().out


def test_subtitles_inside_matroska_are_read_too(tmp_path, invented_flight):
    import av

    _, _, geodetic, mount = invented_flight
    lines = [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))]
    (tmp_path / "x.srt").write_text(srt_text(np.arange(len(lines)) * 0.1, lines))
    video = plain_video(tmp_path / "v.mp4", 10)
    with (
        av.open(str(video)) as pictures,
        av.open(str(tmp_path / "x.srt")) as texts,
        av.open(str(tmp_path / "s.mkv"), "w") as output,
    ):
        streams = {s: output.add_stream_from_template(s) for s in (pictures.streams.video[0], texts.streams[0])}
        for source in (pictures, texts):
            for packet in source.demux():
                if packet.dts is not None:
                    packet.stream = streams[packet.stream]
                    output.mux(packet)
    inside, beside = read_telemetry(tmp_path / "x.srt"), read_own(tmp_path / "s.mkv")[0][1]
    assert np.allclose(inside.track.gimbal, beside.track.gimbal)
    assert np.abs(inside.track.stamp_ns - beside.track.stamp_ns).max() < 2_000_000


@pytest.mark.parametrize(("slow", "said"), [(4, True), (1, False)])
def test_dates_that_run_slower_than_the_video_are_slow_motion(tmp_path, slow, said):
    lines = [f"2024-05-01 10:00:{i / 30 / slow:06.3f}\n[rel_alt: 5.0] [gb_yaw: 1.0 gb_pitch: -9.0]" for i in range(300)]
    (tmp_path / "s.srt").write_text(srt_text(np.arange(300) / 30, lines))
    lacks = read_telemetry(tmp_path / "s.srt").lacks
    assert (LogLack(Lack.SLOW, "4.0") in lacks) == said


def test_radians_in_subtitles_are_degrees_of_another_unit(tmp_path):
    lines = [f"[latitude : {math.radians(47):.9f}] [longtitude : {math.radians(8 + i * 1e-4):.9f}] [altitude: 9.0]"
             for i in range(20)]  # fmt: skip
    (tmp_path / "r.srt").write_text(srt_text(np.arange(20.0), lines))
    metres = 19e-4 * 111_320 * math.cos(math.radians(47))
    assert np.ptp(read_telemetry(tmp_path / "r.srt").track.position[:, 0]) == pytest.approx(metres, rel=0.01)


def test_zoom_during_a_clip_is_said(tmp_path, capsys):
    lines = [f"[focal_len: {24 + i}.00] [rel_alt: 5.0] [gb_yaw: 1.0 gb_pitch: -9.0 gb_roll: 0.0]" for i in range(25)]
    (tmp_path / "z.srt").write_text(srt_text(np.arange(25.0), lines))
    assert main(["info", str(tmp_path / "z.srt")]) == 0
    assert "the zoom changes (24 mm to 48 mm)" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["fov_h", "hfov", "h_fov", "fovH", "horizontal_fov"])
@pytest.mark.parametrize("degrees", [24.5, 66.0, 84.2])
def test_a_field_of_view_in_subtitles_is_the_lens(tmp_path, name, degrees):
    rows = ["[focal_len: 24.00] [rel_alt: 5.0] [gb_yaw: 1.0 gb_pitch: -9.0] [" + f"{name}: {{}}]"] * 20
    (tmp_path / "v.srt").write_text(srt_text(np.arange(20.0), [row.format(degrees) for row in rows]))
    assert read_telemetry(tmp_path / "v.srt").lens.horizontal_fov_deg((1920, 1080)) == pytest.approx(degrees)
    (tmp_path / "z.srt").write_text(srt_text(np.arange(20.0), [r.format(degrees + i) for i, r in enumerate(rows)]))
    log = read_telemetry(tmp_path / "z.srt")
    assert log.lens is None
    assert f"the zoom changes ({degrees:.0f} deg to" in str(log.lacks[-1])


@pytest.mark.parametrize("name", ["x.tlog", "x.ulg", "x.bin", "x.srt", "x.txt"])
@pytest.mark.parametrize("content", [b"", b"no log at all\n" * 300, bytes(3000), b"ULog\x01\x12\x35" + bytes(100)])
def test_files_that_are_no_log_are_refused_in_one_line(tmp_path, capfd, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected") as error:
        read_telemetry(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")  # the libraries print nothing
    with pytest.raises(InputError, match="no such file"):
        read_telemetry(tmp_path / "missing.srt")


def test_damaged_logs_give_a_result_or_one_clear_line(shared, tmp_path, invented_flight):
    t, angles, geodetic, mount = invented_flight
    logs = {
        "x.srt": srt_text(
            t.round(3), [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))]
        ).encode(),
        "x.bin": write_dataflash(tmp_path / "whole.bin", t, angles, geodetic, mount).read_bytes(),
        "x.tlog": (shared / "media" / "arduplane_vtol_sitl.tlog").read_bytes()[:60_000],
        "x.ulg": (shared / "media" / "px4_sample_small.ulg").read_bytes()[:200_000],
    }
    rng = random.Random(4)
    for name, data in logs.items():
        for _ in range(15):
            (tmp_path / name).write_bytes(mutated(data, rng))
            stamp_ns, refusal = attempt(tmp_path / name)
            assert "\n" not in refusal
            assert (np.diff(stamp_ns) > 0).all()


def attempt(path):
    """Stamps of a log, or the text of its refusal; other exceptions pass."""
    try:
        return read_telemetry(path).track.stamp_ns, ""
    except InputError as error:
        return np.zeros(0), str(error)


def test_yaw_of_a_following_gimbal_adds_the_heading():
    from drocap_ros.recording.telemetry.ulog import _gimbal

    yaw, pitch = 0.7, -0.4
    n = 20
    stamp = np.arange(n) * 50_000
    body = np.repeat(quaternion_from_euler(0.0, 0.0, yaw)[None], n, axis=0)
    for flags, relative in ((32, 0.2), (64, 0.2 + yaw), (0, 0.2), (16, 0.2 + yaw)):
        x, y, z, w = quaternion_from_euler(0.0, pitch, relative)
        status = {"timestamp": stamp, "device_flags": np.full(n, flags)}
        status |= {f"q[{i}]": np.full(n, value) for i, value in enumerate((w, x, y, z))}
        camera = _gimbal({"gimbal_device_attitude_status": status}, stamp * 1000, body)
        assert angles_of(camera)[5] == pytest.approx([0, pitch, 0.2 + yaw], abs=1e-6)
