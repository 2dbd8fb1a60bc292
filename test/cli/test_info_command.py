import argparse
import os
import re

import numpy as np
import pytest
from refusals import refused

from drocap_ros.cli import info, main
from drocap_ros.errors import InputError
from drocap_ros.motion import Motion, save_motion
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import save_tracks


def run(path):
    parser = argparse.ArgumentParser()
    info.add_parser(parser.add_subparsers())
    args = parser.parse_args(["info", str(path)])
    return args.run(args)


def test_info_of_a_session_lists_topics_counts_and_rates(pose_session, capture, capsys):
    assert run(pose_session) == 0
    out, err = capsys.readouterr()
    assert "messages: 120" in out
    assert "duration: 3.967 s" in out
    assert "start: 2023-11-14 22:13:20 UTC" in out
    (line,) = [line for line in out.splitlines() if line.startswith("/drocap/pose2d")]
    assert line.split() == ["/drocap/pose2d", "drocap_ros/msg/Pose2D", "120", "30.00", "Hz"]
    assert err == ""


def test_truncated_session_warns_on_stderr(pose_session, capsys):
    path = pose_session / "session_0.mcap"
    path.write_bytes(path.read_bytes()[:-500])
    assert run(path) == 0
    out, err = capsys.readouterr()
    assert "/drocap/pose2d" in out
    assert err.startswith("drocap: warning: session_0.mcap: cut off")


def test_info_of_tracks_and_motion_lists_arrays_and_rates(tmp_path, capture, capsys):
    begin = int(capture.tracks.stamp_ns[0])
    save_tracks(tmp_path / "tracks.npz", capture.tracks, [(begin + 1_500_000_000, "person 1 is lost from view")])
    assert run(tmp_path / "tracks.npz") == 0
    out = capsys.readouterr().out
    assert "the person may change: 1.5 s: person 1 is lost from view" in out
    assert "kind: tracks" in out
    assert "frames: 120" in out
    assert "duration: 3.967 s, 30.00 frames/s" in out
    assert any(line.split() == ["keypoints", "float64", "120", "x", "15", "x", "2"] for line in out.splitlines())
    tracks = capture.tracks
    save_motion(
        tmp_path / "motion.npz",
        Motion(
            joints3d=capture.joints3d_world, joints=BODY_15.joints, parents=BODY_15.parents, stamp_ns=tracks.stamp_ns,
            frame="world", metric=False, scale_source="assumed_height", camera_rotation=tracks.camera_rotation,
            confidence=tracks.confidence, keypoints=tracks.keypoints, reprojection_px=np.zeros((120, 15)),
            meta={"method": "ba", "git_revision": "72e4e0d", "parameters": {"adjuster": {"gamma": 1.0}}},
        ),
    )  # fmt: skip
    assert run(tmp_path / "motion.npz") == 0
    out = capsys.readouterr().out
    assert "kind: motion" in out
    assert "scale: assumed, from assumed height" in out
    assert re.search(r"median flexion: knees \d+ and \d+, hips \d+ and \d+, elbows \d+ and \d+ degrees", out)
    assert "method: ba" in out
    assert "git_revision: 72e4e0d" in out
    assert main(["info", "--metadata", str(tmp_path)]) == 0
    assert '"gamma": 1.0' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"metric": np.array([True, False])}, "metric: expected one truth value"),
        ({"metric": np.array("no")}, "metric: expected one truth value"),
        ({"stamp_ns": np.array([-9, 9]) * 10**18}, "within a year"),
        ({"stamp_ns": np.array([1, 2], np.uint64) + np.uint64(2**63)}, "expected int64"),
        ({"stamp_ns": np.array([0.0, 1.0])}, "expected int64"),
        ({"stamp_ns": np.array([5, 5])}, "strictly increasing"),
    ],
)
def test_a_motion_of_impossible_values_is_refused(tmp_path, capsys, change, words):
    arrays = {
        "joints3d": np.zeros((2, 15, 3)), "joints": BODY_15.joints, "parents": BODY_15.parents, "frame": "camera",
        "stamp_ns": np.arange(2) * 40_000_000, "metric": False, "scale_source": "",
        "camera_rotation": np.zeros((2, 3, 3)),
        "confidence": np.ones((2, 15)), "keypoints": np.ones((2, 15, 2)), "reprojection_px": np.ones((2, 15)),
        "meta": "{}",
    }  # fmt: skip
    np.savez(tmp_path / "motion.npz", **arrays)
    assert main(["info", str(tmp_path / "motion.npz")]) == 0
    np.savez(tmp_path / "motion.npz", **{**arrays, **change})
    refused(["info", tmp_path / "motion.npz"], tmp_path, capsys, words)


def test_files_of_unknown_kinds_are_refused_in_one_line(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "x.mp4").write_bytes(b"0000")
    os.mkfifo(tmp_path / "pipe.npz")
    for name in ("missing", "other.npz", "text.npz", "x.mp4", "pipe.npz"):
        with pytest.raises(InputError, match="expected") as error:
            run(tmp_path / name)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "words", ["replay x.mcap", "replay x.bag", "view x.npz --save y.rrd", "reconstruct x.npz --out y", "recover x.mcap"]
)
def test_a_named_pipe_is_refused_and_not_waited_for(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    command, name, *more = words.split()
    os.mkfifo(name)
    assert main([command, name, *more]) == 2
    assert re.search("found (a pipe or device|another kind of file)", capsys.readouterr().err)
