"""Training: its samples are geometrically right, and a short run learns and exports a network that runs."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES
from drocap_ros.skeleton import BODY_15
from drocap_ros.training.lifter_samples import (
    MocapBank,
    camera_rotation,
    load_bank,
    sample_batch,
)


def bank(frames: int = 90) -> MocapBank:
    """Two sequences of a swinging stick figure."""
    rng = np.random.default_rng(0)
    body = np.zeros((15, 3))
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            body[joint] = body[parent] + rng.normal(0, 0.1, 3) + (0, 0, 0.25 if joint >= 7 else -0.25)
    phase = rng.uniform(0, 6, (1, 15, 3))
    x = body + 0.05 * np.sin(0.2 * np.arange(2 * frames)[:, None, None] + phase)
    return MocapBank(x.astype(np.float32), np.array([0, frames]), np.array([frames, frames]), np.array([30.0, 30.0]))


def test_virtual_camera_sees_the_head_above_the_feet():
    azimuth, elevation, roll = np.array([0.3, 2.0]), np.array([0.2, 0.9]), np.zeros(2)
    rotation = camera_rotation(azimuth, elevation, roll)
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    away = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, -away), np.tile([0.0, 0.0, 1.0], (2, 1)), atol=1e-12)
    # Up in the world is up in the image (y grows downwards), and the horizon is level.
    up = rotation[:, :, 2]
    assert (up[:, 1] < 0).all()
    np.testing.assert_allclose(up[:, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("frames", [2, 16, 160])
def test_samples_are_finite_repeatable_and_mostly_show_the_target(frames):
    first = sample_batch(bank(), np.random.default_rng(3), 12, frames)
    again = sample_batch(bank(), np.random.default_rng(3), 12, frames)
    assert first.features.shape == (12, frames, FEATURES)
    assert first.target.shape == (12, frames, 15, 3)
    assert np.isfinite(first.features).all()
    assert np.isfinite(first.target).all()
    assert np.array_equal(first.features, again.features)
    assert np.array_equal(first.target, again.target)
    seen = first.features[..., 30:45] > 0
    gap = np.linalg.norm(first.features[..., :30].reshape(12, frames, 15, 2) - first.target[..., :2], axis=-1)
    assert np.median(gap[seen]) < 0.1


def test_length_and_reach_features_agree_with_the_truth():
    batch = sample_batch(bank(), np.random.default_rng(5), 60, 64)
    length, reach = batch.features[..., 45:59], batch.features[..., 59:73]
    told = (length > 0).all(axis=(1, 2))
    assert 0.3 < told.mean() < 0.9
    bones = BODY_15.bones
    span = batch.target[:, :, bones[:, 1]] - batch.target[:, :, bones[:, 0]]
    true = np.median(np.linalg.norm(span, axis=-1), axis=1)
    np.testing.assert_allclose(np.median(length[told, 0] / true[told]), 1.0, atol=0.02)
    shown = reach[told] > 0
    assert np.median(np.abs(reach[told] - np.abs(span[told][..., 2]))[shown]) < 0.15


def test_unusable_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="at least one"):
        load_bank([])
    np.savez(tmp_path / "a.npz", X=np.full((5, 15, 3), np.nan), fps=30.0, joints=np.array(BODY_15.joints))
    with pytest.raises(InputError, match="finite"):
        load_bank([tmp_path / "a.npz"])


def test_a_short_training_learns_and_its_network_runs(tmp_path):
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    from drocap_ros.reconstruction.lifted.lifter import Lifter
    from drocap_ros.training.lifter import LifterTraining, export_onnx, train

    def error(network) -> float:
        export_onnx(network, tmp_path / "t.onnx", {"command": "test"})
        batch = sample_batch(bank(), np.random.default_rng(9), 8, 64)
        import onnxruntime

        session = onnxruntime.InferenceSession(str(tmp_path / "t.onnx"), providers=["CPUExecutionProvider"])
        joints = session.run(["joints"], {"features": batch.features})[0]
        return float(np.linalg.norm(joints - batch.target, axis=-1).mean())

    options = LifterTraining(minutes=0.05, width=32, frames_per_batch=640)
    kept = []
    network, facts = train(bank(), options, lambda line: None, lambda n, f: kept.append(f), checkpoint_minutes=0.0)
    assert facts["steps"] >= 2
    assert facts["frames_seen"] > 0
    assert kept
    from drocap_ros.training.lifter import build_network

    assert error(network) < error(build_network(32))
    lifted = Lifter.load(tmp_path / "t.onnx").lift(np.random.default_rng(0).normal(size=(9, 15, 2)))
    assert np.isfinite(lifted.joints).all()
