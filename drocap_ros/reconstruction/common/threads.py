"""Threads of the linear algebra while a solver runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit BLAS to ``count`` threads.

    The solvers multiply thousands of small matrices: a second thread gains nothing, costs a factor of twenty while
    another process uses the core (measured), and makes the last bits depend on the machine.  Without threadpoolctl
    the environment's setting (``OMP_NUM_THREADS``) applies.
    """
    controller = _controller()
    if controller is None:
        yield
    else:
        with controller.limit(limits=count, user_api="blas"):
            yield


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController | None:
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    # The controller covers only loaded libraries: scipy has a BLAS beside numpy's.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
