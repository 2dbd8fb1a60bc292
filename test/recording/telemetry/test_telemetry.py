"""Telemetry logs against what their own libraries print, and against flights of which the truth is known."""

import math
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from dataflash import write_dataflash
from scipy.interpolate import CubicSpline

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.flight.frames import (
    geodetic_to_enu,
    ned_to_enu,
    orientation_to_aviation,
    orientation_to_ros,
    quaternion_from_euler,
    quaternion_multiply,
    yaw_of,
)
from drocap_ros.geometry.rotations import angle_between, matrix_from_quaternion
from drocap_ros.motion import load_motion
from drocap_ros.recording.telemetry.camera_poses import VehicleTrack, camera_poses
from drocap_ros.recording.telemetry.read import BOOT, UTC, VIDEO, TelemetryLog, read_telemetry
from drocap_ros.recording.telemetry.time_offset import creation_time_ns, find_offset, image_motion
from drocap_ros.tracks import save_tracks

ROOT = Path(__file__).parents[3]


def media(name):
    path = ROOT.parent / "shared" / "media" / name
    if not path.exists():
        pytest.skip(f"{name} is not there (../shared)")
    return path


def angles_of(orientation):
    """(N, 3) roll, pitch, yaw rad, FRD against NED, of rotations FLU -> ENU."""
    x, y, z, w = orientation_to_aviation(orientation).T
    return np.stack(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ],
        axis=1,
    )


def wrapped(angle):
    return np.abs(np.angle(np.exp(1j * angle)))


def test_tlog_against_pymavlink():
    from pymavlink import mavutil

    path = media("arduplane_vtol_sitl.tlog")
    log = read_telemetry(path)
    theirs = mavutil.mavlink_connection(str(path))
    attitude, position = [], []
    while (m := theirs.recv_match(type=["ATTITUDE", "LOCAL_POSITION_NED"])) is not None:
        (attitude if m.get_type() == "ATTITUDE" else position).append(m)
    boot = {m.time_boot_ms: (m.roll, m.pitch, m.yaw) for m in attitude}
    ours = angles_of(log.track.orientation)
    assert (log.kind, log.clock, log.utc_minus_stamp_ns) == ("MAVLink tlog", UTC, 0)
    assert len(ours) > 0.98 * len(boot)
    # The estimator's clock is that of the reception: match by value order, both are in the order of time.
    told = np.array(list(boot.values()))
    boot_ms, place = [], 0
    for row in ours:
        while wrapped(told[place] - row).max() > 1e-5:
            place += 1
        boot_ms.append(list(boot)[place])
        place += 1
    # Positions: the estimator carries the last one on by its velocity, so they fit to a few decimetres at 30 m/s.
    known_ms = np.array([m.time_boot_ms for m in position])
    enu = ned_to_enu(np.array([(m.x, m.y, m.z) for m in position]))
    expected = np.stack([np.interp(boot_ms, known_ms, enu[:, i]) for i in range(3)], axis=1)
    error = np.linalg.norm(log.track.position - expected, axis=1)
    known = np.isfinite(error)
    assert known.sum() > 800
    assert np.median(error[known]) < 0.3
    assert np.ptp(np.diff(log.track.stamp_ns * 1e-6 - boot_ms)) < 300  # one clock for all
    assert log.lacks == ("no gimbal or camera attitude",)


def test_ulog_against_pyulog():
    from pyulog import ULog

    path = media("px4_sample_small.ulg")
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
    # The estimator calls its local position invalid in this log: the GPS's counts, and that is told.
    assert (theirs["vehicle_local_position"]["xy_valid"] == 0).all()
    assert any("no valid local position" in text for text in log.lacks)
    geodetic = np.stack([gps["lat"] * 1e-7, gps["lon"] * 1e-7, gps["alt"] * 1e-3], axis=1)
    enu = geodetic_to_enu(geodetic, geodetic[0])
    known = np.isfinite(log.track.position).all(axis=1)
    assert known.mean() > 0.9
    for i in range(3):
        expected = np.interp(attitude["timestamp"][known], gps["timestamp"], enu[:, i])
        assert np.abs(log.track.position[known, i] - expected).max() < 1e-3
    assert log.clock == BOOT
    assert log.utc_minus_stamp_ns // 1000 == pytest.approx(
        gps["time_utc_usec"][0].astype(float) - gps["timestamp"][0], abs=3e5
    )


@pytest.fixture
def flight():
    """Angles (N, 3) rad roll pitch yaw, geodetic (N, 3), mount angles (N, 3), times (N,) s of a made-up flight."""
    t = np.arange(0, 8, 0.05)
    angles = np.stack([0.1 * np.sin(t), 0.05 * np.cos(t), 0.4 * t - 1], axis=1)
    geodetic = np.stack([47.0 + 1e-5 * np.sin(t), 8.0 + 1e-5 * np.cos(t), 500 + 0.5 * t], axis=1)
    mount = np.stack([0 * t, -0.5 + 0.1 * np.sin(t), 0.4 * t - 0.9], axis=1)
    return t, angles, geodetic, mount


def test_dataflash(tmp_path, flight):
    t, angles, geodetic, mount = flight
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
    assert without.lacks == ("no gimbal or camera attitude", "no position")
    assert without.utc_minus_stamp_ns is None


def srt_text(t, lines):
    def stamp(s):
        ms = round(s * 1000)
        return f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"

    return "\n".join(
        f"{i + 1}\n{stamp(s)} --> {stamp(s + 0.033)}\n{line}\n"
        for i, (s, line) in enumerate(zip(t, lines, strict=True))
    )


def new_form(i, geodetic, mount):
    g, (roll, pitch, yaw) = geodetic, np.rad2deg(mount)
    return (
        f'<font size="28">FrameCnt: {i + 1}, DiffTime: 33ms\n2023-05-01 10:00:{i % 60:02d}.123\n[iso: 100]'
        f" [shutter: 1/1000.0] [focal_len: 24.00] [latitude: {g[0]:.7f}] [longitude: {g[1]:.7f}]"
        f" [rel_alt: {g[2] - 500:.3f} abs_alt: {g[2]:.3f}]"
        f" [gb_yaw: {yaw:.3f} gb_pitch: {pitch:.3f} gb_roll: {roll:.3f}] </font>"
    )


def test_dji_subtitles_with_gimbal(tmp_path, flight):
    t, _, geodetic, mount = flight
    t = t.round(3)
    (tmp_path / "x.srt").write_text(
        srt_text(t, [new_form(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    log = read_telemetry(tmp_path / "x.srt")
    assert (log.clock, log.lacks) == (VIDEO, ("no vehicle attitude",))
    assert np.array_equal(log.track.stamp_ns, np.round(t * 1e9).astype(np.int64))
    assert wrapped(angles_of(log.track.gimbal) - mount).max() < 1e-4
    origin = geodetic[0].copy()
    origin[2] = 500  # heights count from take-off
    assert np.abs(log.track.position - geodetic_to_enu(geodetic, origin)).max() < 0.02
    assert find_offset(tmp_path / "x.mp4", log, None).seconds == 0.0


def test_dji_subtitles_of_other_models(tmp_path):
    t = np.arange(30) / 10
    old = [
        f"HOME(8.0000,47.0000) 2017.05.01 10:00:00\nGPS(8.000{i:02d},47.0001,17) BAROMETER:{i / 10}" for i in range(30)
    ]
    (tmp_path / "old.SRT").write_text(srt_text(t, old))
    log = read_telemetry(tmp_path / "old.SRT")
    assert log.lacks == (
        "no gimbal or camera attitude", "no vehicle attitude",
        "no height above take-off: heights count from the first barometer",
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


def test_camera_of_each_picture_is_interpolated(tmp_path, flight):
    t, _, geodetic, mount = flight
    (tmp_path / "x.srt").write_text(
        srt_text(t.round(3), [new_form(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    log = read_telemetry(tmp_path / "x.srt")
    at = np.arange(0.1, 7.8, 1 / 29.97)
    poses = camera_poses(log.track, np.round(at * 1e9).astype(np.int64))
    exact = np.stack([0 * at, -0.5 + 0.1 * np.sin(at), 0.4 * at - 0.9], axis=1)
    flu_to_enu = orientation_to_ros(quaternion_from_euler(*exact.T).T)
    truth = np.swapaxes(matrix_from_quaternion(flu_to_enu), 1, 2)
    optical_from_flu = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert np.rad2deg(angle_between(poses.rotation, optical_from_flu @ truth)).max() < 0.02


@pytest.mark.parametrize("name", ["x.tlog", "x.ulg", "x.bin", "x.srt", "x.txt"])
@pytest.mark.parametrize("content", [b"", b"no log at all\n" * 300, bytes(3000), b"ULog\x01\x12\x35" + bytes(100)])
def test_files_that_are_no_log(tmp_path, capfd, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected") as error:
        read_telemetry(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")  # the libraries stay silent
    with pytest.raises(InputError, match="no such file"):
        read_telemetry(tmp_path / "missing.srt")


def mutated(data, rng):
    data = bytearray(data)
    for _ in range(rng.randrange(1, 8)):
        kind, place = rng.randrange(4), rng.randrange(len(data))
        if kind == 0:
            data[place] = rng.randrange(256)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 300)]
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randrange(1, 300))
        else:
            data[place : place + 8] = struct.pack("<Q", 2 ** rng.randrange(64) - 1)
    return bytes(data)


def test_damaged_logs_give_a_result_or_one_clear_line(tmp_path, flight):
    t, angles, geodetic, mount = flight
    logs = {
        "x.srt": srt_text(
            t.round(3), [new_form(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))]
        ).encode(),
        "x.bin": write_dataflash(tmp_path / "whole.bin", t, angles, geodetic, mount).read_bytes(),
        "x.tlog": media("arduplane_vtol_sitl.tlog").read_bytes()[:60_000],
        "x.ulg": media("px4_sample_small.ulg").read_bytes()[:200_000],
    }
    rng = random.Random(4)
    for name, data in logs.items():
        for _ in range(15):
            (tmp_path / name).write_bytes(mutated(data, rng))
            stamp_ns, refusal = attempt(tmp_path / name)
            assert "\n" not in refusal
            assert (np.diff(stamp_ns) > 0).all()


def attempt(path):
    """Stamps of a log, or the words with which it was refused; anything else comes through."""
    try:
        return read_telemetry(path).track.stamp_ns, ""
    except InputError as error:
        return np.zeros(0), str(error)


# -- the time offset -----------------------------------------------------------------------------------


def heading_at(t, even=False):
    """Heading rad to the left: an orbit, flown unevenly by hand unless told otherwise."""
    knots = np.random.default_rng(3).normal(0, 0.12, 200)
    return 0.4 * t + (0 if even else CubicSpline(np.arange(200), knots)(t))


def turning_log(seconds, even=False, clock=BOOT):
    t = np.arange(0, seconds, 0.05)
    heading = heading_at(t, even)
    half = 0.5 * heading
    orientation = np.stack([0 * t, 0 * t, np.sin(half), np.cos(half)], axis=1)
    stamp_ns = 5 * 10**9 + np.round(t * 1e9).astype(np.int64)
    nan = np.full((len(t), 4), np.nan)
    utc = 1_700_000_000 * 10**9 - 5 * 10**9
    return TelemetryLog("test", VehicleTrack(stamp_ns, np.zeros((len(t), 3)), orientation, nan), clock, utc, ())


def turning_video(path, start_s, seconds, even=False):
    """A camera that turns before a textured wall, 60 degrees wide, 30 pictures a second."""
    import cv2

    width, height, wide = 320, 180, 4000
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (height, wide, 3), dtype=np.uint8), (0, 0), 2)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    px_per_rad = width / math.radians(60)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (width, height))
    for i in range(round(seconds * 30)):
        heading = heading_at(start_s + i / 30, even)
        shift = round(-heading * px_per_rad) % wide  # turning left brings in what lies to the left
        writer.write(np.take(wall, np.arange(shift, shift + width) % wide, axis=1))
    writer.release()
    return path


def test_offset_from_the_cameras_turning(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.34, 12)
    times, motion = image_motion(video)
    rate = np.gradient(heading_at(12.34 + times), times)
    assert np.corrcoef(motion, rate)[0, 1] > 0.9
    offset = find_offset(video, turning_log(40), None)
    assert offset.seconds == pytest.approx(12.34, abs=0.06)
    assert "turning" in offset.source
    assert find_offset(video, turning_log(40), 3.5).seconds == 3.5


def test_an_even_orbit_cannot_be_placed_and_says_so(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.0, 8, even=True)
    with pytest.raises(InputError, match="give --time-offset") as error:
        find_offset(video, turning_log(40, even=True), None)
    assert "\n" not in str(error.value)


def test_the_containers_creation_time_is_the_last_resort(tmp_path):
    video = turning_video(tmp_path / "v.mp4", 12.0, 8, even=True)
    data = bytearray(video.read_bytes())
    place = data.index(b"mvhd") + 4
    struct.pack_into(">I", data, place + 4, 2_082_844_800 + 1_700_000_012)
    video.write_bytes(data)
    assert creation_time_ns(video) == 1_700_000_012 * 10**9
    offset = find_offset(video, turning_log(40, even=True), None)
    assert offset.seconds == pytest.approx(12.0)
    assert "to a second at best" in offset.warning
    for junk in (b"", data[:100], bytes(5000), b"\0\0\0\0moov" * 100):
        (tmp_path / "junk.mp4").write_bytes(junk)
        assert creation_time_ns(tmp_path / "junk.mp4") is None


def reconstruct(*words):
    return main(["reconstruct", *map(str, words)])


def test_a_video_with_subtitles_beside_it(tmp_path, flight, capture, caplog, capsys):
    video, models = media("pose_1.mp4"), media("pose_1.mp4").parents[1] / "models"
    t, _, geodetic, mount = flight
    (tmp_path / "v.srt").write_text(
        srt_text(t.round(3), [new_form(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    options = ("--models", models, "--out", tmp_path / "out", "--quiet", "--method", "initial")
    assert reconstruct(video, "--telemetry", tmp_path / "v.srt", *options) == 0
    motion = load_motion(tmp_path / "out" / "motion.npz")
    assert motion.frame == "world"
    assert len(motion.joints3d) == 120
    assert "the log tells no vehicle attitude" in caplog.text
    assert "time offset 0.00 s" in caplog.text
    assert reconstruct(video, "--time-offset", "1", *options) == 2
    assert "expected --telemetry" in capsys.readouterr().err
    save_tracks(tmp_path / "t.npz", capture.tracks)
    assert reconstruct(tmp_path / "t.npz", "--telemetry", tmp_path / "v.srt", *options) == 2
    assert "expected a video file as input" in capsys.readouterr().err


def test_a_fixed_camera_at_a_told_pitch_turns_with_the_vehicle():
    log = turning_log(10)
    stamp_ns = log.track.stamp_ns[10:50]
    assert camera_poses(log.track, stamp_ns).rotation is None
    rotation = camera_poses(log.track, stamp_ns, mount_pitch_deg=-30.0).rotation
    forward = np.swapaxes(rotation, 1, 2)[:, :, 2]
    assert np.rad2deg(np.arcsin(forward[:, 2])) == pytest.approx(-30.0)
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    assert wrapped(heading - heading_at((stamp_ns - 5e9) * 1e-9)).max() < 1e-6


def test_gimbal_that_follows_the_vehicle_adds_its_heading():
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
    assert quaternion_multiply(body, body).shape == (n, 4)
