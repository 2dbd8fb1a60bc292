import io
import zipfile

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks, load_tracks, save_tracks


def lens(fx, fy=None):
    return np.array([[fx, 0.0, 320.0], [0.0, fy or fx, 240.0], [0.0, 0.0, 1.0]])


def arrays(frames=4, joints=BODY_15.joints):
    rng = np.random.default_rng(0)
    return {
        "keypoints": rng.uniform(0, 500, (frames, len(joints), 2)),
        "joints": np.array(joints),
        "stamp_ns": np.arange(frames) * 40_000_000,
        "image_size": np.array([640, 480]),
    }


def test_names_of_joints_may_be_bytes(tmp_path):
    np.savez(tmp_path / "t.npz", **{**arrays(), "joints": np.array(BODY_15.joints).astype("S")})
    assert load_tracks(tmp_path / "t.npz").joints == BODY_15.joints


def test_file_round_trip(tmp_path):
    tracks = Tracks(
        keypoints=arrays()["keypoints"],
        joints=BODY_15.joints,
        stamp_ns=arrays()["stamp_ns"],
        image_size=(640, 480),
        confidence=np.full((4, 15), 0.5),
        camera_rotation=np.tile(np.eye(3), (4, 1, 1)),
    )
    save_tracks(tmp_path / "t.npz", tracks)
    back = load_tracks(tmp_path / "t.npz")
    assert back.joints == tracks.joints
    assert back.image_size == tracks.image_size
    for name in ("keypoints", "stamp_ns", "confidence", "camera_rotation"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tracks, name))
    assert back.covariance is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"keypoints": np.zeros((4, 15))}, r"expected float \(F, P, 2\)"),
        ({"keypoints": np.zeros((4, 14, 2))}, "expected 14 names"),
        ({"keypoints": arrays()["keypoints"] / 640.0}, "expected px of an image of 640x480, got none above 0.7"),
        ({"keypoints": np.zeros((0, 15, 2))}, "at least 1 frame"),
        ({"keypoints": np.full((4, 15, 2), np.inf)}, "got infinity"),
        ({"keypoints": np.array([["a"]])}, "expected numbers"),
        ({"stamp_ns": np.zeros(4, np.int64)}, "strictly increasing"),
        ({"stamp_ns": np.arange(4) * 0.04}, "expected int64"),
        ({"stamp_ns": np.arange(3)}, "expected shape"),
        ({"joints": np.array(["a"] * 15)}, "distinct"),
        ({"joints": np.array(BODY_15.joints, object)}, r"save names as text: np\.array\(names, dtype=str\)"),
        ({"image_size": np.array([0, 480])}, "positive"),
        ({"image_size": np.array([640])}, "image_size"),
        ({"confidence": np.zeros((4, 3))}, "confidence: expected shape"),
        ({"camera_rotation": np.zeros((4, 3, 3))}, "rotation matrices"),
        ({"camera_rotation": -np.tile(np.eye(3), (4, 1, 1))}, "rotation matrices"),
        ({"camera_position": np.full((4, 3), np.nan)}, "finite metres"),
        ({"camera_matrix": np.zeros((3, 3))}, "the last row 0 0 1"),
        ({"lens": np.array("foo")}, "lens: expected 'assumed' or 'given', got 'foo'"),
        ({"lens": np.arange(2)}, "lens: expected"),
        ({"camera_matrix": lens(0.7)}, "focal lengths in px, between 64 and 64000 for an image width of 640, got 0.7"),
        ({"camera_matrix": lens(500.0, 0.7)}, "for an image height of 480, got 0.7"),
        ({"camera_matrix": lens(500.0).T}, "the last row 0 0 1"),
        ({"camera_matrix": np.diag([500.0, 500.0, 2.0])}, "the last row 0 0 1"),
        ({"camera_matrix": lens(1e-9)}, "focal lengths in px"),
        ({"camera_matrix": lens(6000.0, 60.0)}, "at most 4 times the other, got 6000 and 60"),
        ({"keypoints": np.full((4, 15, 2), 1e154)}, r"at most 1e\+06 px, got 1e\+154"),
        ({"covariance": np.full((4, 15, 3), 1e300)}, r"covariance: expected at most 1e\+12 px\^2"),
        ({"stamp_ns": np.arange(4, dtype=np.uint64) + np.uint64(2**63)}, "expected int64"),
        ({"stamp_ns": np.array([-9, -1, 1, 9]) * 10**18}, "within a year"),
        ({"image_size": np.array(["640", "480"])}, "two numbers"),
        ({"image_size": np.array([640, 480], "datetime64[s]")}, "two numbers"),
        ({"image_size": np.array([640, 480 + 1j])}, "two numbers"),
        ({"image_size": np.array([True, True])}, "two numbers"),
        ({"image_size": np.zeros(2, [("a", int)])}, "two numbers"),
        ({"image_size": np.array([640, np.nan])}, "image_size: expected positive"),
    ],
)
def test_inconsistent_arrays_are_refused_in_one_line(tmp_path, change, words):
    path = tmp_path / "bad.npz"
    np.savez(path, **{**arrays(), **change})
    with pytest.raises(InputError, match=words) as caught:
        load_tracks(path)
    assert "\n" not in str(caught.value)
    assert "bad.npz" in str(caught.value)


@pytest.mark.parametrize("focal_px", [100.0, 30_000.0], ids=["fisheye", "telephoto"])
def test_every_real_lens_is_taken(tmp_path, focal_px):
    np.savez(tmp_path / "t.npz", **arrays(), camera_matrix=lens(focal_px))
    np.testing.assert_array_equal(load_tracks(tmp_path / "t.npz").camera_matrix, lens(focal_px))


def test_invalid_files_are_refused(tmp_path):
    text, whole, cut, single = (tmp_path / f"{n}.npz" for n in ("text", "whole", "cut", "single"))
    text.write_text("hello")
    np.savez(whole, **arrays())
    cut.write_bytes(whole.read_bytes()[:200])
    with single.open("wb") as stream:
        np.save(stream, np.zeros(3))
    np.savez(tmp_path / "other.npz", a=1)
    with (tmp_path / "object.npz").open("wb") as stream:
        np.savez(stream, **{**arrays(), "joints": np.array([{}], dtype=object)})
    for name in ("text", "cut", "single", "other", "object", "none"):
        with pytest.raises(InputError, match=name):
            load_tracks(tmp_path / f"{name}.npz")


def test_file_that_declares_more_than_it_holds_is_refused_at_once(tmp_path):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    many = tmp_path / "many.npz"
    for path, entries in (
        (tmp_path / "large.npz", {"keypoints.npy": head.getvalue() + bytes(80)}),
        (many, {f"a{n}.npy": head.getvalue() for n in range(1001)}),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in entries.items():
                archive.writestr(name, data)
        with pytest.raises(InputError, match=r"declares 1000000000000 values|at most 1000 arrays"):
            load_tracks(path)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("columns", [2, 3])
def test_poses_in_space_are_no_keypoints(tmp_path, unit, columns):
    points = unit * np.random.default_rng(0).normal(0, 0.5, (20, 15, 3))
    np.savez(tmp_path / "t.npz", **{**arrays(20), "keypoints": points[..., :columns]})
    with pytest.raises(InputError, match="3D poses" if columns == 3 else "expected px of an image of 640x480"):
        load_tracks(tmp_path / "t.npz")


@pytest.mark.parametrize("rate_hz", [5, 24, 60, 240, 1000])
@pytest.mark.parametrize(("unit", "right"), [(1, True), (1000, False), (1_000_000, False)])
def test_times_in_another_unit_than_nanoseconds_are_refused(tmp_path, rate_hz, unit, right):
    stamp_ns = 10**15 + np.arange(40) * (10**9 // rate_hz)
    np.savez(tmp_path / "t.npz", **{**arrays(40), "stamp_ns": stamp_ns // unit})
    if right:
        assert len(load_tracks(tmp_path / "t.npz")) == 40
        return
    with pytest.raises(InputError, match=r"nanoseconds|increasing"):
        load_tracks(tmp_path / "t.npz")
