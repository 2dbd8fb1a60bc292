"""The whole offline reconstruction: invariances, masks, telemetry, files, bad input."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from walking import PX_PER_M, Walk, make_walk, stamps

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import horizon_error, is_mirrored, pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import Motion, load_motion, save_motion
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
from drocap_ros.reconstruction.common.windows import windows
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.methods.run import run_method
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

PAPER = ("paper", "paper-no-articulation", "initial", "mf-nnm")


@pytest.fixture(scope="module")
def paper(walk: Walk) -> Motion:
    return reconstruct(walk.tracks(), method="paper")


@pytest.mark.parametrize("method", METHODS)
def test_every_method_recovers_the_walk(walk: Walk, method: str) -> None:
    motion = reconstruct(walk.tracks(), method=method)
    truth = 1000.0 * walk.in_camera
    assert motion.joints == METHODS[method].joints.joints
    assert motion.joints3d.shape == (120, 17 if method == "ba" else 15, 3)
    assert np.isfinite(motion.joints3d).all()
    assert pa_mpjpe(motion.joints3d, truth).mean() < (75.0 if method == "initial" else 60.0)
    assert not is_mirrored(motion.joints3d, truth)
    assert motion.meta["method"] == method
    assert motion.meta["stop_reason"]


def test_adjustment_improves_the_initial_poses(walk: Walk, paper: Motion) -> None:
    truth = 1000.0 * walk.in_camera
    start = pa_mpjpe(reconstruct(walk.tracks(), method="initial").joints3d, truth).mean()
    assert pa_mpjpe(paper.joints3d, truth).mean() < 0.75 * start


def test_motion_holds_frame_scale_and_provenance(paper: Motion) -> None:
    assert (paper.frame, paper.metric, paper.scale_source) == ("camera", False, "assumed_height")
    np.testing.assert_array_equal(paper.camera_rotation, np.broadcast_to(np.eye(3), (120, 3, 3)))
    np.testing.assert_allclose(paper.joints3d[:, 0], 0.0, atol=1e-12)
    assert limb_lengths(paper.joints3d).sum(1).mean() == pytest.approx(1.70 * 1.78, rel=0.01)
    assert paper.reprojection_px.mean() < 0.01 * 1.7 * PX_PER_M
    for key in ("versions", "git_revision", "parameters", "seconds", "iterations", "cost_terms"):
        assert key in paper.meta
    assert {"initial", "ba"} <= set(paper.meta["seconds"])
    json.dumps(paper.meta)


def test_equal_input_gives_equal_bits(walk: Walk, paper: Motion, tmp_path: Path) -> None:
    again = reconstruct(walk.tracks(), method="paper")
    save_motion(tmp_path / "motion.npz", again)
    for field in dataclasses.fields(Motion):
        if field.name != "meta":
            np.testing.assert_array_equal(
                np.asarray(getattr(load_motion(tmp_path / "motion.npz"), field.name)),
                np.asarray(getattr(paper, field.name)),
            )


def test_file_of_a_motion_without_covariance_holds_unknown_ones(paper: Motion, tmp_path: Path) -> None:
    save_motion(tmp_path / "motion.npz", paper)
    with np.load(tmp_path / "motion.npz") as file:
        np.testing.assert_array_equal(file["covariance"], np.full((120, 15, 6), np.nan))
    assert load_motion(tmp_path / "motion.npz").covariance is None


def test_method_without_a_finite_pose_is_an_error(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(name: str, data: MethodInput) -> ImagePoses:
        found = run_method(name, data)
        return dataclasses.replace(found, joints_px=np.full_like(found.joints_px, np.nan))

    monkeypatch.setattr("drocap_ros.reconstruction.reconstruct.run_method", lost)
    with pytest.raises(InputError, match="none that give a finite pose"):
        reconstruct(walk.tracks(), method="initial")


def test_result_is_independent_of_the_joint_order(walk: Walk, paper: Motion) -> None:
    order = np.random.default_rng(0).permutation(15)
    names = tuple(BODY_15.joints[i] for i in order)
    shuffled = Tracks(walk.keypoints[:, order], names, stamps(120), (1280, 1024))
    extra = Tracks(
        np.concatenate([walk.keypoints, np.zeros((120, 1, 2))], axis=1), (*BODY_15.joints, "hat"), stamps(120), (9, 9)
    )
    for tracks in (shuffled, extra):
        np.testing.assert_array_equal(reconstruct(tracks, method="paper").joints3d, paper.joints3d)


@pytest.mark.parametrize("method", PAPER)
def test_result_is_independent_of_scale_and_position_in_the_image(walk: Walk, method: str) -> None:
    config = BundleAdjusterConfig(iterations=40)
    plain = reconstruct(walk.tracks(), method=method, adjuster=config)
    moved = reconstruct(walk.tracks(3.0 * walk.keypoints - 500.0), method=method, adjuster=config)
    np.testing.assert_allclose(moved.joints3d, plain.joints3d, atol=1e-5)
    np.testing.assert_allclose(moved.reprojection_px, 3.0 * plain.reprojection_px, atol=1e-3)


def test_rotation_of_the_world_rotates_the_result(walk: Walk) -> None:
    position = -6.0 * walk.camera[:, 2] + np.array([0.0, 0.0, 1.0])
    k = np.array([[2400.0, 0.0, 640.0], [0.0, 2400.0, 512.0], [0.0, 0.0, 1.0]])
    tracks = walk.tracks(camera_rotation=walk.camera, camera_position=position, camera_matrix=k)
    a = reconstruct(tracks, method="paper")
    heading = exp_so3(np.array([0.0, 0.0, 1.1]))
    b = reconstruct(
        dataclasses.replace(tracks, camera_rotation=walk.camera @ heading.T, camera_position=position @ heading.T),
        method="paper",
    )
    assert a.frame == b.frame == "world"
    np.testing.assert_allclose(b.joints3d, a.joints3d @ heading.T, atol=1e-9)


def test_telemetry_places_the_body_upright(walk: Walk) -> None:
    """Person of 1.70 m at the world's origin, camera 6 m away, 400 px per metre there."""
    position = -6.0 * walk.camera[:, 2]
    k = np.array([[2400.0, 0.0, 640.0], [0.0, 2400.0, 512.0], [0.0, 0.0, 1.0]])
    tracks = walk.tracks(camera_rotation=walk.camera, camera_position=position, camera_matrix=k)
    motion = reconstruct(tracks, method="paper")
    world = walk.in_camera @ walk.camera
    assert np.rad2deg(horizon_error(motion.joints3d, world)).mean() < 8.0
    assert np.all(motion.joints3d[:, BODY_15.index("head"), 2] > motion.joints3d[:, BODY_15.index("lankle"), 2])
    size = limb_lengths(world).sum(1).mean() / (1.70 * 1.78)
    range_m = np.linalg.norm(motion.joints3d.mean(1) - position, axis=1)
    np.testing.assert_allclose(range_m * size, 6.0, atol=0.4)
    projected = (motion.joints3d - position[:, None]) @ np.swapaxes(walk.camera, 1, 2)
    px = projected[..., :2] / projected[..., 2:] * 2400.0 + np.array([640.0, 512.0])
    assert np.abs(px[:, 0] - walk.keypoints[:, 0]).max() < 40.0


@pytest.mark.parametrize("method", PAPER)
def test_masked_frames_equal_absent_frames(walk: Walk, method: str) -> None:
    """A call with masked frames equals the call without them, for any masked values."""
    masked = np.zeros(120, dtype=bool)
    masked[30:45] = masked[100] = True
    keypoints = walk.keypoints.copy()
    keypoints[masked] = np.nan
    config = BundleAdjusterConfig(iterations=40)
    long = reconstruct(walk.tracks(keypoints), method=method, adjuster=config)
    without = Tracks(walk.keypoints[~masked], BODY_15.joints, stamps(120)[~masked], (1280, 1024))
    short = reconstruct(without, method=method, adjuster=config)
    confidence = np.where(masked, 0.0, 1.0)[:, None].repeat(15, axis=1)
    weighted = reconstruct(walk.tracks(confidence=confidence), method=method, adjuster=config)
    # The size is averaged over time, so metres differ in the last per mille; the poses do not.
    scale = limb_lengths(short.joints3d).sum(1) / limb_lengths(long.joints3d[~masked]).sum(1)
    np.testing.assert_allclose(long.joints3d[~masked] * scale[:, None, None], short.joints3d, atol=1e-12)
    np.testing.assert_array_equal(weighted.joints3d, long.joints3d)
    assert np.isfinite(long.joints3d).all()
    assert np.all(long.confidence[masked] == 0.0)


def test_missing_joints_are_estimated(walk: Walk) -> None:
    keypoints = walk.keypoints.copy()
    keypoints[:, BODY_15.index("lwrist")] = np.nan  # never seen
    keypoints[40:80, BODY_15.index("rankle")] = np.nan
    motion = reconstruct(walk.tracks(keypoints), method="paper")
    truth = 1000.0 * walk.in_camera
    assert np.isfinite(motion.joints3d).all()
    assert pa_mpjpe(motion.joints3d, truth).mean() < 90.0
    assert np.isnan(motion.reprojection_px[:, BODY_15.index("lwrist")]).all()


def test_a_subset_of_joints_suffices(walk: Walk) -> None:
    use = [i for i, name in enumerate(BODY_15.joints) if name not in ("pelvis", "neck", "head")]
    tracks = Tracks(walk.keypoints[:, use], tuple(BODY_15.joints[i] for i in use), stamps(120), (1280, 1024))
    motion = reconstruct(tracks, method="paper")
    assert pa_mpjpe(motion.joints3d, 1000.0 * walk.in_camera).mean() < 60.0


@pytest.mark.parametrize("method", [m for m in METHODS if m != "mf-nnm"])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_few_frames_give_a_pose(walk: Walk, method: str, frames: int) -> None:
    tracks = Tracks(walk.keypoints[:frames], BODY_15.joints, stamps(frames), (1280, 1024))
    motion = reconstruct(tracks, method=method)
    assert np.isfinite(motion.joints3d).all()
    assert motion.joints3d.shape == (frames, len(METHODS[method].joints), 3)


def test_mf_nnm_refuses_fewer_than_three_images(walk: Walk) -> None:
    tracks = Tracks(walk.keypoints[:2], BODY_15.joints, stamps(2), (1280, 1024))
    with pytest.raises(InputError, match="mf-nnm: expected at least 3 images"):
        reconstruct(tracks, method="mf-nnm")


@pytest.mark.parametrize("method", METHODS)
def test_a_repeated_image_gives_a_still_pose(walk: Walk, method: str) -> None:
    motion = reconstruct(walk.tracks(np.repeat(walk.keypoints[:1], 40, axis=0)), method=method)
    assert np.isfinite(motion.joints3d).all()
    assert np.ptp(motion.joints3d, axis=0).max() < 0.05


def _with(walk: Walk, **changes: np.ndarray) -> Tracks:
    return dataclasses.replace(walk.tracks(), **changes)


def _bad_covariance(value: float) -> np.ndarray:
    covariance = np.tile(np.array([4.0, 0.0, 4.0]), (120, 15, 1))
    covariance[7, 3, 0] = value
    return covariance


@pytest.mark.parametrize("method", METHODS)
def test_unusable_input_is_refused(walk: Walk, method: str) -> None:
    def run(tracks: Tracks) -> None:
        reconstruct(tracks, method=method)

    with pytest.raises(InputError, match="at least 4 seen joints, got at most 0"):
        run(_with(walk, keypoints=np.full((120, 15, 2), np.nan)))
    with pytest.raises(InputError, match="all in one point"):
        run(_with(walk, keypoints=np.full((120, 15, 2), 300.0)))
    with pytest.raises(InputError, match="at least 4 of pelvis"):
        run(Tracks(walk.keypoints[:, :2], ("rhip", "lhip"), stamps(120), (9, 9)))
    for value in (np.nan, np.inf, -1.0, 0.0):
        with pytest.raises(InputError, match="covariance: expected finite, positive definite"):
            run(_with(walk, covariance=_bad_covariance(value)))
    with pytest.raises(InputError, match=r"confidence: expected values in \[0, 1\]"):
        run(_with(walk, confidence=np.full((120, 15), 80.0)))


def test_an_unknown_method_is_refused(walk: Walk) -> None:
    with pytest.raises(InputError, match="method: expected one of ba, paper"):
        reconstruct(walk.tracks(), method="magic")


def test_two_seen_joints_are_refused(walk: Walk) -> None:
    keypoints = walk.keypoints.copy()
    keypoints[:, 2:] = np.nan
    with pytest.raises(InputError, match="at least 4 seen joints, got at most 2"):
        reconstruct(walk.tracks(keypoints), method="paper")


@pytest.mark.parametrize("method", PAPER)
def test_long_recordings_are_solved_in_windows(method: str) -> None:
    """Windows of 100 frames are close to one of 300, also where windows overlap."""
    walk = make_walk(300)
    truth = 1000.0 * walk.in_camera
    short = reconstruct(
        walk.tracks(),
        method=method,
        adjuster=BundleAdjusterConfig(window_frames=100, overlap_frames=30, iterations=60),
        initializer=InitializerConfig(block_frames=64),
    )
    whole = reconstruct(walk.tracks(), method=method, adjuster=BundleAdjusterConfig(iterations=60))
    error = pa_mpjpe(short.joints3d, truth)
    assert error.mean() < pa_mpjpe(whole.joints3d, truth).mean() + 30.0
    meet = np.concatenate([np.arange(b.start, a.stop) for a, b in itertools.pairwise(windows(300, 100, 30))])
    assert error[meet].mean() < error.mean() + 10.0


def test_progress_is_reported(walk: Walk) -> None:
    seen: list[tuple[str, float]] = []
    reconstruct(walk.tracks(), method="paper", progress=lambda stage, done: seen.append((stage, done)))
    assert {"initial", "ba"} <= {stage for stage, _ in seen}
    assert all(0.0 <= done <= 1.0 for _, done in seen)
