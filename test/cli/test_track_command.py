from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rendered_person import rendered_images

from drocap_ros.cli import main
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.sources import Frame
from drocap_ros.report.overlay import OverlayVideo
from drocap_ros.tracks import load_tracks


@pytest.fixture
def models(shared: Path) -> str:
    pytest.importorskip("onnxruntime")
    return str(shared / "models")


def test_track_writes_tracks_and_an_overlay(models, shared, tmp_path, capsys):
    out = tmp_path / "out"
    video = shared / "media" / "pose_squats.mp4"
    assert main(["track", str(video), "--out", str(out), "--models", models, "--overlay"]) == 0
    tracks = load_tracks(out / "tracks.npz")
    assert tracks.keypoints.shape == (65, 15, 2)
    assert np.isfinite(tracks.keypoints).all(axis=(1, 2)).mean() >= 0.95
    np.testing.assert_allclose(np.diff(tracks.stamp_ns), 2e8, atol=1000)
    assert tracks.image_size == (720, 1280)
    assert (out / "overlay.mp4").stat().st_size > 10_000
    assert "the subject in 65 (100.0%)" in capsys.readouterr().out
    points = tracks.background
    assert set(points.frame.tolist()) == set(range(65))
    margin = 0.02 * np.array(tracks.image_size)
    assert ((points.point >= -margin) & (points.point <= np.array(tracks.image_size) + margin)).all()
    # The camera stands still: a point of the scaffold stays where it is.
    longest = np.argmax(np.bincount(points.track))
    way = points.point[points.track == longest]
    assert len(way) > 30
    assert np.ptp(way, axis=0).max() < 1.0


def moving_camera(folder: Path, count: int = 16) -> None:
    """Images of a rendered man before a wall with a pattern, over which the camera pans by 6 px an image."""
    cv2 = pytest.importorskip("cv2")
    folder.mkdir()
    rng = np.random.default_rng(2)
    coarse = rng.normal(120, 30, (60, 90)).clip(0, 255).astype(np.uint8)
    wall = np.repeat(cv2.resize(coarse, (900, 600), interpolation=cv2.INTER_CUBIC)[..., None], 3, axis=2)
    for i, image in enumerate(rendered_images(count)):
        picture = cv2.resize(image, (640, 360))
        picture[:90] = wall[100:190, 60 + 6 * i : 700 + 6 * i]
        cv2.imwrite(str(folder / f"{i:03}.png"), picture)


def test_overlay_shows_the_points_of_the_scene_on_request(tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    moving_camera(tmp_path / "images")
    words = ["track", str(tmp_path / "images"), "--models", "simulation", "--overlay"]
    last = {}
    for option in ((), ("--points",)):
        out = tmp_path / f"out{len(option)}"
        assert main([*words, *option, "--out", str(out)]) == 0
        video = cv2.VideoCapture(str(out / "overlay.mp4"))
        video.set(cv2.CAP_PROP_POS_FRAMES, 15)
        last[option] = video.read()[1].astype(int)
    points = load_tracks(tmp_path / "out1" / "tracks.npz").background
    wall = points.point[(points.frame == 15) & (points.point[:, 1] < 70)]
    assert len(wall) > 10
    x, y = np.round(wall).astype(int).T
    for option, shown in (("--points",), True), ((), False):
        blue, green, red = last[option][y, x].T
        assert ((np.minimum(blue, red) - green > 60).mean() > 0.9) == shown


def test_points_are_shown_by_an_overlay_alone(tmp_path, capsys):
    assert main(["track", str(tmp_path), "--models", "simulation", "--points"]) == 2
    assert "--points: expected --overlay" in capsys.readouterr().err


def test_wait_follows_nobody_after_the_subject(tmp_path, capsys):
    """The first images show one man, the later ones another at another place."""
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "images").mkdir()
    rate_hz = 8.0
    men = rendered_images(10, rate_hz), [np.fliplr(image) for image in rendered_images(24, rate_hz, seed=3)]
    empty = [np.full_like(men[0][0], 120)] * 60  # longer than a subject is waited for
    for number, image in enumerate([*men[0], *empty, *men[1]]):
        cv2.imwrite(str(tmp_path / "images" / f"{number:04}.jpg"), cv2.resize(image, (640, 360)))
    (tmp_path / "config.yaml").write_text(f"image_ingest:\n  folder_rate_hz: {rate_hz}\n")
    words = ["track", str(tmp_path / "images"), "--models", "simulation", "--config", str(tmp_path / "config.yaml")]
    persons = {}
    for option in ((), ("--wait",)):
        out = tmp_path / f"out{len(option)}"
        assert main([*words, *option, "--out", str(out)]) == 0
        persons[option] = sorted(path.name for path in out.glob("*.npz"))
    assert persons["--wait",] == ["tracks.npz"]
    assert len(persons[()]) == 2


def test_numbers_of_persons_are_those_of_the_whole_recording(tmp_path, capsys):
    """One man in the first two seconds, another in the last ones."""
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "images").mkdir()
    rate_hz = 5.0
    men = rendered_images(10, rate_hz), [np.fliplr(image) for image in rendered_images(12, rate_hz, seed=3)]
    empty = [np.full_like(men[0][0], 120)] * 12
    for number, image in enumerate([*men[0], *empty, *men[1]]):
        cv2.imwrite(str(tmp_path / "images" / f"{number:04}.jpg"), cv2.resize(image, (640, 360)))
    (tmp_path / "config.yaml").write_text(f"image_ingest:\n  folder_rate_hz: {rate_hz}\n")
    words = ["track", str(tmp_path / "images"), "--models", "simulation", "--config", str(tmp_path / "config.yaml")]
    words += ["--out", str(tmp_path / "out")]
    listed = {}
    for part in ((), ("--start", "4"), ("--end", "2")):
        assert main([*words, "--list", *part]) == 0
        listed[part] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("person")]
    assert [line[:9] for line in listed[()]] == ["person 1:", "person 2:"]
    assert listed["--start", "4"] == listed[()][1:]
    assert [line[:9] for line in listed["--end", "2"]] == ["person 1:"]
    assert main([*words, "--start", "4", "--subject", "2"]) == 0
    assert len(load_tracks(tmp_path / "out" / "tracks.npz")) == 14
    assert main([*words, "--start", "4", "--subject", "1"]) == 2
    assert "--subject 1: expected 2 to 2; `drocap track --list`" in capsys.readouterr().err
    assert main([*words, "--start", "2.4", "--end", "3.6", "--list"]) == 2
    assert "expected a person from --start to --end, found none" in capsys.readouterr().err


def test_person_who_leaves_the_picture_and_comes_back_is_one_file_and_a_word(models, shared, tmp_path, capsys):
    """A real drone's picture: another man stays in view, and crosses him later."""
    out = tmp_path / "out"
    aerial = shared / "aerial"
    assert main(["track", str(aerial / "person9.mp4"), "--out", str(out), "--models", models]) == 0
    keypoints = load_tracks(out / "tracks.npz").keypoints
    box = np.load(aerial / "person9.npz")["box"][: len(keypoints)]
    margin = 0.15 * box[:, 2:].max(axis=1, keepdims=True)
    low, high = (box[:, :2] - margin)[:, None], (box[:, :2] + box[:, 2:] + margin)[:, None]
    seen = np.isfinite(keypoints).all(axis=2)
    inside = seen & (keypoints >= low).all(axis=2) & (keypoints <= high).all(axis=2)
    right = inside.sum(axis=1) > 0.5 * seen.sum(axis=1)
    there, found = np.isfinite(box).all(axis=1), seen.any(axis=1)
    assert (right & there).sum() >= 0.9 * there.sum()
    assert not (found & there & ~right).any()
    text = capsys.readouterr().out
    assert "person 1 left the picture" in text
    assert "person 1 is found again" in text


def test_recording_without_a_person_ends_with_status_2(models, tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((200, 300, 3), 90, np.uint8))
    assert main(["track", str(tmp_path / "a.png"), "--out", str(tmp_path / "out"), "--models", models]) == 2
    assert "expected a person in view, found none" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("parameter", ["subject: tallest", "pose_model: nothing", "detector: tinypose_256x192"])
def test_unusable_networks_end_with_status_2(models, shared, tmp_path, capsys, parameter):
    image = str(shared / "media" / "skier.jpg")
    (tmp_path / "config.yaml").write_text(f"pose_estimator:\n  {parameter}\n")
    words = ["track", image, "--out", str(tmp_path / "out"), "--models", models]
    assert main([*words, "--config", str(tmp_path / "config.yaml")]) == 2
    assert "expected" in capsys.readouterr().err


def test_models_list_and_check(models, shared, tmp_path, capsys, monkeypatch):
    assert main(["models", "list", "--models", models]) == 0
    listed = capsys.readouterr().out
    for part in ("rtmdet-nano", "Apache-2.0", "tinypose_256x192.onnx", "heatmap, 192x256, coco17", "rtmdet-maps"):
        assert part in listed
    drawing = tmp_path / "drawn.png"
    image = str(shared / "media" / "skier.jpg")
    assert main(["models", "check", image, "--models", models, "--out", str(drawing)]) == 0
    assert "lwrist" in capsys.readouterr().out
    assert drawing.stat().st_size > 10_000
    monkeypatch.chdir(tmp_path)
    assert main(["models", "check", image, "--models", str(Path(models).resolve())]) == 0
    assert (tmp_path / "skier_check.png").read_bytes() == drawing.read_bytes()
    assert main(["models", "check", "--models", models]) == 0


def test_models_commands_refuse_unknown_folders_and_names(tmp_path, capsys):
    assert main(["models", "list", "--models", str(tmp_path / "nowhere")]) == 2
    assert main(["models", "check", "--models", str(tmp_path)]) == 2
    assert main(["models", "fetch", "resnet", "--models", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "expected one of rtmdet-nano" in err
    assert err.count("\n") == 3


def test_a_full_disk_is_named_and_leaves_no_video(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "images").mkdir()
    for number, image in enumerate(rendered_images(4)):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.jpg"), image)
    words = ["track", tmp_path / "images", "--models", "simulation", "--overlay", "--out", tmp_path / "out"]
    done = subprocess.run(
        [sys.executable, "-B", "-m", "drocap_ros.cli", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192)),
    )
    assert done.returncode == 1
    assert "space" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_overlay_is_named_and_h264(tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "images").mkdir()
    for number, image in enumerate(rendered_images(4)):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.jpg"), image)
    out = tmp_path / "out"
    words = ["track", str(tmp_path / "images"), "--models", "simulation", "--overlay", "--out", str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert said.endswith(f"written: {out}/tracks.npz, overlay.mp4\n")
    video = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode() == "h264"
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4


def test_overlay_has_the_rate_of_the_video_not_of_its_first_two_images(tmp_path):
    cv2 = pytest.importorskip("cv2")
    with OverlayVideo(tmp_path / "overlay.mp4", 20.0) as overlay:
        for stamp in (0, 100_000_000, 150_000_000):
            overlay.add(Frame(stamp, np.zeros((48, 64, 3), np.uint8)), [PoseObservation(stamp, 0, (64, 48))])
    assert cv2.VideoCapture(str(tmp_path / "overlay.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)


def test_terminated_command_leaves_nothing(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "images").mkdir()
    images = rendered_images(8)
    for number in range(200):
        cv2.imwrite(str(tmp_path / "images" / f"{number:03}.jpg"), images[number % 8])
    words = ["track", tmp_path / "images", "--models", "simulation", "--overlay", "--out", tmp_path / "out"]
    process = subprocess.Popen([sys.executable, "-m", "drocap_ros.cli", *map(str, words)], stderr=subprocess.PIPE)
    end = time.monotonic() + 300
    while not list(tmp_path.glob(".out.*/overlay.mp4")) and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=300)[1].decode()
    assert process.returncode == 130
    assert said.endswith("drocap: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["images"]
