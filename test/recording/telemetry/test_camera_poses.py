import numpy as np
import pytest
from angles import angle_between
from telemetry_logs import dji_subtitle, heading_at, srt_text, turning_log, wrapped

from drocap_ros.cli import main
from drocap_ros.flight.vehicle import orientation_to_ros, quaternion_from_euler
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.motion import load_motion
from drocap_ros.recording.telemetry.log import camera_poses
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.tracks import save_tracks


def test_camera_attitude_is_interpolated_at_each_image(tmp_path, invented_flight):
    t, _, geodetic, mount = invented_flight
    (tmp_path / "x.srt").write_text(
        srt_text(t.round(3), [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    log = read_telemetry(tmp_path / "x.srt")
    at = np.arange(0.1, 7.8, 1 / 29.97)
    poses = camera_poses(log.track, np.round(at * 1e9).astype(np.int64))
    exact = np.stack([0 * at, -0.5 + 0.1 * np.sin(at), 0.4 * at - 0.9], axis=1)
    flu_to_enu = orientation_to_ros(quaternion_from_euler(*exact.T).T)
    truth = np.swapaxes(matrix_from_quaternion(flu_to_enu), 1, 2)
    optical_from_flu = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert np.rad2deg(angle_between(poses.rotation, optical_from_flu @ truth)).max() < 0.02


def test_fixed_camera_with_given_pitch_turns_with_the_vehicle():
    log = turning_log(10)
    stamp_ns = log.track.stamp_ns[10:50]
    assert camera_poses(log.track, stamp_ns).rotation is None
    rotation = camera_poses(log.track, stamp_ns, mount_pitch_deg=-30.0).rotation
    forward = np.swapaxes(rotation, 1, 2)[:, :, 2]
    assert np.rad2deg(np.arcsin(forward[:, 2])) == pytest.approx(-30.0)
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    assert wrapped(heading - heading_at((stamp_ns - 5e9) * 1e-9)).max() < 1e-6


def reconstruct(*words):
    return main(["reconstruct", *map(str, words)])


def test_video_with_subtitles_gives_a_motion_in_the_world(shared, tmp_path, invented_flight, capture, caplog, capsys):
    video, models = shared / "media" / "pose_1.mp4", shared / "models"
    t, _, geodetic, mount = invented_flight
    (tmp_path / "v.srt").write_text(
        srt_text(t.round(3), [dji_subtitle(i, g, m) for i, (g, m) in enumerate(zip(geodetic, mount, strict=True))])
    )
    options = ("--models", models, "--out", tmp_path / "out", "--quiet", "--method", "initial")
    assert reconstruct(video, "--telemetry", tmp_path / "v.srt", *options) == 0
    motion = load_motion(tmp_path / "out" / "motion.npz")
    assert motion.frame == "world"
    assert len(motion.joints3d) == 120
    assert "no vehicle attitude in the log" in caplog.text
    assert "time offset 0.00 s" in caplog.text
    assert reconstruct(video, "--time-offset", "1", *options) == 2
    assert "expected --telemetry" in capsys.readouterr().err
    save_tracks(tmp_path / "t.npz", capture.tracks)
    assert reconstruct(tmp_path / "t.npz", "--telemetry", tmp_path / "v.srt", *options) == 2
    assert "expected a video file, found" in capsys.readouterr().err
