"""Cholesky factors of symmetric bands, and triangular solves of many right sides in pieces that the cache holds."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import as_strided

#: Unknowns per piece: ten to twenty times the band's usual width.
_PIECE = 1200


def band_factor(band: np.ndarray) -> np.ndarray | None:
    """Lower factor (W, N) of the band (N, W), whose element [i, d] couples unknowns i and i + d; destroys the band.

    None = not positive definite.  In single precision it takes half the time: enough for a step that a line search
    checks.
    """
    from scipy.linalg import get_lapack_funcs

    factor, info = get_lapack_funcs("pbtrf", (band,))(band.T, lower=1, overwrite_ab=1)
    return factor if info == 0 else None


def forward(factor: np.ndarray, right: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
    """(N, K) solution of factor times solution = right, in double precision whatever that of the factor.

    first : (K,) ascending, row of the first element of each column that is not 0; None = row 0
    """
    from scipy.linalg import get_lapack_funcs

    solve = get_lapack_funcs("tbtrs", (factor,))
    out = np.zeros(right.shape, factor.dtype)
    reach = len(factor) - 1
    for begin, end in _pieces(factor):
        begun = right.shape[1] if first is None else int(np.searchsorted(first, end))
        part = np.array(right[begin:end, :begun], factor.dtype, order="F")
        if begin:
            part[:reach] -= (_coupling(factor, begin) @ out[begin - reach : begin, :begun])[: len(part)]
        out[begin:end, :begun] = solve(factor[:, begin:end], part, uplo="L", overwrite_b=1)[0]
    return out.astype(np.float64, copy=False)


def backward(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, K) solution of the factor's transpose times solution = right, as of :func:`forward`."""
    from scipy.linalg import get_lapack_funcs

    solve = get_lapack_funcs("tbtrs", (factor,))
    out = np.empty(right.shape, factor.dtype)
    reach = len(factor) - 1
    for begin, end in reversed(_pieces(factor)):
        part = np.array(right[begin:end], factor.dtype, order="F")
        if end < len(right):
            after = out[end : end + reach]
            part[-reach:] -= (_coupling(factor, end)[: len(after)].T @ after)[-len(part) :]
        out[begin:end] = solve(factor[:, begin:end], part, uplo="L", trans="T", overwrite_b=1)[0]
    return out.astype(np.float64, copy=False)


def _pieces(factor: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of unknowns, each but the last longer than the band is wide."""
    width, size = factor.shape
    step = max(_PIECE, width)
    return [(begin, min(begin + step, size)) for begin in range(0, size, step)]


def _coupling(factor: np.ndarray, begin: int) -> np.ndarray:
    """(W - 1, W - 1) of the factor: rows from ``begin`` on, columns before it."""
    width = len(factor)
    reach = width - 1
    flat = factor.T.reshape(-1)[(begin - reach) * width + reach :]
    # In the band's memory, row i of column j is element i + (W - 1) j.  The triangle beyond the band holds others.
    rows = min(reach, factor.shape[1] - begin)
    item = flat.itemsize
    square = as_strided(flat, (rows, reach), (item, item * reach), writeable=False)
    return np.where(_upper(rows, reach), square, square.dtype.type(0))


@lru_cache(maxsize=16)
def _upper(rows: int, columns: int) -> np.ndarray:
    """Mask (R, C) of the upper triangle.  It is kept: NumPy's ``triu`` builds a new one for every matrix."""
    return np.triu(np.ones((rows, columns), bool))
