"""The E-step: each kind of evidence against direct summation."""

from __future__ import annotations

import numpy as np
import pytest
from walking import Walk

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.paper.expectation import GaussianJoints, HeatmapJoints, MixtureJoints
from drocap_ros.reconstruction.paper.normalize import normalize_tracks
from drocap_ros.reconstruction.paper.single_view import initialize
from drocap_ros.reconstruction.reconstruction_config import InitializerConfig

ONE = np.array([1.0, 0.0, 1.0])


def test_a_joint_far_from_the_model_loses_its_credit() -> None:
    w = np.zeros((1, 3, 2))
    joints = GaussianJoints(w, np.tile(ONE, (1, 3, 1)))
    projected = np.array([[[0.0, 0.0], [0.1, 0.0], [1.5, 0.0]]])
    believed, information = joints.expect(projected, 0.1)
    np.testing.assert_array_equal(believed, w)
    assert information[0, 0, 0] > 0.99
    assert information[0, 0, 0] > information[0, 1, 0] > 0.9
    assert information[0, 2, 0] < 1e-6


def test_a_missing_joint_stays_missing() -> None:
    joints = GaussianJoints(np.zeros((1, 1, 2)), np.zeros((1, 1, 3)))
    assert np.all(joints.expect(np.zeros((1, 1, 2)), 0.1)[1] == 0.0)


def test_a_mixture_of_one_candidate_is_a_gaussian() -> None:
    rng = np.random.default_rng(0)
    w = rng.normal(size=(4, 15, 2))
    projected = w + 0.1 * rng.normal(size=w.shape)
    mixture = MixtureJoints(w[:, :, None], np.full((4, 15, 1, 3), [1e-9, 0.0, 1e-9]), np.ones((4, 15, 1)))
    a = mixture.expect(projected, 0.1)
    b = GaussianJoints(w, np.tile(ONE, (4, 15, 1))).expect(projected, 0.1)
    np.testing.assert_allclose(a[0], b[0], atol=1e-6)
    np.testing.assert_allclose(a[1], b[1], atol=1e-5)


def test_the_candidate_near_the_model_wins() -> None:
    means = np.array([[[[1.0, 0.0], [0.0, 0.0], [np.nan, np.nan]]]])
    covariances = np.tile(np.array([0.01, 0.0, 0.01]), (1, 1, 3, 1))
    joints = MixtureJoints(means, covariances, np.array([[[0.7, 0.3, 0.0]]]))
    np.testing.assert_array_equal(joints.start()[0], [[[1.0, 0.0]]])
    believed, information = joints.expect(np.array([[[0.02, 0.0]]]), 0.1)
    np.testing.assert_allclose(believed, [[[0.0, 0.0]]], atol=1e-6)
    assert information[0, 0, 0] == pytest.approx(0.5, rel=0.05)  # 1 / (0.1^2 + 0.01) in units of 1 / 0.1^2


def test_a_heatmap_is_summed_against_the_model() -> None:
    rng = np.random.default_rng(1)
    maps = rng.uniform(size=(2, 3, 9, 7))
    corner, cell, std = np.array([[-0.3, -0.4], [0.1, 0.0]]), 0.1, 0.2
    projected = rng.uniform(-0.3, 0.5, (2, 3, 2))
    believed, information = HeatmapJoints(maps, corner, cell).expect(projected, std)
    for f in range(2):
        x = corner[f, 0] + cell * np.arange(7)
        y = corner[f, 1] + cell * np.arange(9)
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        for p in range(3):
            weight = maps[f, p] * np.exp(-0.5 * np.sum((grid - projected[f, p]) ** 2, axis=-1) / std**2)
            np.testing.assert_allclose(believed[f, p], np.sum(weight[..., None] * grid, (0, 1)) / weight.sum())
            expected = min(2.0 * weight.sum() / maps[f, p].sum(), 1.0)
            np.testing.assert_allclose(information[f, p], expected * ONE)


def test_candidates_rescue_what_the_highest_peak_gets_wrong(walk: Walk, dictionary: Dictionary) -> None:
    """The larger peak of a wrist lies on the other wrist in every third frame; the true one is the smaller."""
    n = normalize_tracks(Keypoints2D(walk.keypoints))
    wrong = n.w.copy()
    frames = np.arange(len(wrong)) % 3 == 0
    wrong[frames, 11], wrong[frames, 14] = n.w[frames, 14], n.w[frames, 11]
    means = np.stack([wrong, n.w], axis=2)
    joints = MixtureJoints(means, np.full((*means.shape[:3], 3), [1e-4, 0.0, 1e-4]), np.tile([0.6, 0.4], (120, 15, 1)))
    truth = 1000.0 * walk.in_camera
    config = InitializerConfig(em_rounds=0)
    blind = initialize(wrong, n.information, dictionary, config)
    aware = initialize(wrong, n.information, dictionary, InitializerConfig(em_rounds=3), joints=joints)
    swapped = pa_mpjpe(blind.camera_shape, truth)[frames].mean()
    rescued = pa_mpjpe(aware.camera_shape, truth)[frames].mean()
    assert rescued < 0.9 * swapped


def test_impossible_evidence_is_refused() -> None:
    means = np.zeros((1, 1, 1, 2))
    with pytest.raises(InputError, match="candidates: expected means"):
        MixtureJoints(means, np.zeros((1, 1, 3)), np.ones((1, 1, 1)))
    with pytest.raises(InputError, match="positive definite"):
        MixtureJoints(means, np.zeros((1, 1, 1, 3)), np.ones((1, 1, 1)))
    with pytest.raises(InputError, match="heatmaps: expected finite"):
        HeatmapJoints(np.full((1, 1, 4, 4), np.nan), np.zeros((1, 2)), 0.1)
    with pytest.raises(InputError, match="positive cell"):
        HeatmapJoints(np.ones((1, 1, 4, 4)), np.zeros((1, 2)), 0.0)
