"""Cholesky factors of symmetric bands, and triangular solves of many right sides by the blocks of a wide band."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided

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
    """(N, K) solution of factor times solution = right, in double precision whatever that of the factor.

    Of a column only the rows count from its first element that is not 0 to where the solution has died away.
    """
    from scipy.linalg import get_blas_funcs

    if len(factor) <= _NARROW or right.shape[1] <= _FEW:
        return _whole(factor, right, "N")
    multiply, solve = get_blas_funcs(("trmm", "trsm"), (factor,))
    flat, reach = factor.T.reshape(-1), len(factor) - 1
    there = right != 0.0
    start, stop = there.argmax(axis=0), len(right) - there[::-1].argmax(axis=0)
    out = np.zeros(right.shape, factor.dtype)
    peak, alive = np.zeros(right.shape[1]), np.zeros(right.shape[1], bool)
    for begin, end in _blocks(factor):
        which = np.flatnonzero((start < end) & ((stop > begin) | alive))
        part = np.array(right[begin:end, which], factor.dtype, order="F")
        if begin:
            before = np.array(out[begin - reach : begin, which], order="F")
            part -= multiply(1.0, _coupling(flat, reach, begin), before)[: len(part)]
        part = solve(1.0, _triangle(flat, reach, begin, end), part, lower=1, overwrite_b=1)
        out[begin:end, which] = part
        size = np.abs(part).max(axis=0, initial=0.0)
        peak[which] = np.maximum(peak[which], size)
        alive[which] = size > _DIED * peak[which]
    return out.astype(np.float64, copy=False)


def backward(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, K) solution of the factor's transpose times solution = right, as of :func:`forward`."""
    from scipy.linalg import get_blas_funcs

    if len(factor) <= _NARROW or right.shape[1] <= _FEW:
        return _whole(factor, right, "T")
    multiply, solve = get_blas_funcs(("trmm", "trsm"), (factor,))
    flat, reach = factor.T.reshape(-1), len(factor) - 1
    out = np.empty(right.shape, factor.dtype)
    for begin, end in reversed(_blocks(factor)):
        part = np.array(right[begin:end], factor.dtype, order="F")
        if end < len(right):
            after = np.zeros((reach, right.shape[1]), factor.dtype, order="F")
            after[: len(right) - end] = out[end : end + reach]
            part -= multiply(1.0, _coupling(flat, reach, end), after, trans_a=1)
        out[begin:end] = solve(1.0, _triangle(flat, reach, begin, end), part, lower=1, trans_a=1, overwrite_b=1)
    return out.astype(np.float64, copy=False)


def _whole(factor: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
    """Solution (N, K) column by column."""
    from scipy.linalg import get_lapack_funcs

    solve = get_lapack_funcs("tbtrs", (factor,))
    found = solve(factor, np.array(right, factor.dtype, order="F"), uplo="L", trans=trans, overwrite_b=1)[0]
    return np.asarray(found, np.float64)


def _blocks(factor: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of unknowns: in blocks one narrower than the band, triangles lie in its memory as LAPACK's matrices do."""
    width, size = factor.shape
    return [(begin, min(begin + width - 1, size)) for begin in range(0, size, width - 1)]


def _triangle(flat: np.ndarray, reach: int, begin: int, end: int) -> np.ndarray:
    """Lower triangle (B, B) of the factor at these unknowns; what lies above it is of other unknowns."""
    # In the band's memory, row i of column j is element i + (W - 1) j.
    steps = (flat.itemsize, flat.itemsize * reach)
    return as_strided(flat[begin * (reach + 1) :], (end - begin, end - begin), steps, writeable=False)


def _coupling(flat: np.ndarray, reach: int, begin: int) -> np.ndarray:
    """Upper triangle (B, B) of the factor: rows from ``begin`` on, columns before it; below it lie other unknowns."""
    place = (begin - reach) * (reach + 1) + reach
    return flat[place : place + reach**2].reshape((reach, reach), order="F")
