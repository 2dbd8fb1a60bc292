"""Telemetry inside the video files of DJI drones, on clips of which the flight is known: no real clip was at hand."""

import random

import numpy as np
import pytest
from angles import angle_between
from djmd_clips import (
    add_track,
    avata_sample,
    damaged_boxes,
    flight,
    mavic4_sample,
    mini_sample,
    plain_video,
    samples,
)
from telemetry_logs import mutated

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import OPTICAL_FROM_FLU
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.motion import load_motion
from drocap_ros.recording.telemetry.djmd import read_djmd
from drocap_ros.recording.telemetry.log import Lack, LogLack, camera_poses
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.tracks import Tracks, load_tracks
from lab.simulation.capture import simulate_capture

COUNT = 45
IMAGE_NS = np.round(np.arange(COUNT) * 1e9 / 30).astype(np.int64)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return plain_video(tmp_path_factory.mktemp("video") / "v.mp4", COUNT).read_bytes()


def clip(video, path, schema, sample, gimbal=None, **options):
    angles, aircraft, geodetic = flight(COUNT)
    angles = angles if gimbal is None else gimbal
    fields = [sample(i, angles[i], aircraft[i], geodetic[i]) for i in range(COUNT)]
    return add_track(video, samples(schema, fields), path, **options)


def camera_truth(tenths_pitch_roll_yaw):
    """(N, 3, 3) world ENU -> optical, by elementary rotations in north, east, down."""
    pitch, roll, yaw = np.deg2rad(np.asarray(tenths_pitch_roll_yaw, float).T / 10)
    c, s = np.cos, np.sin
    one, zero = np.ones_like(yaw), np.zeros_like(yaw)
    about_z = np.array([[c(yaw), -s(yaw), zero], [s(yaw), c(yaw), zero], [zero, zero, one]])
    about_y = np.array([[c(pitch), zero, s(pitch)], [zero, one, zero], [-s(pitch), zero, c(pitch)]])
    about_x = np.array([[one, zero, zero], [zero, c(roll), -s(roll)], [zero, s(roll), c(roll)]])
    ned_from_frd = np.einsum("ijn,jkn,kln->nil", about_z, about_y, about_x)
    enu_from_ned, frd_from_flu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
    return OPTICAL_FROM_FLU @ np.swapaxes(enu_from_ned @ ned_from_frd @ frd_from_flu, 1, 2)


def worst_deg(log, truth, pitch=None):
    poses = camera_poses(log.track, IMAGE_NS, pitch)
    return np.rad2deg(angle_between(poses.rotation, truth[poses.keep])).max()


def test_mini_4_pro_and_air_3_give_gimbal_aircraft_position_and_lens(video, tmp_path):
    gimbal, aircraft, geodetic = flight(COUNT)
    for schema, co64 in (("dvtm_Mini4_Pro", False), ("dvtm_Air3", True)):
        log = read_telemetry(clip(video, tmp_path / "c.mp4", schema, mini_sample, co64=co64))
        assert log.video_clock
        assert log.lacks == ()
        assert worst_deg(log, camera_truth(gimbal)) < 0.05
        body = log.track._replace(gimbal=log.track.orientation)
        assert worst_deg(log._replace(track=body), camera_truth(aircraft)) < 0.05
        enu = geodetic_to_enu(geodetic, np.array([*geodetic[0, :2], 0.0]))
        assert np.abs(log.track.position - enu).max() < 2e-3
        assert log.lens.horizontal_fov_deg((1920, 1080)) == pytest.approx(71.6, abs=0.1)
    assert "main camera, which is assumed" in log.lens.origin


def test_avata_2_without_gimbal_takes_the_mount_from_the_user(video, tmp_path):
    log = read_djmd(clip(video, tmp_path / "c.mp4", "dvtm_AVATA2", avata_sample))
    aircraft = flight(COUNT)[1]
    assert log.lacks == (LogLack(Lack.CAMERA_ATTITUDE),)
    assert camera_poses(log.track, IMAGE_NS).rotation is None
    assert np.isfinite(log.track.position).all()
    turned = camera_truth(aircraft).transpose(0, 2, 1) @ OPTICAL_FROM_FLU
    half = np.deg2rad(-25)  # negative looks down: about the left axis the nose turns down by a positive angle
    down = np.array([[np.cos(half), 0, -np.sin(half)], [0, 1, 0], [np.sin(half), 0, np.cos(half)]])
    truth = OPTICAL_FROM_FLU @ np.swapaxes(turned @ down, 1, 2)
    assert worst_deg(log, truth, pitch=-25.0) < 0.05


def test_mavic_4_quaternion_is_finer_than_its_angles(video, tmp_path):
    exact = flight(COUNT)[0] + np.array([0.37, -0.41, 0.29])  # tenths of a degree
    path = clip(video, tmp_path / "c.mp4", "dvtm_Mavic4", mavic4_sample, gimbal=exact)
    log = read_djmd(path)
    assert worst_deg(log, camera_truth(exact)) < 0.002
    assert np.isfinite(log.track.position).all()  # found at another place, in degrees without a unit
    assert log.lacks == ()

    def disagreeing(i, *rest):
        fields = mavic4_sample(i, *rest)
        fields[4][4] = dict(enumerate(np.float32([0.5, 0.5, 0.5, 0.5]), 1))
        return fields

    log = read_djmd(clip(video, tmp_path / "d.mp4", "dvtm_Mavic4", disagreeing))
    assert log.lacks == (LogLack(Lack.QUATERNION),)
    assert worst_deg(log, camera_truth(flight(COUNT)[0])) < 0.05


def test_unknown_schema_is_read_at_the_known_places_and_said_so(video, tmp_path, capsys):
    for sample, pitch in ((mini_sample, None), (avata_sample, -25.0)):
        path = clip(video, tmp_path / "c.mp4", "dvtm_Tomorrow", sample)
        log = read_djmd(path)
        assert "unknown schema dvtm_Tomorrow, read at the places of known ones and plausible" in log.kind
        assert camera_poses(log.track, IMAGE_NS, pitch).rotation is not None
    assert worst_deg(read_djmd(clip(video, path, "x", mini_sample)), camera_truth(flight(COUNT)[0])) < 0.05
    with pytest.raises(InputError, match="expected a level gimbal"):
        read_djmd(clip(video, path, "x", mini_sample, gimbal=flight(COUNT)[0][:, [1, 2, 0]]))
    with pytest.raises(InputError, match="found neither"):
        read_djmd(clip(video, path, "x", lambda i, *_: {9: {1: i}}))
    assert main(["info", str(path)]) == 0
    assert "found neither" in capsys.readouterr().err


def lies():
    def out_of_range(i, gimbal, *rest):
        return mini_sample(i, gimbal + 40_000, *rest)

    def zeros(i, gimbal, *rest):
        return mini_sample(i, gimbal * 0, *rest)

    def turning(i, gimbal, *rest):
        return mini_sample(i, np.array([900 * (i % 2), 0, 1700 * (i % 2)]), *rest)

    def jumping(i, gimbal, aircraft, geodetic):
        return mini_sample(i, gimbal, aircraft, geodetic + np.array([0.01 * (i == 20), 0, 0]))

    def elsewhere(i, gimbal, aircraft, geodetic):
        return mini_sample(i, gimbal, aircraft, geodetic + 300, degrees=True)

    return {
        "gimbal angles within 180": out_of_range, "zeros throughout": zeros, "of them jump": turning,
        "2 jumps, the longest by 11": jumping, "positions within": elsewhere,
    }  # fmt: skip


@pytest.mark.parametrize("words", lies())
def test_lying_content_is_refused_in_words(video, tmp_path, words):
    with pytest.raises(InputError) as error:
        read_djmd(clip(video, tmp_path / "c.mp4", "dvtm_Mini4_Pro", lies()[words]))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_states_without_a_fix_and_damaged_ones_are_left_out(video, tmp_path):
    def no_fix(i, gimbal, aircraft, geodetic):
        fields = mini_sample(i, gimbal, aircraft, geodetic * (i > 9))
        return b"\xff" * 40 if i == 30 else fields

    log = read_djmd(clip(video, tmp_path / "c.mp4", "dvtm_Mini4_Pro", no_fix))
    assert np.flatnonzero(np.isnan(log.track.position).any(axis=1)).tolist() == [*range(10), 30]
    assert np.flatnonzero(np.isnan(log.track.gimbal).any(axis=1)).tolist() == [30]
    assert worst_deg(log, camera_truth(flight(COUNT)[0])) < 0.1  # interpolated at the damaged one
    assert camera_poses(log.track, IMAGE_NS).keep == slice(7, COUNT)  # 0.1 s before the first position


def test_clip_that_is_cut_off_gives_what_is_left(video, tmp_path):
    path = clip(video, tmp_path / "c.mp4", "dvtm_Mini4_Pro", mini_sample)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"moov") - 5])  # the index is gone
    with pytest.raises(InputError, match="expected a DJI djmd track in the video, found none"):
        read_djmd(path)


def test_mutated_clips_give_a_result_or_one_clear_line(video, tmp_path, capsys):
    path = clip(video, tmp_path / "c.mp4", "dvtm_Mini4_Pro", mini_sample)
    whole, rng, used = path.read_bytes(), random.Random(7), 0
    tail = whole.rindex(b"mdat") - 4  # most of a copy's damage shall hit the telemetry and the index
    for i in range(60):
        path.write_bytes(damaged_boxes(whole, rng) if i % 2 else whole[:tail] + mutated(whole[tail:], rng))
        assert main(["info", str(path)]) in (0, 2)
        assert all(line.startswith("drocap: ") for line in capsys.readouterr().err.splitlines())
        stamp_ns, refusal = attempt(path)
        assert "\n" not in refusal
        assert (np.diff(stamp_ns) > 0).all()
        used += not refusal
    assert 5 < used < 55


def attempt(path):
    """Stamps of a clip, or the text of its refusal; other exceptions pass."""
    try:
        return read_djmd(path).track.stamp_ns, ""
    except InputError as error:
        return np.zeros(0), str(error)


def test_reconstruct_uses_the_track_by_itself(video, tmp_path, monkeypatch, caplog, capsys):
    # The networks are not what this tests.
    seen = simulate_capture(COUNT / 30, 30, seed=2, start_ns=0).tracks
    seen = Tracks(seen.keypoints[:10], seen.joints, IMAGE_NS[:10], (1280, 720))
    monkeypatch.setattr("drocap_ros.pipeline.read_input", lambda *_, **__: (seen, {}))
    monkeypatch.setattr("drocap_ros.pipeline.needs_networks", lambda *_: False)

    def reconstructed(sample, *words):
        path = clip(video, tmp_path / "c.mp4", "dvtm_Mini4_Pro", sample)
        options = ["--out", str(tmp_path / "out"), "--quiet", "--no-report", "--method", "initial"]
        assert main(["reconstruct", str(path), *options, *words]) == 0
        return load_motion(tmp_path / "out" / "motion.npz"), load_tracks(tmp_path / "out" / "tracks.npz")

    motion, tracks = reconstructed(mini_sample)
    assert motion.frame == "world"
    assert np.rad2deg(angle_between(tracks.camera_rotation, camera_truth(flight(10)[0]))).max() < 0.05
    assert tracks.camera_matrix[0, 0] == pytest.approx(1280 * 24 / 34.61, rel=1e-3)
    assert "full sensor width assumed" in motion.meta["telemetry"]["lens"]
    assert "DJI djmd track (Mini 4 Pro); time offset 0.00 s" in caplog.text
    motion, tracks = reconstructed(mini_sample, "--telemetry", "none")
    assert (motion.frame, tracks.camera_rotation) == ("camera", None)
    motion, _ = reconstructed(lies()["zeros throughout"])
    assert motion.frame == "camera"
    assert "they were not recorded; --telemetry LOG names another source; the video is used without" in caplog.text
    assert main(["info", str(tmp_path / "c.mp4")]) == 0
    assert "telemetry: not usable" in capsys.readouterr().out


def test_info_shows_model_rates_and_what_is_missing(video, tmp_path, capsys):
    assert main(["info", str(clip(video, tmp_path / "c.mp4", "dvtm_AVATA2", avata_sample))]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "source: DJI djmd track (Avata 2)" in lines
    assert "video track: MPEG-4 (mp4v), 320x180 px, 45 samples, 30.00/s" in lines
    assert "note: no gimbal or camera attitude in the log" in lines
    assert "aircraft attitude 45 100.0% 30.00/s" in lines
    (tmp_path / "v.mp4").write_bytes(video)
    assert main(["info", str(tmp_path / "v.mp4")]) == 0
    assert capsys.readouterr().out.endswith("telemetry: none in the file\n")
    (tmp_path / "v.mp4").write_bytes(video.replace(b"mp4v", b"\x1b[2J"))
    assert main(["info", str(tmp_path / "v.mp4")]) == 0
    assert "?[2J" in capsys.readouterr().out
