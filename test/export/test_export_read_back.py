"""Round trip of every format through an independent reader: positions, names and rate."""

import dataclasses

import numpy as np
import pytest
from export_readers import READERS, gltf_array

from drocap_ros.export import RIGGED, export
from drocap_ros.skeleton import BODY_15

TOLERANCE_M = {"bvh": 0.005, "c3d": 0.001, "trc": 0.001, "csv": 0.001, "glb": 0.001, "usd": 0.001}


def written(motion, form, folder):
    path = folder / f"motion.{form}"
    notes = export(motion, path, form)
    return READERS[form](path), notes


def in_order(back, form="csv"):
    """Positions in the order of BODY_15: a hierarchy has its own, with more joints."""
    assert set(back.joints) == set(BODY_15.joints) or (form in RIGGED and set(back.joints) > set(BODY_15.joints))
    return back.positions[:, [back.joints.index(name) for name in BODY_15.joints]]


def worst(back, truth, form="csv", moved=None):
    """Largest distance, m; rigs stand on the floor: one unknown height, or one per frame if ``moved``."""
    off = in_order(back, form) - truth
    if form in RIGGED:
        off[..., 2] -= off[..., 2].mean() if moved is None else off[:, :1, 2]
    return np.nanmax(np.linalg.norm(off, axis=-1))


@pytest.mark.parametrize("form", READERS)
def test_positions_names_and_rate_are_kept(walker, tmp_path, form):
    back, _ = written(walker, form, tmp_path)
    assert len(back.positions) == 48
    assert worst(back, walker.joints3d, form) < TOLERANCE_M[form]
    assert back.rate_hz == pytest.approx(24.0, rel=1e-5)
    np.testing.assert_allclose(back.times_s, np.arange(48) / 24.0, atol=1e-5)


@pytest.mark.parametrize("form", READERS)
def test_motion_in_the_camera_frame_is_upright(in_camera, tmp_path, form):
    back, notes = written(in_camera, form, tmp_path)
    x, y, z = np.moveaxis(in_camera.joints3d, -1, 0)
    assert worst(back, np.stack([x, z, -y], axis=-1), form, moved="per frame") < TOLERANCE_M[form]
    positions = in_order(back, form)
    assert (positions[:, BODY_15.index("head"), 2] > positions[:, BODY_15.index("rankle"), 2] + 1.0).all()
    assert any("gravity" in note for note in notes)


@pytest.mark.parametrize("form", ["c3d", "trc", "csv"])
def test_gaps_are_kept_by_formats_with_missing_values(with_gaps, tmp_path, form):
    back, _ = written(with_gaps, form, tmp_path)
    missing = np.isnan(with_gaps.joints3d).any(axis=2)
    np.testing.assert_array_equal(np.isnan(in_order(back)).any(axis=2), missing)
    assert worst(back, with_gaps.joints3d) < 0.001


@pytest.mark.parametrize("form", ["bvh", "glb", "usd"])
def test_gaps_are_interpolated_in_formats_without_missing_values(walker, with_gaps, tmp_path, form):
    back, notes = written(with_gaps, form, tmp_path)
    off = in_order(back, form) - walker.joints3d
    off[..., 2] -= np.median(off[..., 2])
    error = np.linalg.norm(off, axis=2)
    known = np.isfinite(with_gaps.joints3d).all(axis=2)
    # The bones are constant in the truth, not where a joint was interpolated along a chord.
    assert error[known].max() < TOLERANCE_M[form]
    assert error.max() < 0.15
    assert any("10 frames with unknown joints interpolated" in note for note in notes)


@pytest.mark.parametrize("form", READERS)
def test_uneven_stamps_are_kept_or_resampled(walker, tmp_path, form):
    """A motion linear in time is resampled exactly; formats with stamps keep them."""
    stamps = np.array([0, 40, 80, 125, 160, 200, 240, 300, 320, 360]) * 1_000_000
    drift = np.arange(3)[None] * stamps[:, None] * 1e-9
    joints = walker.joints3d[0] + drift[:, None]
    frames = slice(0, len(stamps))
    motion = dataclasses.replace(
        walker,
        joints3d=joints,
        stamp_ns=stamps + 7_000_000_000,
        camera_rotation=walker.camera_rotation[frames],
        confidence=walker.confidence[frames],
        keypoints=walker.keypoints[frames],
        reprojection_px=walker.reprojection_px[frames],
    )
    back, notes = written(motion, form, tmp_path)
    expected = walker.joints3d[0] + (np.arange(3)[None] * back.times_s[:, None])[:, None]
    assert worst(back, expected, form) < TOLERANCE_M[form]
    assert back.rate_hz == pytest.approx(25.0)
    if form in ("csv", "glb", "usd"):
        np.testing.assert_allclose(back.times_s, stamps * 1e-9, atol=1e-6)
    else:
        np.testing.assert_allclose(back.times_s, np.arange(10) * 0.04, atol=1e-5)
        assert any("resampled" in note for note in notes)


def test_long_gap_between_frames_stays_unknown(walker, tmp_path):
    stamps = walker.stamp_ns.copy()
    stamps[24:] += 2_000_000_000
    motion = dataclasses.replace(walker, stamp_ns=stamps)
    back, _ = written(motion, "trc", tmp_path)
    missing = np.isnan(in_order(back)).all(axis=(1, 2))
    hole = (back.times_s > stamps[23] * 1e-9 + 1e-6) & (back.times_s < stamps[24] * 1e-9 - 1e-6)
    np.testing.assert_array_equal(missing, hole)
    assert hole.sum() > 40


def test_glb_has_a_closed_bone_from_each_joint_to_the_next(walker, tmp_path):
    import pygltflib

    export(walker, tmp_path / "motion.glb", "glb")
    document = pygltflib.GLTF2().load(str(tmp_path / "motion.glb"))
    assert document.asset.extras["up_axis"] == "Y"
    assert document.asset.extras["units"] == "m"
    inverse = gltf_array(document, document.skins[0].inverseBindMatrices).reshape(-1, 4, 4)
    rest = -inverse[:, 3, :3]
    (primitive,) = document.meshes[0].primitives
    corners = gltf_array(document, primitive.attributes.POSITION).reshape(-1, 6, 3)
    owners = gltf_array(document, primitive.attributes.JOINTS_0).astype(int)[:, 0].reshape(-1, 6)
    weights = gltf_array(document, primitive.attributes.WEIGHTS_0)
    np.testing.assert_allclose(weights, np.tile([1.0, 0.0, 0.0, 0.0], (len(weights), 1)))
    # Each bone begins at the joint that it follows; every other joint, and every end of a chain, has one.
    np.testing.assert_allclose(corners[:, 0], rest[owners[:, 0]], atol=1e-6)
    assert np.ptp(owners, axis=1).max() == 0
    ends = corners[:, 5]
    nearest = np.linalg.norm(rest[1:, None] - ends[None], axis=2).min(axis=1)
    assert nearest.max() < 1e-6
    # Closed, and counter-clockwise from outside: the volume of an octahedron of that length and girth.
    faces = gltf_array(document, primitive.indices).astype(int).reshape(-1, 3)
    a, b, c = corners.reshape(-1, 3)[faces].transpose(1, 0, 2)
    volume = (np.sum(a * np.cross(b, c), axis=1) / 6).reshape(len(corners), -1).sum(axis=1)
    length = np.linalg.norm(ends - corners[:, 0], axis=1)
    np.testing.assert_allclose(volume, 2.0 / 3.0 * 0.1**2 * length**3, rtol=1e-3)


@pytest.mark.parametrize("form", [form for form in RIGGED if form in READERS])
@pytest.mark.parametrize("rest", ["t", "a"])
@pytest.mark.parametrize("names", ["lafan1", "mixamo", "mixamo-three"])
def test_rigs_have_the_names_of_other_programs(walker, tmp_path, form, names, rest):
    export(walker, tmp_path / f"rig.{form}", form, names=names, rest=rest)
    back = READERS[form](tmp_path / f"rig.{form}")
    prefix, toe = {
        "lafan1": ("", "Toe"),
        "mixamo": ("mixamorig:", "ToeBase"),
        "mixamo-three": ("mixamorig", "ToeBase"),
    }[names]
    prefix = prefix.replace(":", "_") if form == "usd" else prefix  # a colon ends a namespace there
    expected = {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"} | {
        side + name
        for side in ("Left", "Right")
        for name in ("UpLeg", "Leg", "Foot", toe, "Shoulder", "Arm", "ForeArm", "Hand")
    }
    assert {prefix + name for name in expected} == set(back.joints) - {prefix + "HeadTop_End"}
    at = {name.removeprefix(prefix): back.positions[:, i] for i, name in enumerate(back.joints)}
    for ours, theirs in (
        ("lwrist", "LeftHand"),
        ("rankle", "RightFoot"),
        ("lknee", "LeftLeg"),
        ("relbow", "RightForeArm"),
    ):
        off = at[theirs] - walker.joints3d[:, BODY_15.index(ours)]
        assert np.linalg.norm(off - off.mean(axis=0), axis=1).max() < 0.002
    # Constant bones.
    bone = np.linalg.norm(at["LeftHand"] - at["LeftForeArm"], axis=1)
    assert np.ptp(bone) < 1e-4


@pytest.mark.parametrize("form", READERS)
def test_export_is_deterministic(walker, tmp_path, form):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        export(walker, tmp_path / folder / f"motion.{form}", form)
    assert (tmp_path / "a" / f"motion.{form}").read_bytes() == (tmp_path / "b" / f"motion.{form}").read_bytes()


def test_ten_minutes_are_exported_within_seconds(walker, tmp_path):
    """14,400 frames: the bound excludes loops over frames."""
    import time

    repeats = 300
    many = {
        name: np.concatenate([getattr(walker, name)] * repeats)
        for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px")
    }
    stamps = np.round(np.arange(48 * repeats) / 24.0 * 1e9).astype(np.int64)
    long = dataclasses.replace(walker, **many, stamp_ns=stamps)
    begin = time.process_time()
    for form in ("bvh", "glb", "trc"):
        export(long, tmp_path / f"motion.{form}", form)
    assert time.process_time() - begin < 20
