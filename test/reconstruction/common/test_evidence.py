"""Evidence of depth: mapped to the body by name, scaled, never across the image, and signs that it decides."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.reconstruction.common.poses import Evidence
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording.evidence import body_places, with_evidence
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import load_tracks, save_tracks
from lab.simulation.capture import simulate_capture
from lab.studies.near_camera import NearCamera, known
from lab.studies.protocol import Sequence, protocol_sequences

NAMES = {
    "SMPL": "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot"
    " right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist"
    " right_wrist left_hand right_hand",
    "MHR": "root l_upleg l_lowleg l_foot l_ball r_upleg r_lowleg r_foot r_ball c_spine0 c_neck c_head l_clavicle"
    " l_uparm l_lowarm l_wrist r_clavicle r_uparm r_lowarm r_wrist",
    "SOMA": "Hips Spine1 Spine2 Chest Neck1 Head LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder RightArm"
    " RightForeArm RightHand LeftLeg LeftShin LeftFoot LeftToeBase RightLeg RightShin RightFoot RightToeBase",
}
EXPECTED = {
    "SMPL": {"lhip": "left_hip", "lankle": "left_ankle", "ltoe": "left_foot", "lshoulder": "left_shoulder"},
    "MHR": {"lhip": "l_upleg", "lankle": "l_foot", "ltoe": "l_ball", "lshoulder": "l_uparm", "pelvis": "root"},
    "SOMA": {
        "lhip": "LeftLeg",
        "lknee": "LeftShin",
        "lankle": "LeftFoot",
        "lshoulder": "LeftArm",
        "lwrist": "LeftHand",
    },
}


@pytest.mark.parametrize("system", NAMES)
def test_joints_of_other_systems_are_found_by_name(system: str) -> None:
    names = NAMES[system].split()
    places = body_places(names)
    assert set(places) == set(BODY_17.joints)
    assert len(set(places.values())) == len(BODY_17)
    for ours, theirs in EXPECTED[system].items():
        assert names[places[ours]] == theirs


def test_depths_have_the_scale_of_the_bones_and_an_error_measured_across_the_image() -> None:
    rng = np.random.default_rng(0)
    pose = 300.0 * rng.normal(size=(40, 17, 3))
    pose -= pose[:, :1]
    error = np.zeros_like(pose)
    error[:, 3, :2] = rng.normal(0.0, 80.0, (40, 2))
    found = Evidence(0.001 * (pose + error) + [5.0, 1.0, 2.0], np.full((40, 17), np.nan))
    depth, sigma = found.depths(pose)
    np.testing.assert_allclose(depth, pose[..., 2], rtol=0.05, atol=5.0)
    assert (sigma[:, 3] > 2.0 * sigma[:, 5]).all()
    unknown, infinite = Evidence(np.full((40, 17, 3), np.nan), np.full((40, 17), np.nan)).depths(pose)
    assert np.isnan(unknown).all()
    assert np.isinf(infinite).all()


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (lambda own: own, ""), (lambda own: own[2:6] + 10**6, ""), (lambda own: own + 10**12, "stamp_ns of the tracks"),
        (lambda own: own[:-1], "stamp_ns of the tracks"), (None, "poses of 15 images, got 4"),
    ],
)  # fmt: skip
def test_poses_belong_to_the_images_of_their_stamps(tmp_path, stamps, words) -> None:
    tracks = simulate_capture(1.0, 15.0, seed=1).tracks
    count = 4 if stamps is None else len(stamps(tracks.stamp_ns))
    if words.startswith("stamp") and count < len(tracks):
        count += 1
    arrays = {"joints": NAMES["SMPL"].split(), "evidence": np.arange(count)[:, None, None] + np.zeros((count, 24, 3))}
    if stamps is not None:
        arrays["stamp_ns"] = stamps(tracks.stamp_ns)
    np.savez(tmp_path / "e.npz", **arrays)
    if words:
        with pytest.raises(InputError, match=words):
            with_evidence(tracks, tmp_path / "e.npz")
        return
    found = with_evidence(tracks, tmp_path / "e.npz").evidence[:, 0, 0]
    known = np.flatnonzero(np.isfinite(found))
    assert known.tolist() == (list(range(len(tracks))) if count == len(tracks) else [2, 3, 4, 5])
    assert found[known].tolist() == list(range(count))


@pytest.fixture(scope="module")
def sequence(shared: Path) -> Sequence:
    return protocol_sequences(shared / "mocap" / "dev")[0]


def simulated_evidence(truth: np.ndarray) -> dict[str, np.ndarray]:
    """A single-image method's poses: true ones (F, P, 3) mm in camera axes, with errors that last for six frames.

    35 mm across the image and 110 in depth give 92 mm after alignment and 87 % right signs (BlazePose: 85, 89).
    """
    error_mm = np.array([35.0, 35.0, 110.0])
    wander = gaussian_filter1d(np.random.default_rng(0).normal(size=truth.shape), 6.0, axis=0)
    evidence = truth + wander / wander.std() * error_mm
    return {"evidence": evidence, "evidence_sigma": np.full(truth.shape[:2], error_mm[2])}


def test_a_mirrored_start_is_put_right_and_keypoints_keep_their_joints(sequence: Sequence) -> None:
    """A camera without perspective, held still: the mirror image of a limb explains the keypoints as well."""
    camera = NearCamera(100.0, focal=20.0)
    whole = camera.tracks(sequence)
    alone = known(whole, lens=False, rotation=False, position=False)
    assert whole.camera_rotation is not None
    truth = (sequence.x - sequence.x[:, :1]) @ np.swapaxes(whole.camera_rotation, 1, 2)
    told = dataclasses.replace(alone, **simulated_evidence(truth))
    without, with_it = (reconstruct(t) for t in (alone, told))
    errors = [float(pa_mpjpe(motion.joints3d, truth).mean()) for motion in (without, with_it)]
    assert errors[1] < errors[0]
    assert np.nanmedian(with_it.reprojection_px) < np.nanmedian(without.reprojection_px) + 1.0
    # Evidence of the opposite depth throughout turns the body over: it is used.
    assert told.evidence is not None
    opposite = dataclasses.replace(told, evidence=told.evidence * [1.0, 1.0, -1.0], evidence_sigma=None)
    assert float(pa_mpjpe(reconstruct(opposite).joints3d, truth).mean()) > errors[0]


def test_a_file_of_evidence_joins_the_tracks_by_frame_and_stamp(sequence: Sequence, tmp_path: Path) -> None:
    tracks = NearCamera(3.3).tracks(sequence)
    names = np.array(NAMES["SMPL"].split())
    poses = np.random.default_rng(0).normal(size=(len(tracks), len(names), 3))
    np.savez(tmp_path / "all.npz", joints=names, joints3d=poses)
    told = with_evidence(tracks, tmp_path / "all.npz")
    assert told.evidence is not None
    knee = tracks.joints.index("lknee")
    np.testing.assert_array_equal(told.evidence[:, knee], poses[:, names.tolist().index("left_knee")])
    np.savez(tmp_path / "some.npz", joints=names, evidence=poses[5:9], stamp_ns=tracks.stamp_ns[5:9])
    some = with_evidence(tracks, tmp_path / "some.npz")
    assert some.evidence is not None
    assert np.isfinite(some.evidence[:, knee, 0]).sum() == 4
    np.testing.assert_array_equal(some.evidence[5:9, knee], poses[5:9, names.tolist().index("left_knee")])
    save_tracks(tmp_path / "tracks.npz", some)
    again = load_tracks(tmp_path / "tracks.npz")
    np.testing.assert_array_equal(again.evidence, some.evidence)
    np.testing.assert_array_equal(again.evidence_sigma, some.evidence_sigma)
    np.savez(tmp_path / "short.npz", joints=names, evidence=poses[:9])
    with pytest.raises(InputError, match=r"expected poses of .* images, got 9"):
        with_evidence(tracks, tmp_path / "short.npz")
    np.savez(tmp_path / "others.npz", joints=np.array(["a", "b"]), evidence=poses[:, :2])
    with pytest.raises(InputError, match="SMPL"):
        with_evidence(tracks, tmp_path / "others.npz")
