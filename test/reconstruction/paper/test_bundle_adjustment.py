"""Bundle adjustment: descent, invariances, exact recovery, missing joints, reasons to stop."""

from __future__ import annotations

import numpy as np
import pytest
from walking import Walk, make_walk

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.paper.bundle_adjustment import AdjustmentResult, bundle_adjust
from drocap_ros.reconstruction.paper.reprojection import information_from


def units(walk: Walk) -> tuple[np.ndarray, float]:
    """Measurements in units of their standard deviation, and units per metre."""
    flat = walk.in_camera[..., :2]
    flat = flat - flat.mean(1, keepdims=True)
    return flat / flat.std(), 1.0 / flat.std()


def disturbed(walk: Walk, scale: float, amount: float = 0.15) -> np.ndarray:
    """A start in camera axes whose depths are wrong, each joint by a constant and a slow drift."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 6.0, len(walk.shape))
    start = walk.in_camera * scale
    wrong = rng.normal(size=15) + np.sin(t[:, None] + rng.uniform(0.0, 6.0, 15))
    start[..., 2] += amount * wrong
    return start


def adjust(w: np.ndarray, start: np.ndarray, config: BundleAdjusterConfig | None = None) -> AdjustmentResult:
    return bundle_adjust(w, information_from(w, None, None), start, config)


@pytest.fixture(scope="module")
def adjusted() -> tuple[Walk, np.ndarray, AdjustmentResult]:
    walk = make_walk(120)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    return walk, start, adjust(w, start, BundleAdjusterConfig(iterations=500))


def test_wrong_initial_depths_are_corrected(adjusted: tuple[Walk, np.ndarray, AdjustmentResult]) -> None:
    walk, start, result = adjusted
    before = pa_mpjpe(start, 1000.0 * walk.in_camera).mean()
    after = pa_mpjpe(result.camera_shape, 1000.0 * walk.in_camera).mean()
    assert before > 30.0
    assert after < 6.0


def test_cost_never_rises(adjusted: tuple[Walk, np.ndarray, AdjustmentResult]) -> None:
    result = adjusted[2]
    assert np.all(np.diff(result.history) <= 1e-9 * result.history[0])
    assert result.cost == pytest.approx(sum(result.cost_terms.values()))
    assert result.cost == pytest.approx(result.history[-1], rel=1e-6)


def test_cost_never_rises_with_strong_nuclear_norm() -> None:
    walk = make_walk(60)
    w, scale = units(walk)
    config = BundleAdjusterConfig(iterations=600, gamma=0.0, alpha=3.0, tolerance=0.0)
    result = adjust(w, disturbed(walk, scale), config)
    assert np.all(np.diff(result.history) <= 1e-9 * result.history[0])


def test_limb_ratios_become_constant(adjusted: tuple[Walk, np.ndarray, AdjustmentResult]) -> None:
    _, start, result = adjusted

    def wobble(s: np.ndarray) -> float:
        lengths = limb_lengths(s)
        return float((lengths / lengths.sum(1, keepdims=True)).std(0).mean())

    assert wobble(result.shape) < 0.2 * wobble(start)


def test_result_scales_with_the_unit() -> None:
    """Units are the caller's: the same data in units twice as large, with the weights that go with them."""
    walk = make_walk(40)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    plain = BundleAdjusterConfig(iterations=60)
    double = BundleAdjusterConfig(iterations=60, alpha=2.0 * plain.alpha, gamma=0.25 * plain.gamma)
    a, b = adjust(w, start, plain), adjust(2.0 * w, 2.0 * start, double)
    np.testing.assert_allclose(b.camera_shape, 2.0 * a.camera_shape, atol=1e-6)


def test_result_follows_time_reversal_and_image_roll() -> None:
    walk = make_walk(40)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    config = BundleAdjusterConfig(iterations=60)
    result = adjust(w, start, config)
    backwards = adjust(w[::-1], start[::-1], config)
    np.testing.assert_allclose(backwards.camera_shape[::-1], result.camera_shape, atol=1e-7)
    roll = exp_so3(np.array([0.0, 0.0, 0.7]))
    rolled = adjust(w @ roll[:2, :2].T, start @ roll.T, config)
    np.testing.assert_allclose(rolled.camera_shape, result.camera_shape @ roll.T, atol=1e-7)


def test_values_of_missing_joints_are_ignored() -> None:
    walk = make_walk(40)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    weights = np.ones((40, 15))
    weights[5:20, 2] = 0.0
    weights[30, 6:12] = 0.0
    junk, unknown = w.copy(), w.copy()
    junk[weights == 0.0] = 77.0
    unknown[weights == 0.0] = np.nan
    a, b, c = (bundle_adjust(x, information_from(x, weights, None), start) for x in (w, junk, unknown))
    np.testing.assert_array_equal(a.camera_shape, b.camera_shape)
    np.testing.assert_array_equal(a.camera_shape, c.camera_shape)


def test_equal_covariances_equal_none() -> None:
    walk = make_walk(30)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    equal = np.broadcast_to(np.array([0.02, 0.0, 0.02]), (30, 15, 3))
    a, b = adjust(w, start), bundle_adjust(w, information_from(w, None, equal), start)
    np.testing.assert_allclose(b.camera_shape, a.camera_shape, atol=1e-9)


def test_a_joint_of_large_covariance_has_little_weight() -> None:
    walk = make_walk(60)
    w, scale = units(walk)
    w = w.copy()
    w[:, 11] += 0.8 * np.random.default_rng(0).normal(size=(60, 2))
    covariance = np.tile(np.array([0.001, 0.0, 0.001]), (60, 15, 1))
    covariance[:, 11] = [0.6, 0.0, 0.6]
    start = walk.in_camera * scale
    truth = 1000.0 * walk.in_camera
    blind = pa_mpjpe(adjust(w, start).camera_shape, truth).mean()
    aware = pa_mpjpe(bundle_adjust(w, information_from(w, None, covariance), start).camera_shape, truth).mean()
    assert aware < 0.5 * blind


def test_stop_reason_is_reported() -> None:
    walk = make_walk(30)
    w, scale = units(walk)
    start = walk.in_camera * scale
    short = adjust(w, start, BundleAdjusterConfig(iterations=7))
    assert (short.stop_reason, short.iterations) == ("iterations", 7)
    long = adjust(w, start, BundleAdjusterConfig(iterations=5000, tolerance=1e-4))
    assert long.stop_reason == "converged"
    assert long.iterations < 5000


def test_equal_input_gives_equal_bits() -> None:
    walk = make_walk(30)
    w, scale = units(walk)
    start = disturbed(walk, scale)
    np.testing.assert_array_equal(adjust(w, start).shape, adjust(w, start).shape)


@pytest.mark.parametrize(
    ("w", "s0", "match"),
    [
        (np.zeros((15, 2)), np.zeros((5, 15, 3)), r"w: expected shape \(F, P, 2\)"),
        (np.zeros((5, 15, 2)), np.zeros((4, 15, 3)), r"s0: expected finite values of shape \(5, 15, 3\)"),
        (np.zeros((5, 15, 2)), np.full((5, 15, 3), np.nan), "s0: expected finite"),
    ],
)
def test_wrong_shapes_are_refused(w: np.ndarray, s0: np.ndarray, match: str) -> None:
    with pytest.raises(InputError, match=match):
        bundle_adjust(w, np.ones((5, 15, 3)), s0)


def test_a_window_of_pure_noise_keeps_a_body() -> None:
    rng = np.random.default_rng(0)
    w, walk = rng.normal(size=(30, 15, 2)), make_walk(30)
    result = adjust(w, walk.in_camera / 0.35)
    assert np.isfinite(result.shape).all()
    assert limb_lengths(result.shape).mean() > 0.1


def test_noise_raises_the_weight_of_the_nuclear_norm() -> None:
    walk = make_walk(240)
    w, scale = units(walk)
    noisy = w + np.random.default_rng(0).normal(0.0, 0.04, w.shape)
    start, truth = disturbed(walk, scale), 1000.0 * walk.in_camera
    aware = adjust(noisy, start)
    blind = adjust(noisy, start, BundleAdjusterConfig(noise_alpha=0.0))
    assert pa_mpjpe(aware.camera_shape, truth).mean() < 0.9 * pa_mpjpe(blind.camera_shape, truth).mean()
    clean = [adjust(w, start, BundleAdjusterConfig(noise_alpha=n)).shape for n in (0.0, 0.5)]
    np.testing.assert_array_equal(clean[0], clean[1])
