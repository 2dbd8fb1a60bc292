"""MF+NNM: exact recovery of a low-rank motion under a rotating camera, signs, gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from angles import angle_between
from walking import make_walk

from drocap_ros.evaluation.metrics import is_mirrored, pa_mpjpe
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.paper.mf_nnm import (
    factorize,
    fill_joints,
    minimize_nuclear_norm,
    rotations_by_factorization,
)
from drocap_ros.reconstruction.paper.reprojection import information_from
from lab.studies.protocol import orbit_rotations

FRAMES = 150


@dataclass(frozen=True)
class LowRank:
    camera: np.ndarray
    rotation: np.ndarray

    @property
    def w(self) -> np.ndarray:
        return self.camera[..., :2]


@pytest.fixture(scope="module")
def motion() -> LowRank:
    """A body of three basis shapes, three turns of the camera; unit size."""
    rng = np.random.default_rng(3)
    basis = np.concatenate([make_walk(1).shape / 0.35, 0.5 * rng.normal(size=(2, 15, 3))])
    basis -= basis.mean(1, keepdims=True)
    t = np.linspace(0.0, 1.0, FRAMES)
    mixing = np.stack([np.ones(FRAMES), np.sin(9.0 * t), np.cos(17.0 * t)], axis=1)
    rotation = orbit_rotations(FRAMES, 3.0 * 360.0 / FRAMES * 24.0)
    return LowRank(np.einsum("fk,kpi->fpi", mixing, basis) @ np.swapaxes(rotation, 1, 2), rotation)


def test_rotations_are_exact_up_to_the_common_frame_and_mirroring(motion: LowRank) -> None:
    found = rotations_by_factorization(motion.w, 3)
    flip = np.diag([1.0, 1.0, -1.0])
    angles = []
    for candidate in (found, flip @ found @ flip):
        relative = np.swapaxes(candidate, 1, 2) @ motion.rotation
        angles.append(float(angle_between(relative[:1], relative).max()))
    assert min(angles) < np.deg2rad(0.01)


def test_shapes_are_exact_for_known_rotations(motion: LowRank) -> None:
    information = information_from(motion.w, None, None)
    s, config = None, BundleAdjusterConfig(iterations=300, tolerance=0.0)
    for alpha in (3.0, 1.0, 0.3, 0.1, 0.03, 0.01):
        config = BundleAdjusterConfig(alpha=alpha, gamma=0.0, iterations=300, tolerance=0.0)
        s, _ = minimize_nuclear_norm(motion.w, information, motion.rotation, config, initial=s)
    poses = s @ np.swapaxes(motion.rotation, 1, 2)
    assert pa_mpjpe(poses, motion.camera).mean() < 1e-3


def test_the_walk_is_not_mirrored(dictionary: Dictionary) -> None:
    walk = make_walk(240, speed_deg_s=90.0)
    w = walk.in_camera[..., :2] / 0.35
    poses, report = factorize(w, information_from(w, None, None), dictionary, BundleAdjusterConfig())
    truth = 1000.0 * walk.in_camera
    assert not is_mirrored(poses, truth)
    assert pa_mpjpe(poses, truth).mean() < 40.0
    assert report.iterations > 0
    assert report.stop_reason in ("converged", "iterations")
    assert set(report.cost_terms) >= {"reprojection", "nuclear_norm"}


def test_gaps_are_interpolated_over_time() -> None:
    w = np.stack([np.arange(5.0), 10.0 - np.arange(5.0)], axis=-1)[:, None].repeat(2, axis=1)
    seen = np.ones((5, 2), dtype=bool)
    seen[1:3, 0] = False
    broken = np.where(seen[..., None], w, 99.0)
    np.testing.assert_allclose(fill_joints(broken, seen), w)
