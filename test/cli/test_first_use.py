"""What a new user tries: files in the wrong place, parts of a recording, other people's joint names."""

import dataclasses
import re

import numpy as np
import pytest
from rendered_person import rendered_images
from telemetry_logs import dji_subtitle, srt_text

from drocap_ros.cli import main
from drocap_ros.motion import load_motion, save_motion
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.skeleton import BODY_15, COCO_17, LIMB_JOINTS
from drocap_ros.tracks import Tracks, load_tracks, save_tracks
from lab.simulation.capture import simulate_capture

cv2 = pytest.importorskip("cv2")

QUICK = ("--method", "initial", "--no-report", "--quiet")


def run(*arguments):
    return main([str(a) for a in arguments])


def refused(capsys, *arguments):
    capsys.readouterr()
    assert run(*arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


@pytest.fixture(scope="module")
def capture():
    return simulate_capture(2.0, 15.0, seed=1)


@pytest.fixture(scope="module")
def made(capture, tmp_path_factory):
    """Folder with tracks.npz and walk/, their motion."""
    folder = tmp_path_factory.mktemp("made")
    save_tracks(folder / "tracks.npz", capture.tracks)
    assert run("reconstruct", folder / "tracks.npz", "--out", folder / "walk", *QUICK) == 0
    return folder


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """Folder of eight images at 30 per second with two persons, the same one twice, side by side."""
    folder = tmp_path_factory.mktemp("crowd")
    for number, image in enumerate(rendered_images(8)):
        person = cv2.resize(image[:, 320:960], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{number}.png"), np.hstack([person, person]))
    return folder


def test_a_file_of_another_kind_is_refused_with_its_use(made, capsys, tmp_path):
    walk, tracks = made / "walk", made / "tracks.npz"
    assert "report" in refused(capsys, "reconstruct", walk)
    assert f"drocap reconstruct {walk}/tracks.npz" in refused(capsys, "reconstruct", walk)
    assert "found a motion" in refused(capsys, "reconstruct", walk / "motion.npz")
    for words in (("export", tracks, "--to", "bvh"), ("report", tracks), ("evaluate", "compare", tracks, walk)):
        assert f"drocap reconstruct {tracks}" in refused(capsys, *words)
    assert "drocap reconstruct" in refused(capsys, "report", tmp_path)
    (tmp_path / "flight.tlog").write_bytes(b"0")
    for command in ("reconstruct", "track"):
        assert "--telemetry" in refused(capsys, command, tmp_path / "flight.tlog")


def test_folder_of_a_motion_is_enough_for_info_and_as_truth(made, capsys):
    assert run("info", made / "walk") == 0
    assert "kind: motion" in capsys.readouterr().out
    assert run("evaluate", "compare", made / "walk", made / "walk") == 0
    assert "| 0.0 |" in capsys.readouterr().out


def test_a_truth_of_the_scored_joints_gives_the_same_error(made, capsys, tmp_path):
    motion = load_motion(made / "walk" / "motion.npz")
    use = [BODY_15.index(name) for name in LIMB_JOINTS]
    parts = {n: getattr(motion, n)[:, use] for n in ("joints3d", "confidence", "keypoints", "reprojection_px")}
    shaken = motion.joints3d + np.random.default_rng(0).normal(scale=0.02, size=motion.joints3d.shape)
    save_motion(tmp_path / "shaken.npz", dataclasses.replace(motion, joints3d=shaken))
    save_motion(
        tmp_path / "truth.npz", dataclasses.replace(motion, **parts, joints=LIMB_JOINTS, parents=(-1, *range(11)))
    )
    rows = []
    for truth in (made / "walk", tmp_path):
        assert run("evaluate", "compare", tmp_path / "shaken.npz", truth) == 0
        rows.append(capsys.readouterr().out.splitlines()[2])
    assert rows[0] == rows[1]
    assert float(rows[0].split("|")[3]) > 5.0


def test_tracks_with_coco_names_give_the_motion_of_the_same_joints(made, capture, tmp_path):
    """Ears and nose on the line through neck and head, so that the map gives neck and head back."""
    place = {f"{side}_{part}": f"{side[0]}{part}" for side in ("left", "right")
             for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")}  # fmt: skip
    keypoints = np.full((len(capture.tracks), 17, 2), np.nan)
    for name, ours in place.items():
        keypoints[:, COCO_17.index(name)] = capture.tracks.keypoints[:, BODY_15.index(ours)]
    chest = keypoints[:, [COCO_17.index(f"{side}_shoulder") for side in ("left", "right")]].mean(axis=1)
    neck = capture.tracks.keypoints[:, BODY_15.index("neck")]
    for ear in ("left_ear", "right_ear"):
        keypoints[:, COCO_17.index(ear)] = chest + 190 / 135 * (neck - chest)
    camel = [re.sub("_(.)", lambda m: m[1].upper(), name) for name in COCO_17.joints]
    t = capture.tracks
    save_tracks(
        tmp_path / "coco.npz",
        Tracks(keypoints, tuple(camel), t.stamp_ns, t.image_size, camera_rotation=t.camera_rotation),
    )
    assert run("reconstruct", tmp_path / "coco.npz", "--out", tmp_path / "out", *QUICK) == 0
    motion = load_motion(tmp_path / "out" / "motion.npz")
    np.testing.assert_allclose(motion.keypoints[:, BODY_15.index("neck")], neck, atol=1e-6)
    np.testing.assert_array_equal(motion.keypoints[:, 1], capture.tracks.keypoints[:, 1])
    assert np.isfinite(motion.joints3d).all()


def test_printed_error_is_the_report_s_and_the_stages_add_up(made, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("reconstruct", made / "tracks.npz", "--out", out, "--method", "initial") == 0
    said = capsys.readouterr().out
    (median,) = re.findall(r"median reprojection error ([\d.]+) px", said)
    assert f"<b>{median}<i>px</i></b><span>median reprojection error" in (out / "report.html").read_text()
    (times,) = re.findall(r"^([\d.]+) s: (.*)$", said, re.MULTILINE)
    stages = [float(s) for s in re.findall(r"([\d.]+) s", times[1])]
    assert sum(stages) == pytest.approx(float(times[0]), abs=0.01 * len(stages))
    assert re.search(r"^quality: (good|fair|doubtful), ", said, re.MULTILINE)


def test_clip_of_tracks_keeps_its_stamps(made, tmp_path, capture, capsys):
    out = tmp_path / "out"
    words = ("reconstruct", made / "tracks.npz", "--out", out, *QUICK)
    assert run(*words, "--start", 0.5, "--end", 1.0) == 0
    at_s = (capture.tracks.stamp_ns - capture.tracks.stamp_ns[0]) * 1e-9
    inside = (at_s >= 0.499) & (at_s <= 1.001)
    motion = load_motion(out / "motion.npz")
    np.testing.assert_array_equal(motion.stamp_ns, capture.tracks.stamp_ns[inside])
    assert motion.meta["clip"] == {"start_s": 0.5, "end_s": 1.0}
    assert "within the recording's" in refused(capsys, *words, "--start", 60)
    assert "0 <= start < end" in refused(capsys, *words, "--start", 1, "--end", 0.5)
    assert "--redetect" in refused(capsys, *words, "--subject", 1)


def test_persons_are_listed_and_chosen_by_number(crowd, tmp_path, capsys, caplog, monkeypatch):
    monkeypatch.setenv("DROCAP_MODELS", "simulation")
    assert run("track", crowd, "--list", "--out", tmp_path) == 0
    said = capsys.readouterr().out
    assert re.findall(r"^person (\d): 0.0", said, re.MULTILINE) == ["1", "2"]
    assert cv2.imread(str(tmp_path / "persons.jpg")).shape == (360, 640, 3)
    for number, low, high in ((1, 0, 320), (2, 320, 640)):
        assert run("track", crowd, "--subject", number, "--out", tmp_path, "--quiet") == 0
        keypoints = load_tracks(tmp_path / "tracks.npz").keypoints
        assert np.isfinite(keypoints).mean() > 0.5
        assert ((keypoints[..., 0] > low) & (keypoints[..., 0] < high))[np.isfinite(keypoints[..., 0])].all()
    slow = tmp_path / "slow"  # at one image per second each one is searched
    slow.mkdir()
    for path in crowd.iterdir():
        (slow / f"{17 * 10**17 + int(path.stem) * 10**9}.png").symlink_to(path)
    assert run("reconstruct", slow, "--out", tmp_path / "out", *QUICK) == 0
    assert f"several persons, one of them is reconstructed; `drocap track {slow} --list`" in caplog.text
    assert "expected 1 to 2" in refused(capsys, "reconstruct", crowd, "--subject", 3, "--out", tmp_path / "out")


def test_report_takes_the_images_of_the_motion_alone(crowd, tmp_path, capsys, monkeypatch):
    """A clip of the images: its own images match by their time, those of other recordings are refused."""
    monkeypatch.setenv("DROCAP_MODELS", "simulation")
    out, video = tmp_path / "out", ("--video", crowd)
    assert run("reconstruct", crowd, "--start", 0.06, "--out", out, *QUICK) == 0
    motion = load_motion(out / "motion.npz")
    assert motion.stamp_ns[0] == pytest.approx(66_666_667, abs=2)
    assert motion.meta["images"] == {"size": [640, 360], "length": 8, "rate_hz": pytest.approx(30.0)}
    assert run("report", out, *video, "--quiet") == 0
    assert (out / "report.html").read_text().count('"/9j/') == 6
    folders = {name: tmp_path / name for name in ("few", "small")}
    for folder in folders.values():
        folder.mkdir()
    for path in crowd.iterdir():
        image = cv2.imread(str(path))
        cv2.imwrite(str(folders["small"] / path.name), image[:180])
        if path.stem in "01234":
            cv2.imwrite(str(folders["few"] / path.name), image)
    assert "8 images, found 5" in refused(capsys, "report", out, "--video", folders["few"])
    assert "640x180" in refused(capsys, "report", out, "--video", folders["small"])
    slow = tmp_path / "slow.mp4"
    writer = cv2.VideoWriter(str(slow), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (640, 360))
    for path in sorted(crowd.iterdir()):
        writer.write(cv2.imread(str(path)))
    writer.release()
    assert "30 images per second, found 10" in refused(capsys, "report", out, "--video", slow)


def test_a_clip_of_a_video_takes_the_telemetry_of_its_own_seconds(crowd, tmp_path, monkeypatch):
    monkeypatch.setenv("DROCAP_MODELS", "simulation")
    writer = cv2.VideoWriter(str(tmp_path / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (640, 360))
    for number in range(8):
        writer.write(cv2.imread(str(crowd / f"{number}.png")))
    writer.release()
    t = np.arange(8) / 30.0
    angles = np.stack([0 * t, 0 * t - 0.5, 2.0 * t], axis=1)
    lines = [dji_subtitle(i, (47.0, 8.0, 500.0 + i), angles[i]) for i in range(8)]
    (tmp_path / "walk.srt").write_text(srt_text(t, lines))
    words = ("--telemetry", tmp_path / "walk.srt", "--start", 0.1)
    assert run("reconstruct", tmp_path / "walk.mp4", *words, "--out", tmp_path / "out", *QUICK) == 0
    forward = load_tracks(tmp_path / "out" / "tracks.npz").camera_rotation[:, 2]
    np.testing.assert_allclose(np.arctan2(forward[:, 0], forward[:, 1]), 2.0 * t[3:], atol=1e-3)


def test_without_networks_one_line_names_the_ways_to_get_them(crowd, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DROCAP_MODELS", str(tmp_path / "models"))
    for command in ("reconstruct", "track"):
        line = refused(capsys, command, crowd, "--out", tmp_path / "out")
        assert "drocap models fetch" in line
        assert "--fetch" in line
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stdin.readline", lambda: "\n")
    assert run("reconstruct", crowd, "--out", tmp_path / "out") == 2
    assert "Download rtmdet-nano and rtmpose-s" in capsys.readouterr().err


def test_nothing_is_fetched_for_a_recording_without_images(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DROCAP_MODELS", str(tmp_path / "models"))
    monkeypatch.setattr("drocap_ros.perception.models.fetch.fetch", lambda *_, **__: pytest.fail("it downloads"))
    SessionWriter(tmp_path / "session").close()
    line = refused(capsys, "reconstruct", tmp_path / "session", "--fetch", "--out", tmp_path / "out")
    assert "expected a topic with images, found no topics" in line


def test_fetch_downloads_into_the_named_folder(crowd, tmp_path, monkeypatch):
    from drocap_ros.perception.load_models import models_folder

    asked = []

    def fetch(model, folder, **_):
        folder.mkdir(exist_ok=True)
        for path in models_folder("simulation").glob("*.*"):
            (folder / path.name).write_bytes(path.read_bytes())
        asked.append(model.name)
        return folder / model.file

    monkeypatch.setattr("drocap_ros.perception.models.fetch.fetch", fetch)
    words = ("--models", tmp_path / "models", "--fetch", "--end", 0.1, "--out", tmp_path / "out", "--quiet")
    assert run("track", crowd, *words) == 0
    assert asked == ["rtmdet-nano", "rtmpose-s"]
    assert len(load_tracks(tmp_path / "out" / "tracks.npz")) == 4
