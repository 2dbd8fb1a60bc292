"""A lens that the user knows: calibration files of three tools, and what they take off keypoints and points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bent_lenses import BENT, bent

from drocap_ros.background import Background
from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.motion import load_motion
from drocap_ros.perception.calibration import load_calibration, with_lens_of
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.tracks import Tracks, save_tracks

SIZE = (1280, 720)
MATRIX = np.array([[900.0, 0.0, 650.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]])
FLAT = ", ".join(map(str, MATRIX.ravel()))


def ros_yaml(lens: str) -> str:
    coefficients = f"{{rows: 1, cols: {len(BENT[lens])}, data: {BENT[lens]}}}"
    return (
        f"image_width: 1280\nimage_height: 720\ndistortion_model: {lens}\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: [{FLAT}]}}\ndistortion_coefficients: {coefficients}\n"
    )


def opencv_yaml(lens: str) -> str:
    tag = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data:"
    return (
        f"%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ndistortion_model: {lens}\n"
        f"camera_matrix: {tag} [ {FLAT} ]\ndistortion_coefficients: {tag} {BENT[lens]}\n"
    )


def toml(lens: str, names: tuple[str, ...] = ("cam_1",)) -> str:
    table = (
        f"size = [ 1280.0, 720.0 ]\nmatrix = {MATRIX.tolist()}\ndistortions = {BENT[lens]}\n"
        f"fisheye = {str(lens == 'equidistant').lower()}\nrotation = [ 0.0, 0.0, 0.0 ]\n"
    )
    return "".join(f"[{name}]\n{table}" for name in names) + "[metadata]\nerror = 0.0\n"


def tracks(lens: str = "") -> tuple[Tracks, np.ndarray]:
    rng = np.random.default_rng(0)
    names = ("pelvis", "rhip", "rknee", "rankle", "lhip", "lknee", "lankle", "neck", "head")
    names += ("lshoulder", "lelbow", "lwrist", "rshoulder", "relbow", "rwrist")
    body = np.array([(0, 0), (-9, 0), (-9, 40), (-9, 80), (9, 0), (9, 40), (9, 80), (0, -50), (0, -75)])
    body = np.concatenate([body, [(18, -48), (22, -20), (23, 5), (-18, -48), (-22, -20), (-23, 5)]])
    sway = 3.0 * np.sin(np.arange(40) / 6.0)
    ideal = 2.0 * body + [300.0, 300.0] + sway[:, None, None]
    spots = rng.uniform([100, 100], [1200, 650], (40, 2))
    seen, point = (bent(ideal, MATRIX, lens), bent(spots, MATRIX, lens)) if lens else (ideal, spots)
    seen = seen.copy()
    seen[0, 0] = np.nan
    background = Background(np.zeros(40, np.int32), np.arange(40), point.astype(np.float32))
    stamps = np.round(np.arange(40) * (1e9 / 24.0)).astype(np.int64)
    return Tracks(seen, names, stamps, SIZE, background=background), ideal


@pytest.mark.parametrize("lens", BENT)
@pytest.mark.parametrize(("suffix", "written"), [(".yaml", ros_yaml), (".yml", opencv_yaml), (".toml", toml)])
def test_distortion_of_every_tool_is_taken_off_keypoints_and_points(
    tmp_path: Path, suffix: str, written: object, lens: str
) -> None:
    (path := tmp_path / f"lens{suffix}").write_text(written(lens))  # type: ignore[operator]
    given, ideal = tracks(lens)
    known = with_lens_of(given, ImageIngestConfig(calibration_file=str(path)))
    assert known.camera_matrix is not None
    np.testing.assert_allclose(known.camera_matrix, MATRIX)
    assert np.isnan(known.keypoints[0, 0]).all()
    assert np.nanmax(np.abs(known.keypoints - ideal)) < 0.05
    assert known.background is not None
    assert np.abs(known.background.point - tracks()[0].background.point).max() < 0.1  # type: ignore[union-attr]


def test_one_of_several_cameras_is_named(tmp_path: Path) -> None:
    (path := tmp_path / "Calib.toml").write_text(toml("plumb_bob", ("left", "right")))
    with pytest.raises(InputError, match="left, right; name it: "):
        load_calibration(path)
    assert load_calibration(tmp_path / "Calib.toml#right").width == 1280
    with pytest.raises(InputError, match="left, right"):
        load_calibration(tmp_path / "Calib.toml#middle")


@pytest.mark.parametrize(
    "text", ["", "[]", "a: [", "%YAML:1.0\n---\ncamera_matrix: 3\n", "\x00", ros_yaml("plumb_bob")[:90]]
)
def test_what_is_no_calibration_is_refused_in_a_line(tmp_path: Path, text: str) -> None:
    for suffix in (".yaml", ".toml"):
        (path := tmp_path / f"lens{suffix}").write_text(text)
        with pytest.raises(InputError) as refusal:
            load_calibration(path)
        assert str(path) in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_a_lens_and_a_stature_that_are_told_count(tmp_path: Path) -> None:
    save_tracks(tmp_path / "tracks.npz", tracks()[0])
    heights = []
    for options in (["--height", "1.5"], ["--height", "1.9", "--focal", "900", "--level"], ["--fov", "70"]):
        out = tmp_path / "out"
        assert (
            main(["reconstruct", str(tmp_path / "tracks.npz"), "--out", str(out), "--quiet", "--no-report", *options])
            == 0
        )
        motion = load_motion(out / "motion.npz")
        heights.append(motion.meta["assumed_height_m"])
        assert motion.meta["lens"] == ("given" if len(options) != 2 or "--fov" in options else "unknown")
        assert motion.frame == ("world" if "--level" in options else "camera")
    assert heights == [1.5, 1.9, 1.7]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--height", "17"], "--height: expected 0.5 to 2.5, got 17"),
        (["--height", "nan"], "--height: expected 0.5 to 2.5, got nan"),
        (["--fov", "0"], "--fov: expected 5 to 170, got 0"),
        (["--focal", "-3"], "--focal: expected 10 to 1e+06, got -3"),
        (["--level", "--camera-roll", "3"], "--level: expected neither"),
        (["--calibration", "missing.yaml"], "missing.yaml: expected a calibration file"),
    ],
)
def test_wrong_knowledge_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    save_tracks(tmp_path / "tracks.npz", tracks()[0])
    assert main(["reconstruct", str(tmp_path / "tracks.npz"), "--out", str(tmp_path / "out"), "--quiet", *options]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_no_ideal_lens_shows_is_left_out() -> None:
    """A fisheye's side: OpenCV gives a million px."""
    lens = CameraModel(*SIZE, MATRIX, np.array([-0.4, 0.0, 0.0, 0.0]), "equidistant")
    point = np.array([[640.0, 360.0], [1e4, 360.0]], np.float32)
    assert np.isfinite(lens.undistorted(point)).all(axis=1).tolist() == [True, False]
    flat = lens.flat_points(Background(np.zeros(2, np.int32), np.arange(2), point))
    assert flat is not None
    assert flat.track.tolist() == [0]


def test_the_number_of_coefficients_fits_the_model(tmp_path: Path) -> None:
    (path := tmp_path / "lens.yaml").write_text(ros_yaml("plumb_bob").replace("plumb_bob", "equidistant"))
    with pytest.raises(InputError, match="expected 4 finite distortion coefficients of equidistant"):
        load_calibration(path)
