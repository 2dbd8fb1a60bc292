"""Feet through `drocap reconstruct`: toes and heels of networks that see them, and older files without."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.motion import load_motion, save_motion
from drocap_ros.reconstruction.body_input import body_keypoints
from drocap_ros.report.checks import MotionCheck, run_checks
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15, BODY_17, BODY_19, HALPE_26
from drocap_ros.tracks import Tracks, load_tracks, save_tracks
from lab.simulation.orbit import orbit_camera

FRAMES, FPS = 96, 24.0
TIMES = np.arange(FRAMES) / FPS
TRUTH = simulate_person(TIMES, "walk", 1, 1.75, BODY_17)
#: Heels behind and below the ankles, in the plane of the foot.
HEELS = TRUTH[:, [3, 6]] - 0.3 * (TRUTH[:, 15:] - TRUTH[:, [3, 6]]) * (1, 1, 0) - (0.0, 0.0, 0.055)
ROTATION, POSITION = orbit_camera(TIMES, TRUTH[:, 0] * (1, 1, 0) + (0, 0, 0.9), 6.0, 2.0, 20.0, 0.0)
MATRIX = pinhole_matrix(1280, 720, 60.0)
STAMPS = np.round(TIMES * 1e9).astype(np.int64)


def halpe_tracks() -> Tracks:
    """The walker as a network of Halpe's 26 joints sees it."""
    body = dict(zip(BODY_19.joints, np.moveaxis(np.concatenate([TRUTH, HEELS], axis=1), 1, 0), strict=True))
    shoulders, up = 0.5 * (body["lshoulder"] + body["rshoulder"]), body["head"] - body["neck"]
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    places = {
        "nose": shoulders + 0.19 * up,
        "head_top": shoulders + 0.31 * up,
        "neck": shoulders,
        "hip": body["pelvis"],
    }
    for side, letter in (("left_", "l"), ("right_", "r")):
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel"):
            places[side + part] = body[letter + part]
        places |= {side + "eye": shoulders + 0.19 * up, side + "ear": shoulders + 0.19 * up}
        places |= {side + "big_toe": body[letter + "toe"], side + "small_toe": body[letter + "toe"]}
    joints = np.stack([places[name] for name in HALPE_26.joints], axis=1)
    return Tracks(project(joints, ROTATION, POSITION, MATRIX), HALPE_26.joints, STAMPS, (1280, 720))


def reconstructed(folder: Path, tracks: Tracks, *options: str):
    save_tracks(folder / "tracks.npz", tracks)
    assert main(["reconstruct", str(folder / "tracks.npz"), "--out", str(folder / "out"), "--quiet", *options]) == 0
    return load_motion(folder / "out")


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    return reconstructed(tmp_path_factory.mktemp("halpe"), halpe_tracks())


def foot_errors(motion) -> np.ndarray:
    """(F, 2) mm of the toes, after the alignment over all joints."""
    truth = TRUTH @ np.swapaxes(ROTATION, 1, 2)
    found = apply_similarity(motion.joints3d[:, :17], *similarity(motion.joints3d[:, :17], truth))
    return 1000.0 * np.linalg.norm(found - truth, axis=-1)[:, 15:17]


def test_toes_of_a_halpe_network_reach_the_motion(seen):
    assert seen.joints[:17] == BODY_17.joints
    assert [seen.joints[p] for p in seen.parents[15:17]] == ["rankle", "lankle"]
    assert np.isfinite(seen.joints3d).all()
    np.testing.assert_allclose(seen.keypoints[:, 15:17], project(TRUTH, ROTATION, POSITION, MATRIX)[:, 15:], atol=1e-6)
    assert (seen.confidence[:, 15:17] == 1.0).all()
    assert foot_errors(seen).mean() < 80.0
    length = np.linalg.norm(seen.joints3d[:, 15] - seen.joints3d[:, 3], axis=1)
    assert length.std() < 0.1 * length.mean()


def test_heels_follow_from_the_heels_in_the_image(seen):
    """A heel keeps its place on the rigid foot; in the image it is where the network saw it."""
    assert seen.joints == BODY_19.joints
    assert [seen.joints[p] for p in seen.parents[17:]] == ["rankle", "lankle"]
    truth = np.concatenate([TRUTH, HEELS], axis=1) @ np.swapaxes(ROTATION, 1, 2)
    found = apply_similarity(seen.joints3d, *similarity(seen.joints3d[:, :17], truth[:, :17]))
    assert 1000.0 * np.linalg.norm(found - truth, axis=-1)[:, 17:].mean() < 80.0
    from_ankle, from_toe, foot = (
        np.linalg.norm(seen.joints3d[:, a] - seen.joints3d[:, b], axis=1) for a, b in ((17, 3), (17, 15), (15, 3))
    )
    assert (from_ankle / foot).std() < 1e-6
    assert (from_toe / foot).std() < 1e-6
    assert np.median(seen.reprojection_px[:, 17:]) < 12.0


def test_without_toes_in_the_image_they_are_an_estimate(tmp_path, seen):
    tracks = halpe_tracks()
    body = tracks.keypoints[:, :17], HALPE_26.joints[:17]
    motion = reconstructed(tmp_path, Tracks(*body, STAMPS, (1280, 720)))
    assert motion.joints == BODY_17.joints
    assert np.isfinite(motion.joints3d).all()
    assert np.isnan(motion.keypoints[:, 15:]).all()
    assert (motion.confidence[:, 15:] == 0.0).all()
    assert np.isnan(motion.reprojection_px[:, 15:]).all()
    results = {result.check: result for result in run_checks(motion, motion_statistics(motion))}
    assert MotionCheck.ESTIMATED_FEET in results
    assert MotionCheck.MISSING_JOINTS not in results
    assert foot_errors(motion).mean() > foot_errors(seen).mean()


def test_bvh_has_the_bones_of_the_feet(tmp_path, seen, capsys):
    save_motion(tmp_path / "motion.npz", seen)
    assert main(["export", str(tmp_path / "motion.npz"), "--to", "bvh", "--out", str(tmp_path / "m.bvh")]) == 0
    lines = [line.strip() for line in (tmp_path / "m.bvh").read_text().splitlines()]
    assert {"JOINT ltoe", "JOINT rtoe"} <= set(lines)
    offset = lines[lines.index("JOINT rtoe") + 2]
    length_cm = np.linalg.norm([float(word) for word in offset.split()[1:]])
    foot = np.linalg.norm(seen.joints3d[:, 15] - seen.joints3d[:, 3], axis=1)
    assert length_cm == pytest.approx(100.0 * np.median(foot), rel=0.1)
    assert "no toes" not in capsys.readouterr().out
    assert main(["export", str(tmp_path / "motion.npz"), "--to", "csv", "--out", str(tmp_path / "m.csv")]) == 0
    head = (tmp_path / "m.csv").read_text().splitlines()[0]
    assert "rtoe_x_m" in head
    assert "lheel_z_m" in head


def test_motions_of_fifteen_joints_stay_readable(tmp_path, seen):
    body = dataclasses.replace(
        seen, joints=BODY_15.joints, parents=BODY_15.parents,
        **{
            name: getattr(seen, name)[:, :15]
            for name in ("joints3d", "confidence", "keypoints", "reprojection_px", "covariance")
        },
    )  # fmt: skip
    save_motion(tmp_path / "motion.npz", body)
    assert load_motion(tmp_path).joints == BODY_15.joints
    for command in (["report"], ["export", "--to", "bvh"], ["export", "--to", "glb"]):
        assert main([command[0], str(tmp_path / "motion.npz"), *command[1:]]) == 0
    save_motion(tmp_path / "truth.npz", seen)
    assert main(["evaluate", "compare", str(tmp_path / "motion.npz"), str(tmp_path / "truth.npz")]) == 0


def test_evaluation_prints_the_error_of_the_toes(tmp_path, seen, capsys):
    save_motion(tmp_path / "motion.npz", seen)
    assert main(["evaluate", "compare", str(tmp_path / "motion.npz"), str(tmp_path / "motion.npz")]) == 0
    head, _, row = capsys.readouterr().out.splitlines()[:3]
    assert dict(zip(head.split(" | "), row.split(" | "), strict=True))["toe mm |"] == "0.0 |"


def test_methods_of_the_paper_give_the_same_arrays_with_and_without_feet(tmp_path):
    keypoints = project(np.concatenate([TRUTH, HEELS], axis=1), ROTATION, POSITION, MATRIX)
    motions = []
    for body in (BODY_15, BODY_17, BODY_19):
        folder = tmp_path / body.name
        folder.mkdir()
        tracks = Tracks(keypoints[:, : len(body)], body.joints, STAMPS, (1280, 720))
        motions.append(reconstructed(folder, tracks, "--method", "initial"))
    for motion in motions:
        assert motion.joints == BODY_15.joints
        np.testing.assert_array_equal(motion.joints3d, motions[0].joints3d)
        np.testing.assert_array_equal(motion.keypoints, keypoints[:, :15])


def test_tracks_of_fifteen_joints_are_widened(tmp_path):
    exact = project(TRUTH, ROTATION, POSITION, MATRIX)[:, :15]
    ones = np.ones(exact.shape[:2])
    save_tracks(
        tmp_path / "old.npz",
        Tracks(exact, BODY_15.joints, STAMPS, (1280, 720), confidence=ones, covariance=np.ones((*ones.shape, 3))),
    )
    found = body_keypoints(load_tracks(tmp_path / "old.npz"))
    np.testing.assert_array_equal(found.xy[:, :15], exact)
    assert np.isnan(found.xy[:, 15:]).all()
    assert (found.weights[:, 15:] == 0.0).all()
    assert np.isnan(found.covariance[:, 15:]).all()
