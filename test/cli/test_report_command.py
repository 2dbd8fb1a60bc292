"""``drocap report`` as a user runs it, and at the end of ``drocap reconstruct``."""

import dataclasses
import re
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from refusals import refused

from drocap_ros.cli import main
from drocap_ros.motion import load_motion, save_motion
from drocap_ros.report.motion_images import FollowingBox
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture


@pytest.fixture
def folder(person, tmp_path):
    save_motion(tmp_path / "motion.npz", person)
    return tmp_path


def test_the_same_motion_gives_the_same_bytes(folder):
    texts = []
    for _ in range(2):
        assert main(["report", str(folder), "--quiet"]) == 0
        texts.append((folder / "report.html").read_bytes())
    assert texts[0] == texts[1]


def write_video(path, motion, rate_hz):
    width, height = motion.meta.get("images", {}).get("size") or size_around(motion)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, (width, height))
    for _ in motion.stamp_ns:
        writer.write(np.full((height, width, 3), 90, np.uint8))
    writer.release()


def size_around(motion):
    return tuple(int(side) + 20 for side in np.nanmax(motion.keypoints, axis=(0, 1)))


def own_rate_hz(motion):
    return 1e9 / float(np.diff(motion.stamp_ns).mean())


def test_images_of_a_video_beside_the_motion_are_shown(person, folder, capsys):
    save_motion(folder / "motion.npz", dataclasses.replace(person, meta={**person.meta, "input": "clip.avi"}))
    for rate_hz, shown in ((0.0, False), (24.0, False), (own_rate_hz(person), True)):
        if rate_hz:
            write_video(folder / "clip.avi", person, rate_hz)
        assert main(["report", str(folder)]) == 0
        assert ("without images: no video of this motion as" in capsys.readouterr().out) is not shown
        assert bool(images_in(folder / "report.html")) is shown


def test_a_report_keeps_its_images_when_the_video_has_moved(person, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    save_motion(folder / "motion.npz", dataclasses.replace(person, meta={**person.meta, "input": "clip.avi"}))
    write_video(folder / "clip.avi", person, own_rate_hz(person))
    assert main(["report", str(folder)]) == 0
    pictures = images_in(folder / "report.html")
    assert len(pictures) == 60
    (folder / "clip.avi").rename(folder / "elsewhere.avi")
    capsys.readouterr()
    assert main(["report", str(folder)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"kept the images of the report before: no video of this motion as {folder}/clip.avi, ")
    assert images_in(folder / "report.html") == pictures
    other = dataclasses.replace(person, keypoints=person.keypoints + 1.0, meta={**person.meta, "input": "clip.avi"})
    save_motion(folder / "motion.npz", other)
    assert main(["report", str(folder)]) == 0
    assert capsys.readouterr().out.startswith("without images")
    assert images_in(folder / "report.html") == []


def images_in(page):
    return re.findall(r'"(/9j/[^"]*)"', page.read_text())


def test_mp4_shows_the_video_with_the_body_beside_the_body_in_3d(person, folder, capsys):
    save_motion(folder / "motion.npz", dataclasses.replace(person, meta={**person.meta, "input": "clip.avi"}))
    write_video(folder / "clip.avi", person, own_rate_hz(person))
    assert main(["report", str(folder), "--mp4"]) == 0
    assert f"written: {folder}/report.mp4" in capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == ["clip.avi", "motion.npz", "report.html", "report.mp4"]
    video = cv2.VideoCapture(str(folder / "report.mp4"))
    assert int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode() == "h264"
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 60
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(own_rate_hz(person), rel=1e-3)
    frame = 30
    video.set(cv2.CAP_PROP_POS_FRAMES, frame)
    picture = video.read()[1].astype(int)
    # Left: white joints on the grey video, each at its keypoint.
    width = picture.shape[1] - 720
    follow = FollowingBox()
    for row in range(frame + 1):
        x0, y0, x1, y1 = follow(int(person.stamp_ns[row]), person.keypoints[row], size_around(person)[::-1])
    scale = min(width / (x1 - x0), 720 / (y1 - y0))
    middle = 0.5 * np.array([x0 + x1, y0 + y1])
    for x, y in np.round((person.keypoints[frame] - middle) * scale + [width / 2, 360]).astype(int):
        assert picture[y - 1 : y + 2, x - 1 : x + 2].min() > 180
    # Right: the body, 2.24 m of the world in 720 px; its left side is blue, and here in front of the red one.
    blue, _, red = np.moveaxis(picture[:, width:], -1, 0)
    left = [place for place, name in enumerate(person.joints) if name.startswith("l")]
    tall_m = np.ptp(person.joints3d[frame, left, 2])
    rows = np.flatnonzero((blue - red > 60).any(axis=1))
    assert np.ptp(rows) == pytest.approx(tall_m * 720 / 2.24, rel=0.2)
    assert (red - blue > 60).sum() > 1000


@pytest.mark.parametrize("version", [None, "16.0.1"])
def test_mp4_without_pyav_or_images_says_what_to_do(person, folder, capsys, monkeypatch, version):
    refused(["report", folder, "--mp4"], folder, capsys, "name it: --video FILE")
    write_video(folder / "clip.avi", person, own_rate_hz(person))
    monkeypatch.setitem(sys.modules, "av", version and SimpleNamespace(__version__=version))
    words = ["report", folder, "--mp4", "--video", folder / "clip.avi"]
    refused(words, folder, capsys, '-m pip install "av>=17.1"')


def test_what_cannot_be_shown_is_refused(person, folder, capsys):
    (folder / "text.npz").write_text("no archive")
    nothing = dataclasses.replace(person, joints3d=np.full_like(person.joints3d, np.nan))
    save_motion(folder / "nothing.npz", nothing)
    refused(["report", folder / "text.npz"], folder, capsys, "expected a readable .npz")
    refused(["report", folder / "none.npz"], folder, capsys, "no such file")
    refused(["report", folder / "nothing.npz"], folder, capsys, "NaN in all of them")
    refused(["report", folder, "--video", folder / "none.mp4"], folder, capsys, "none.mp4")
    refused(["report", folder, "--video", folder / "text.npz"], folder, capsys, "text.npz")


def test_reconstruct_ends_in_a_report(tmp_path, capsys):
    save_tracks(tmp_path / "tracks.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "tracks.npz"), "--out", str(out), "--method", "initial"]
    assert main(command) == 0
    assert "report.html" in capsys.readouterr().out
    assert " ".join(["drocap", *command]) in (out / "report.html").read_text()
    assert load_motion(out / "motion.npz").meta["command"] == " ".join(["drocap", *command])
    bare = tmp_path / "bare"
    assert main([*command[:3], str(bare), *command[4:], "--no-report", "--quiet"]) == 0
    assert not (bare / "report.html").exists()


def test_a_second_reconstruction_keeps_the_images_of_the_report(tmp_path):
    save_tracks(tmp_path / "tracks.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "tracks.npz"), "--out", str(out), "--method", "initial", "--quiet"]
    assert main(command) == 0
    motion = load_motion(out)
    write_video(tmp_path / "clip.avi", motion, own_rate_hz(motion))
    assert main(["report", str(out), "--video", str(tmp_path / "clip.avi"), "--quiet"]) == 0
    pictures = images_in(out / "report.html")
    assert len(pictures) == 15
    assert main(command) == 0
    assert images_in(out / "report.html") == pictures
