"""Cholesky factors of symmetric bands, and triangular solves of many right sides by the blocks of a wide band."""

from __future__ import annotations

import numpy as np

#: Width of a band, and number of columns, up to which blocks are too small: calls would take longer than the sums.
_NARROW, _FEW = 48, 4
#: Share of its largest element below which a column's solution counts as 0.  It falls exponentially, in the end to
#: numbers so small that processors take a hundred times as long for them.
_DIED = 1e-12


def band_factor(band: np.ndarray) -> np.ndarray | None:
    """Lower factor (W, N) of the band (N, W), whose element [i, d] couples unknowns i and i + d; destroys the band.

    None = not positive definite.  In single precision it takes half the time: enough for a step that a line search
    checks.
    """
    from scipy.linalg import get_lapack_funcs

    factor, info = get_lapack_funcs("pbtrf", (band,))(band.T, lower=1, overwrite_ab=1)
    return factor if info == 0 else None


def forward(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, K) solution of factor times solution = right, in double precision whatever that of the factor."""
    from scipy.linalg import get_blas_funcs

    if len(factor) <= _NARROW or right.shape[1] <= _FEW:
        return _whole(factor, right, "N")
    multiply, solve = get_blas_funcs(("trmm", "trsm"), (factor,))
    flat, reach = factor.T.reshape(-1), len(factor) - 1
    out = np.array(right, factor.dtype, order="C")
    peak = np.zeros(right.shape[1], factor.dtype)
    for begin in range(0, len(out), reach):
        rows = out[begin : begin + reach]
        if begin:
            coupled = multiply(1.0, _coupling(flat, reach, begin), out[begin - reach : begin].T, side=1, trans_a=1)
            rows -= coupled.T[: len(rows)]
        # Rows of NumPy's are columns of BLAS: transposed, they are solved in their place.
        solve(1.0, _triangle(flat, reach, begin, len(rows)), rows.T, side=1, lower=1, trans_a=1, overwrite_b=1)
        size = np.abs(rows).max(axis=0)
        peak = np.maximum(peak, size)
        rows *= size > _DIED * peak
    return out.astype(np.float64, copy=False)


def backward(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, K) solution of the factor's transpose times solution = right, as of :func:`forward`."""
    from scipy.linalg import get_blas_funcs

    if len(factor) <= _NARROW or right.shape[1] <= _FEW:
        return _whole(factor, right, "T")
    multiply, solve = get_blas_funcs(("trmm", "trsm"), (factor,))
    flat, reach = factor.T.reshape(-1), len(factor) - 1
    out = np.zeros((len(right) + reach, right.shape[1]), factor.dtype)  # the last block has nothing after it
    out[: len(right)] = right
    for begin in reversed(range(0, len(right), reach)):
        end = min(begin + reach, len(right))
        rows = out[begin:end]
        if end < len(right):
            rows -= multiply(1.0, _coupling(flat, reach, end), out[end : end + reach].T, side=1).T
        solve(1.0, _triangle(flat, reach, begin, end - begin), rows.T, side=1, lower=1, overwrite_b=1)
    return out[: len(right)].astype(np.float64, copy=False)


def _whole(factor: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
    """Solution (N, K) column by column."""
    from scipy.linalg import get_lapack_funcs

    solve = get_lapack_funcs("tbtrs", (factor,))
    found = solve(factor, np.array(right, factor.dtype, order="F"), uplo="L", trans=trans, overwrite_b=1)[0]
    return np.asarray(found, np.float64)


def _triangle(flat: np.ndarray, reach: int, begin: int, size: int) -> np.ndarray:
    """Lower triangle (B, B) of the factor at these unknowns; what lies above it is of other unknowns."""
    # In blocks one narrower than the band, triangles lie in its memory as LAPACK's matrices do: element [i, j] is
    # i + (W - 1) j, where that is below the diagonal.
    place = begin * (reach + 1)
    return flat[place : place + reach * size].reshape((reach, size), order="F")[:size]


def _coupling(flat: np.ndarray, reach: int, begin: int) -> np.ndarray:
    """Upper triangle (B, B) of the factor: rows from ``begin`` on, columns before it; below it lie other unknowns."""
    place = (begin - reach) * (reach + 1) + reach
    return flat[place : place + reach**2].reshape((reach, reach), order="F")
