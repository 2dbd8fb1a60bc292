"""`drocap sample`: a clip and networks out of wheels, with the registry itself where it is reachable."""

import contextlib
import io
import json
import zipfile

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.cli.sample import CLIP
from drocap_ros.errors import InputError
from drocap_ros.motion import load_motion
from drocap_ros.perception.load_models import load_detector
from drocap_ros.perception.models.fetch import FetchError, Package, fetch_member, known_model, sha256_of
from drocap_ros.perception.models.runtime import open_model
from drocap_ros.perception.sources import open_source
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.tracks import load_tracks


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """The pose network as its package has it, which pip of this machine gets."""
    model, file = known_model("blazepose-full"), tmp_path_factory.mktemp("packages") / "pose.tflite"
    try:
        fetch_member(CLIP, "Sports2D/__init__.py", file)
        fetch_member(model.package, model.member, file)
    except FetchError as error:
        pytest.skip(f"no package registry here: {error}")
    return file


@pytest.fixture(scope="module")
def sample(network, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sample") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drocap_ros.cli.reconstruct.run", lambda args: 0)
        assert main(["sample", "--out", str(folder), "--quiet"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["models", "sample.mp4"]
    return folder


@pytest.fixture(scope="module")
def said(sample):
    """What the second run says, which fetches nothing and reconstructs."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setenv("PIP_NO_INDEX", "1")
        assert main(["sample", "--out", str(sample)]) == 0
    return said.getvalue()


@pytest.mark.usefixtures("said")
def test_the_clip_of_a_walking_woman_becomes_a_motion(sample):
    """She is seen from the side, walks to the left through most of the picture, and her feet point there."""
    motion, tracks = load_motion(sample / "motion.npz"), load_tracks(sample / "tracks.npz")
    seen = np.isfinite(motion.joints3d).all(axis=(1, 2))
    assert seen.mean() > 0.95
    body_px = np.ptp(tracks.keypoints[..., 1], axis=1)
    assert np.nanmedian(motion.reprojection_px) < 0.02 * np.nanmedian(body_px)
    place = dict(zip(tracks.joints, tracks.keypoints.swapaxes(0, 1), strict=True))
    pelvis = place["pelvis"][np.isfinite(place["pelvis"]).all(axis=1)]
    assert pelvis[0, 0] > 0.6 * tracks.image_size[0] > 0.25 * tracks.image_size[0] > pelvis[-1, 0]
    toe_left_of_heel = [place[f"{side}toe"][:, 0] < place[f"{side}heel"][:, 0] for side in "rl"]
    assert np.mean(toe_left_of_heel) > 0.8
    assert (sample / "report.html").stat().st_size > 100_000


def test_the_command_names_licences_and_what_it_does(sample, said):
    assert "BSD-3-Clause" in said
    assert "Apache-2.0" in said
    assert f"open {sample}/report.html in a browser" in said
    assert json.loads(np.load(sample / "motion.npz")["meta"].item())["command"].startswith("drocap reconstruct")


def test_the_pose_network_is_the_one_that_opencv_reads(sample, network):
    import cv2

    if not hasattr(cv2.dnn, "readNetFromTFLite"):
        pytest.skip("this OpenCV reads no TensorFlow Lite")
    image = np.random.default_rng(0).random((1, 3, 256, 256), np.float32)
    other = cv2.dnn.readNetFromTFLite(str(network))
    other.setInput(image)
    points = other.forward("Identity").reshape(39, 5)
    ours, space = open_model(sample / "models" / "blazepose-full.tflite")(image.transpose(0, 2, 3, 1))
    nose, right_heel = ours[0, 0, [0, -1], :2] * 256
    np.testing.assert_allclose(nose[::-1], points[0, :2], atol=0.05)
    np.testing.assert_allclose(right_heel[::-1], points[30, :2], atol=0.05)
    other.setInput(image)
    np.testing.assert_allclose(space[0, -1], other.forward("Identity_4").reshape(39, 3)[30], atol=0.001)


def test_the_detector_finds_the_woman_where_she_is(sample):
    """The box that the command names is drawn by hand."""
    with open_source(sample / "sample.mp4") as video:
        image = next(frame.image for frame in video if frame.stamp_ns >= 2_800_000_000)
    view = image[274:, 774:]  # the lower right, which holds her alone
    detector = load_detector(sample / "models", PoseEstimatorConfig())
    x0, y0, x1, y1 = detector.detect(view).boxes[0] + np.tile([774, 274], 2)
    assert 1100 < (x0 + x1) / 2 < 1290
    assert 520 < (y0 + y1) / 2 < 940
    assert 0.7 * 420 < y1 - y0 < 1.5 * 420


def test_a_damaged_network_is_refused_in_a_line(network, tmp_path):
    path = tmp_path / "damaged.tflite"
    for data in (b"no network", network.read_bytes()[:100_000]):
        path.write_bytes(data)
        with pytest.raises(InputError, match="expected a network that LiteRT can run") as caught:
            open_model(path)
        assert "\n" not in str(caught.value)


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    """A wheel of a local folder, which pip takes for the registry."""
    path = tmp_path / "wheels" / "thing-1.0-py3-none-any.whl"
    path.parent.mkdir()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("thing/data.txt", "content")
        archive.writestr("thing-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n")
        archive.writestr("thing-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr("thing-1.0.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(path.parent))
    return path


def test_a_wheel_of_the_pinned_sum_gives_its_files(wheel, tmp_path):
    fetch_member(Package("thing==1.0", sha256_of(wheel)), "thing/data.txt", tmp_path / "data.txt")
    assert (tmp_path / "data.txt").read_text() == "content"


def test_a_wheel_of_another_sum_is_refused(wheel, tmp_path):
    with pytest.raises(FetchError, match=r"^thing==1\.0: no download; pip says .*HASHES.*; .*try again$"):
        fetch_member(Package("thing==1.0", "0" * 64), "thing/data.txt", tmp_path / "data.txt")
    assert not (tmp_path / "data.txt").exists()


def test_without_litert_nothing_is_fetched(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("drocap_ros.perception.models.fetch.find_spec", lambda name: None)
    assert main(["sample", "--out", str(tmp_path / "out")]) == 2
    assert "pip install ai-edge-litert" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
