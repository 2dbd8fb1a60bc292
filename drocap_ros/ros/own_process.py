"""A function in a process of its own: threads of one Python process take turns, processes do not."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Generic, ParamSpec, TypeVar

from drocap_ros.errors import NodeError
from drocap_ros.reconstruction.common.engine import blas_threads

_P = ParamSpec("_P")
_R = TypeVar("_R")
_log = logging.getLogger("drocap_ros")
#: Environment of a node's process.  One BLAS thread: the matrices of a node are small.  Two arenas, since each of the
#: middleware's many threads would fragment one of its own over hours; freed memory is kept, since new pages cost time.
LEAN = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_TRIM_THRESHOLD_": str(1 << 28),
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),
}


class OwnProcess(Generic[_P, _R]):
    """A function, or a method whose object lives on there, with one BLAS thread: results are those of this process.

    call : with its object, its arguments and its results it can be pickled

    The package's messages are those of the level that this process has now.
    """

    def __init__(self, call: Callable[_P, _R]) -> None:
        self._end, far_end = multiprocessing.Pipe()
        # A fork of this process would hold its threads' locks; the server of forks is for nodes (``processes.py``).
        context = multiprocessing.get_context("spawn")
        self._process = context.Process(target=_serve, args=(far_end, call, _log.level), daemon=True)
        with environment({**LEAN, **os.environ}):
            self._process.start()
        far_end.close()  # so that the death of either process ends the other's wait

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """The result of a call, or its error; one thread calls at a time.

        Raises NodeError when the process has died.
        """
        result: _R
        try:
            self._end.send((args, kwargs))
            result, error = self._end.recv()
        except (EOFError, OSError):
            self._process.join()
            raise NodeError(f"a process of this node ended with status {self._process.exitcode}") from None
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """End the process after its last call."""
        self._end.close()
        self._process.join()


@contextlib.contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Environment variables of this process while the context lasts."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _serve(end: Connection, call: Callable[..., object], level: int) -> None:
    _log.setLevel(level)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's Ctrl-C is for the command
    with end, blas_threads(1), contextlib.suppress(EOFError, OSError):  # until the other end is closed, or has died
        while True:
            args, kwargs = end.recv()
            answer: tuple[object, Exception | None]
            try:
                answer = call(*args, **kwargs), None
            except Exception as error:  # noqa: BLE001 - whatever it is, the caller judges it
                answer = None, error
            end.send(answer)
