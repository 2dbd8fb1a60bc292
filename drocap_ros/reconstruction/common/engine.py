"""The least-squares engine of body, world and camera: a band of the frames' unknowns, bordered by what they share.

A problem gives its point: cost, gradient, the Gauss-Newton equations there, and the point after a step.  Unknowns of a
frame are coupled with those of the next frames only, so the equations are a symmetric band; unknowns of the whole
recording are its border.  Here are their solution, the search along the step, and the covariances at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol, TypeVar

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


@contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit BLAS to ``count`` threads.

    The solvers multiply thousands of small matrices: a second thread gains nothing, costs a factor of twenty while
    another process uses the core (measured), and makes the last bits depend on the machine.  Without threadpoolctl
    the environment's setting (``OMP_NUM_THREADS``) applies.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        yield
        return
    # The limit covers only loaded libraries: scipy has a BLAS beside numpy's.  OpenCV's third one may come at any
    # time, so that the libraries are looked up at each call (1 ms, measured).
    import scipy.linalg  # noqa: F401

    with threadpool_limits(limits=count, user_api="blas"):
        yield


def usual_outlier(square: np.ndarray, least: float) -> float:
    """Squared residual, in standard deviations, at which an observation has half its weight.

    Far from the solution all are large: then it is twice the usual one.
    """
    return max(least, 4.0 * float(np.median(square))) if len(square) else least


class Equations(NamedTuple):
    """Normal equations of N unknowns of the frames and S shared ones.

    band : (N, W), element [i, d] couples unknowns i and i + d; border : (N, S); corner : (S, S)
    """

    band: np.ndarray
    border: np.ndarray
    corner: np.ndarray

    def step(self, frames: np.ndarray, shared: np.ndarray, held: bool = False) -> tuple[np.ndarray, np.ndarray] | None:
        """The step from the gradient by the frames' unknowns, of any shape, and the shared ones; destroys the band.

        held : the shared unknowns stay as they are.  None = not positive definite
        """
        factor = band_factor(self.band)
        if factor is None:
            return None
        if held:
            step = backward(factor, forward(factor, -frames.reshape(-1, 1)))
            return step.reshape(frames.shape), np.zeros(len(shared))
        # Half of a solve for every column, the other half for the answer alone.
        y = forward(factor, np.concatenate([-frames.reshape(-1, 1), self.border], axis=1))
        square = y.T @ y
        step = np.linalg.solve(self.corner - square[1:, 1:], -shared - square[1:, 0])
        return backward(factor, y[:, :1] - y[:, 1:] @ step[:, None]).reshape(frames.shape), step


class Costed(Protocol):
    """What has a cost that is to be as low as possible."""

    @property
    def cost(self) -> float:
        """That cost."""


class Point(Costed, Protocol):
    """One point of a problem."""

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Its derivatives by the frames' unknowns, in the shape of a step, and by the shared ones."""


_There = TypeVar("_There", bound=Costed)
_Point = TypeVar("_Point", bound=Point)


def descend(
    here: _Point,
    equations: Equations,
    moved: Callable[[np.ndarray, np.ndarray], _Point | None],
    held: bool = False,
) -> _Point | None:
    """A lower point along the step of the equations, or None.

    moved : the point after a step, None = not allowed; held : the shared unknowns stay
    """
    frames, shared = here.gradient()
    step = equations.step(frames, shared, held)
    if step is None:
        return None
    slope = float((frames * step[0]).sum() + shared @ step[1])
    return search_line(here.cost, slope, lambda share: moved(share * step[0], share * step[1]))


def search_line(cost: float, slope: float, point_at: Callable[[float], _There | None]) -> _There | None:
    """A point whose cost is at most ``cost``: the step's end, or where parabolas through the points put the minimum.

    slope : derivative of the cost along the step at its beginning
    point_at : point at a share of the step; None = not allowed
    returns : None where ten points have a higher cost, one that is not finite, or are not allowed
    """
    share = 1.0
    for _ in range(10):
        there = point_at(share)
        if there is not None and there.cost <= cost:
            return there
        high = there.cost if there is not None and math.isfinite(there.cost) else math.inf
        bend = (high - cost) / share - slope
        share *= min(max(-0.5 * slope / max(bend, 1e-300), 0.1), 0.5)
    return None


class Covariances:
    """Covariances at a unit variance of every residual, from the equations at the solution.

    shared : (S, S) of the shared unknowns
    lever : (N, S) change of the frames' unknowns by the shared ones, with the sign turned
    """

    def __init__(self, factor: np.ndarray, half: np.ndarray, shared: np.ndarray) -> None:
        self._factor, self.shared, self.lever = factor, shared, backward(factor, half)

    @staticmethod
    def of(equations: Equations) -> Covariances | None:
        """None where the equations are not positive definite; their band is destroyed."""
        factor = band_factor(equations.band)
        if factor is None:
            return None
        half = forward(factor, equations.border)
        try:
            inverse = np.linalg.inv(np.linalg.cholesky(equations.corner - half.T @ half))
        except np.linalg.LinAlgError:
            return None
        return Covariances(factor, half, inverse.T @ inverse)

    def of_frames(self, columns: np.ndarray) -> np.ndarray:
        """The inverse of the band alone, times columns (N, K)."""
        return backward(self._factor, forward(self._factor, columns))

    def blocks(self, size: int, dtype: type = np.float64) -> tuple[np.ndarray, np.ndarray]:
        """(F, n, n) diagonal blocks of the inverse of the band, and (F - 1, n, n) beside them.

        Source: Takahashi, Fagan, Chin 1973, by blocks as wide as the band's reach: only what it couples is computed.
        Blocks are sums of squares, so single precision, which takes half the time, keeps four digits of them.
        """
        from scipy.linalg import get_lapack_funcs

        width, unknowns = self._factor.shape
        wide = -(-(width - 1) // size) * size  # whole frames
        count = -(-unknowns // wide)
        lower = np.zeros((count, wide, 2 * wide), dtype)
        for i in range(wide):  # element [d, c] of the factor couples column c with row c + d
            columns = np.arange(i, unknowns, wide)
            lower[: len(columns), i, i : i + width] = self._factor[:, columns].T
        if unknowns % wide:
            fill = np.arange(unknowns % wide, wide)
            lower[-1, fill, fill] = 1.0
        invert = get_lapack_funcs("trtri", (lower,))
        own, beside = np.empty((2, count * wide // size, size, size))
        later: np.ndarray = np.zeros((wide, wide), dtype)
        for block in range(count - 1, -1, -1):
            inverse = invert(lower[block, :, :wide].T, lower=1)[0]
            down = lower[block, :, wide:].T @ inverse
            off = -later @ down
            here = inverse.T @ inverse - down.T @ off
            later = 0.5 * (here + here.T)  # rounding of the skew part would grow from block to block
            both = np.concatenate([later, off])
            for frame in range(wide // size):
                at = slice(frame * size, (frame + 1) * size)
                own[block * wide // size + frame] = later[at, at]
                beside[block * wide // size + frame] = both[at.stop : at.stop + size, at].T
        frames = unknowns // size
        return own[:frames], beside[: frames - 1]


def second_difference(values: np.ndarray) -> np.ndarray:
    """(F - 2, ...) of values (F, ...)."""
    return np.asarray(values[2:] - 2 * values[1:-1] + values[:-2])


def pull_second_difference(into: np.ndarray, pull: np.ndarray) -> None:
    """Add the gradient of second differences whose own gradient is ``pull`` (F - 2, ...)."""
    into[2:] += pull
    into[1:-1] -= 2 * pull
    into[:-2] += pull


def add_second_difference(weight: np.ndarray | float, own: np.ndarray, after: np.ndarray, beyond: np.ndarray) -> None:
    """Add second differences of a weight to the couplings (F, ...) of an unknown.

    That is with itself, with itself one frame on, and two frames on.
    """
    count = len(own) - 2
    if count > 0:
        for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
            own[offset : count + offset] += factor * weight
        after[:count] -= 2 * weight
        after[1:-1] -= 2 * weight
        beyond[:count] += weight
