"""Wrong usage: one line that says what was found and what to do, status 2, nothing written."""

import os

import numpy as np
import pytest
from orders_of_points import in_order, views
from refusals import refused

from drocap_ros.motion import save_motion
from drocap_ros.skeleton import COCO_17
from drocap_ros.tracks import Tracks, save_tracks

FILES = {
    "notes.txt": b"a man walks\n" * 30, "skier.jpg": b"\xff\xd8\xff\xe0" + bytes(300), "empty.mp4": b"",
    "rig.fbx": b"Kaydara FBX Binary  \x00\x1a\x00" + bytes(100), "bag.db3.zstd": b"\x28\xb5\x2f\xfd" + bytes(80),
    "clip.mp4": b"\x00\x00\x00\x18ftypmp42" + bytes(400), "table.csv": b"a,b\n1,2\n", "one.mcap": b"\x89MCAP0\r\n",
    "odd.json": b'{"a": [1, 2]}', "log.tlog": bytes(500), "x.srt": b"1\n", "lens.yaml": b"a: 1\n",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "nothing").mkdir()
    np.savez(tmp_path / "other.npz", a=np.zeros(3), b=np.zeros(3))
    points = np.random.default_rng(0).uniform(0, 600, (30, 17, 2))
    arrays = {"stamp_ns": np.arange(30) * 10**8, "image_size": (640, 480), "joints": COCO_17.joints}
    np.savez(tmp_path / "tracks.npz", keypoints=points, **arrays)
    np.savez(tmp_path / "shares.npz", keypoints=points / 640, **arrays)
    np.savez(tmp_path / "solid.npz", keypoints=np.random.default_rng(0).normal(0, 1, (30, 17, 3)), **arrays)
    np.save(tmp_path / "k.npy", points)
    np.save(tmp_path / "flat.npy", np.zeros((30, 17)))
    np.save(tmp_path / "middle.npy", points / 300 - 1)
    np.savez(tmp_path / "mocap.npz", X=np.zeros((5, 17, 3)), joints=COCO_17.joints)
    return tmp_path


@pytest.mark.parametrize(("words", "said"), [
    ("reconstruct missing.mp4", "found no such file or folder"),
    ("reconstruct https://a.example/clip.mp4", "https://a.example/clip.mp4: expected"),
    ("info https://a.example/clip.mp4", "download the file and name it"),
    ("info rtsp://10.0.0.2:8554/live", "rtsp://10.0.0.2:8554/live: expected"),
    ("reconstruct notes.txt --models simulation", "found text"),
    ("reconstruct empty.mp4 --models simulation", "found 0 bytes"),
    ("reconstruct clip.mp4 --models simulation", "without a readable header or index"),
    ("reconstruct rig.fbx --models simulation", "expected a video file"),
    ("reconstruct bag.db3.zstd --models simulation", "unpack it: zstd -d"),
    ("reconstruct nothing --models simulation", "expected a folder with images"),
    ("reconstruct other.npz", "expected 2D keypoints of a person, found none"),
    ("reconstruct shares.npz", "multiply normalised ones"),
    ("reconstruct solid.npz", "as of 3D poses"),
    ("reconstruct flat.npy", "expected 2D keypoints of a person, found none"),
    ("reconstruct middle.npy", "about a middle"),
    ("reconstruct k.npy", "--order NAME, of coco17, h36m17"),
    ("reconstruct k.npy --order", "expected one argument"),
    ("reconstruct k.npy --order openpose", "expected an order of 17 points"),
    ("reconstruct tracks.npz --order h37m", "expected an order of 17 points"),
    ("reconstruct clip.mp4 --order coco17", "expected a file of 2D keypoints"),
    ("reconstruct k.npy --image-size 640", "expected width and height"),
    ("reconstruct k.npy --rate fast", "expected images per second"),
    ("reconstruct odd.json", "expected 2D keypoints of a person, found none"),
    ("reconstruct table.csv", "found a telemetry log"),
    ("reconstruct log.tlog", "found a telemetry log"),
    ("reconstruct tracks.npz --telemetry log.tlog", "expected a video"),
    ("reconstruct clip.mp4 --telemetry missing.ulg", "expected a log, found no such file"),
    ("reconstruct clip.mp4 --telemetry log.tlog --models simulation", "expected a MAVLink telemetry log"),
    ("reconstruct clip.mp4 --telemetry x.srt#2 --models simulation", "expected no choice after this log's name"),
    ("reconstruct clip.mp4 --start -1", "--start"), ("reconstruct clip.mp4 --start 5 --end 3", "--end"),
    ("reconstruct clip.mp4 --time-offset 3", "expected --telemetry LOG"),
    ("reconstruct tracks.npz --height 17", "expected 0.5 to 2.5"),
    ("reconstruct tracks.npz --fov 5000", "expected 5 to"),
    ("reconstruct tracks.npz --calibration lens.yaml", "expected image_width"),
    ("reconstruct tracks.npz --subject 2", "found 2D tracks of one person"),
    ("reconstruct tracks.npz --topic 1", "expected images"), ("reconstruct tracks.npz --metod ba", "--method"),
    ("reconstruct tracks.npz --method baa", "invalid choice"),
    ("reconstruct tracks.npz --evidence other.npz", "expected"),
    ("reconstruct tracks.npz tracks.npz", "add --together"),
    ("reconstruct tracks.npz --together", "expected two INPUTs"),
    ("track k.npy", "`drocap reconstruct"), ("track odd.json", "found 2D keypoints"), ("track tracks.npz", "expected"),
    ("track clip.mp4 --topic 1 --models simulation", "without a readable header"),
    ("track nothing --topic /a --models simulation", "leave the option out"),
    ("info notes.txt", "found text"), ("info skier.jpg", "found an image"), ("info clip.mp4", "expected a video file"),
    ("track one.mcap --models simulation", "found no topics"), ("info nothing", "found a folder without one"),
    ("info x.srt", "expected 1 to"), ("info x.srt.gz", "no such file"), ("info mocap.npz", "expected"),
    ("report skier.jpg", "found an image"), ("report other.npz", "found an archive of other arrays (a, b)"),
    ("export other.npz --to bvh", "expected a motion, found"), ("export notes.txt --to bvh", "found text"),
    ("evaluate compare notes.txt notes.txt", "found text"), ("view skier.jpg", "expected"),
    ("recover skier.jpg", "found another kind of file"), ("batch missing*.mp4 --out out", "found none"),
])  # fmt: skip
def test_wrong_usage_is_one_line_and_status_2(folder, capsys, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    refused(words.split(), folder, capsys, said)


@pytest.fixture
def results(folder, walker):
    """A motion in ``m``, tracks of a body, and names that need care."""
    (folder / "m").mkdir()
    save_motion(folder / "m" / "motion.npz", walker)
    body = in_order(views(seconds=1.0)[2], "coco17", np.random.default_rng(0))
    tracks = Tracks(body, COCO_17.joints, np.arange(len(body)) * 33_333_333, (1280, 720))
    for name in ("body.npz", "-dash.npz", "wälk ünï.npz"):
        save_tracks(folder / name, tracks)
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    return folder


@pytest.mark.parametrize(("words", "said"), [
    ("info loop", "found no such file"), ("info pipe", "found a pipe or device"), ("info notes.txt/x", "found no such"),
    ("info body.npz --metadata", "expected a motion, found 2D tracks"), ("info nothing --metadata", "without one"),
    ("info -x", "SESSION"), ("info m body.npz", "unrecognized arguments: body.npz"),
    ("track clip.mp4 --threads 0", "expected 1 to 256"), ("track clip.mp4 --threads 1.5", "expected 1 to 256"),
    ("track clip.mp4 --start nan", "--start nan"), ("track clip.mp4 --end -2", "--end -2"),
    ("track clip.mp4 --start inf --models nowhere", "--start inf"), ("track clip.mp4 --subject middle", "got 'middle'"),
    ("track clip.mp4 --subject nan,0,1,1", "expected x_min,y_min,x_max,y_max"),
    ("track clip.mp4 --points", "--overlay"),
    ("track clip.mp4 --list --all", "leave it out"), ("track m", "found the folder of a motion"),
    ("track m/motion.npz --models simulation", "drocap info m/motion.npz"),
    ("track clip.mp4 --out notes.txt", "found a file"), ("track clip.mp4 --out notes.txt/x", "expected a writable"),
    ("track clip.mp4 --config lens.yaml", "unknown component 'a'"), ("track clip.mp4 --config nowhere.yaml", "No such"),
    ("reconstruct", "required: INPUT; see"), ("reconstruct -dash.npz", "is named ./-dash.npz"),
    ("reconstruct s3://bucket/a.mp4", "s3://bucket/a.mp4: expected"), ("reconstruct http://", "expected"),
    ("reconstruct body.npz --height 1,80", "--height"), ("reconstruct body.npz --height nan", "expected 0.5 to 2.5"),
    ("reconstruct body.npz --fov nan", "expected 5 to"), ("reconstruct body.npz --focal inf", "expected 10 to"),
    ("reconstruct body.npz --fov 60 --focal 900", "not allowed with"), ("reconstruct body.npz --rate nan", "--rate"),
    ("reconstruct body.npz --calibration nothing", "Is a directory"),
    ("reconstruct body.npz --image-size 0x0", "1920x"),
    ("reconstruct body.npz --dictionary nowhere.npz", "expected a pose dictionary, found no file"),
    ("reconstruct body.npz --redetect", "expected a recording with images"), ("reconstruct body.npz --all", "several"),
    ("reconstruct body.npz --evidence nothing", "expected a readable .npz"),
    ("reconstruct m/motion.npz", "found a motion"),
    ("reconstruct body.npz --corrections skier.jpg", "expected YAML"), ("reconstruct body.npz --start 100", "within"),
    ("reconstruct body.npz --camera-pitch nan", "-90 to 90"),
    ("reconstruct body.npz --level --camera-roll 4", "neither"),
    ("reconstruct body.npz --mount-pitch 5", "expected --telemetry"), ("reconstruct body.npz --method live", "pose2d"),
    ("reconstruct body.npz --out /proc/x", "cannot be written"), ("reconstruct body.npz --threads many", "1 to 256"),
    ("reconstruct body.npz body.npz --together", "the same one twice"),
    ("reconstruct a.jpg b.jpg", "name their folder"),
    ("export m", "--to"),
    ("export m --to BVH", "invalid choice"), ("export m --to bvh --out nothing", "found a folder"),
    ("export m --to bvh --out m/motion.npz", "own input"), ("export m --to bvh --out x.fbx", "ends in .bvh"),
    ("export m --to csv --names mixamo", "leave it out"), ("export m --to bvh --smooth nan", "cut-off"),
    ("export m --to bvh --smooth -3", "cut-off"), ("export nothing --to bvh", "drocap reconstruct nothing"),
    ("evaluate compare m", "TRUTH"), ("evaluate compare m nothing", "no such file"),
    ("evaluate compare m m --time-offset soon", "expected seconds or find"),
    ("evaluate compare m m --time-offset nan", "expected seconds or find"), ("evaluate table nothing", "found none"),
    ("evaluate compare m m --time-offset 1e9", "within the truth's time"),
    ("evaluate table notes.txt", "no such folder"),
    ("report m --video skier.jpg", "do not decode"), ("report m --out nothing", "found a folder"),
    ("view nothing", "name the folder of a motion"), ("recover nothing", "found none or others"),
    ("batch body.npz --out out --jobs 0", "at least 1"), ("batch body.npz --out notes.txt", "found a file"),
    ("batch body.npz --out out --height 17", "expected 0.5 to 2.5"), ("batch nothing --out out", "found none"),
    ("batch body.npz --out out --start -1", "--start -1"), ("batch body.npz --out out --camera-pitch 91", "-90 to 90"),
    ("batch body.npz --out out --fov 0 --end 3", "expected 5 to"), ("batch notes.txt --out out", "notes.txt:1"),
    ("models list --models nowhere", "found no such folder"), ("models fetch nosuch", "expected one of"),
    ("calibrate nothing", "found none"), ("demo --seconds nan", "expected 2 to"),
    ("demo --seed -1", "expected an integer"),
    ("live", "expected --config or --source"), ("live --config skier.jpg", "expected YAML"),
    ("app notes.txt", "a folder"),
    ("top --namespace 9x", "expected names of letters"), ("nosuch", "invalid choice"), ("--completion tcsh", "tcsh"),
])  # fmt: skip
def test_more_wrong_usage_is_one_line_and_status_2(results, capsys, monkeypatch, words, said):
    monkeypatch.chdir(results)
    refused(words.split(), results, capsys, said)


@pytest.mark.parametrize("words", [
    ["info", "wälk.npz"], ["info", "a name\nof two lines"], ["reconstruct", "wälk ünï.npz", "--height", "9,0"],
    ["reconstruct", ""], ["export", "m", "--to", "bvh", "--out", ""], ["reconstruct", "body.npz", "--out="],
    ["track", "wälk ünï.npz"], ["evaluate", "compare", "m", "wälk ünï.npz"], ["batch", "wälk*.mp4", "--out", "out dir"],
])  # fmt: skip
def test_names_of_any_letters_are_refused_in_one_line(results, capsys, monkeypatch, words):
    monkeypatch.chdir(results)
    refused(words, results, capsys, "")
