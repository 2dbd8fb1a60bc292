"""Triangular solves by blocks against those of the whole band."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg.lapack import dtbtrs

from drocap_ros.reconstruction.common.engine import backward, band_factor, forward


@pytest.mark.parametrize(("size", "width"), [(5, 9), (1200, 115), (1203, 115), (2500, 115), (3700, 7), (2600, 1300)])
def test_blocks_give_the_solution_of_the_whole(size: int, width: int) -> None:
    rng = np.random.default_rng(0)
    band = rng.normal(size=(size, width))
    band[:, 0] = 3.0 * width
    factor = band_factor(band)
    assert factor is not None
    right = rng.normal(size=(size, 4))
    for ours, trans in ((forward, "N"), (backward, "T")):
        whole = dtbtrs(factor, right, uplo="L", trans=trans)[0]
        np.testing.assert_allclose(ours(factor, right), whole, rtol=1e-9, atol=1e-12)


def test_columns_that_begin_late_and_die_away_have_the_same_solution() -> None:
    rng = np.random.default_rng(2)
    band = rng.normal(size=(3700, 115))
    band[:, 0] = 3.0 * 115
    factor = band_factor(band)
    assert factor is not None
    row = np.arange(3700)[:, None]
    first, last = np.array([0, 0, 1199, 1200, 1201, 3699]), np.array([3699, 5, 1200, 3000, 1201, 3699])
    right = rng.normal(size=(3700, 6)) * ((row >= first) & (row <= last))
    right[2000, 1] = 1.0  # after its solution has died away
    whole = dtbtrs(factor, right, uplo="L")[0]
    np.testing.assert_allclose(forward(factor, right), whole, rtol=1e-9, atol=1e-12)


def test_single_precision_solves_a_well_conditioned_band_to_six_digits() -> None:
    rng = np.random.default_rng(1)
    band = rng.normal(size=(2500, 115))
    band[:, 0] = 3.0 * 115
    single, double = band_factor(band.astype(np.float32)), band_factor(band)
    assert single is not None
    assert double is not None
    assert single.dtype == np.float32
    right = rng.normal(size=(2500, 4))
    for solve in (forward, backward):
        found = solve(single, right)
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, solve(double, right), rtol=1e-4, atol=1e-7)


def test_a_band_that_is_not_positive_definite_has_no_factor() -> None:
    assert band_factor(np.array([[1.0, 2.0], [1.0, 0.0]])) is None
