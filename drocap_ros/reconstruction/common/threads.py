"""Threads of the linear algebra while a solver runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


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
