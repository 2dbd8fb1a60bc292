"""Dictionary learning: the shipped one, a learned one and its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walking import make_walk

from drocap_ros.errors import InputError
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.reconstruction.paper.dictionary import (
    Dictionary,
    load_dictionary,
    normalize_poses,
    soft_threshold,
    sparse_code,
)
from drocap_ros.skeleton import BODY_15
from lab.training.dictionary import Learning, learn, mirror_poses, quality, save_dictionary


def test_shipped_dictionary_names_its_origin(dictionary: Dictionary) -> None:
    m = dictionary.metadata
    assert m["include"] == "cmu_*"
    assert "CMU" in m["licence"][0]
    assert m["files"] > 100
    assert "learn-dictionary" in m["command"]
    assert m["reconstruction_error_mm"] < 20.0
    assert m["mean_active_atoms"] < 25.0
    np.testing.assert_allclose(np.linalg.norm(dictionary.atoms, axis=(1, 2)), 1.0, atol=1e-5)


def test_shipped_mean_pose_is_symmetric(dictionary: Dictionary) -> None:
    np.testing.assert_allclose(mirror_poses(dictionary.mean), dictionary.mean, atol=1e-6)
    assert np.all(np.diff(dictionary.component_std) <= 1e-9)


def test_held_out_people_are_fitted(dictionary: Dictionary, shared: Path) -> None:
    poses = normalize_poses(load_mocap(shared / "mocap" / "dev" / "cmu_03_03.npz")[0][::20])
    assert quality(dictionary, poses)["reconstruction_error_mm"] < 35.0


def test_poses_are_normalized_in_frame_and_scale() -> None:
    walk = make_walk(20)
    poses = normalize_poses(1000.0 * walk.in_camera + 3.0)
    np.testing.assert_allclose(poses.mean(1), 0.0, atol=1e-12)
    np.testing.assert_allclose(limb_lengths(poses).sum(1), 1.70 * 1.78)
    np.testing.assert_allclose(poses, normalize_poses(0.1 * walk.shape), atol=1e-12)
    up = poses[:, BODY_15.index("neck")] - poses[:, BODY_15.index("pelvis")]
    np.testing.assert_allclose(up[:, :2], 0.0, atol=1e-12)


def test_codes_satisfy_the_optimality_conditions() -> None:
    rng = np.random.default_rng(0)
    atoms = rng.normal(size=(20, 45))
    poses = rng.normal(size=(6, 45))
    c = sparse_code(poses, atoms, 2.0, iterations=3000)
    slope = (poses - c @ atoms) @ atoms.T
    assert np.all(np.abs(slope) <= 2.0 + 1e-6)
    active = np.abs(c) > 1e-9
    np.testing.assert_allclose(slope[active], 2.0 * np.sign(c[active]), atol=1e-5)
    assert 0 < active.sum() < active.size
    np.testing.assert_array_equal(soft_threshold(np.array([-3.0, 1.0]), 2.0), [-1.0, 0.0])


def learned(seed: int = 0) -> Dictionary:
    rng = np.random.default_rng(1)
    poses = normalize_poses(make_walk(300).shape + rng.normal(0.0, 0.02, (300, 15, 3)))
    return learn(poses, Learning(24, 0.01, components=8, rounds=12, batch=256, seed=seed))


def test_learning_reduces_the_error_and_is_repeatable() -> None:
    a, b = learned(), learned()
    np.testing.assert_array_equal(a.atoms, b.atoms)
    poses = normalize_poses(make_walk(50).shape)
    plain = 1000.0 * np.linalg.norm(poses - a.mean, axis=-1).mean()
    assert quality(a, poses)["reconstruction_error_mm"] < 0.3 * plain
    assert not np.array_equal(a.atoms, learned(seed=1).atoms)


def test_more_sparsity_means_fewer_active_atoms(dictionary: Dictionary) -> None:
    poses = normalize_poses(make_walk(50).shape)
    dense, sparse = (quality(replace(dictionary, sparsity=weight), poses) for weight in (0.005, 0.1))
    assert sparse["mean_active_atoms"] < dense["mean_active_atoms"]
    assert sparse["reconstruction_error_mm"] > dense["reconstruction_error_mm"]


def test_file_round_trip(tmp_path: Path) -> None:
    a = learned()
    save_dictionary(tmp_path / "d.npz", a)
    b = load_dictionary(tmp_path / "d.npz")
    np.testing.assert_allclose(b.atoms, a.atoms, atol=1e-6)
    assert b.metadata == a.metadata


def test_invalid_files_are_refused(tmp_path: Path, dictionary: Dictionary) -> None:
    path = tmp_path / "d.npz"
    with pytest.raises(InputError, match="no such file"):
        load_dictionary(path)
    np.savez(path, atoms=np.zeros(3))
    with pytest.raises(InputError, match="missing mean"):
        load_dictionary(path)
    save_dictionary(path, replace(dictionary, atoms=np.full((4, 15, 3), np.nan)))
    with pytest.raises(InputError, match="atoms: expected finite floats"):
        load_dictionary(path)
    save_dictionary(path, replace(dictionary, joints=("a", "b")))
    with pytest.raises(InputError, match="joints: expected those of body15"):
        load_dictionary(path)
