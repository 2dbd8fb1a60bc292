"""A function in a process of its own: threads of one Python process take turns, processes do not."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Generic, ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np

from drocap_ros.errors import NodeError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.reconstruction.common.engine import blas_threads

if TYPE_CHECKING:
    from drocap_ros.perception.estimator import PoseEstimator

_CALM_S = 1.0  # time without a queued image before the level falls; a shorter one lets the backlog return at once
_RISE_S = 0.2  # shortest time between two rises: each level needs time to take effect


class LoadShedding:
    """Level from 0 (full work) to ``max_level``: rises while images queue, falls by one per second without."""

    def __init__(self, max_level: int) -> None:
        self._max_level = max_level
        self._level = 0
        self._queued_s = -math.inf
        self._raised_s = -math.inf

    @property
    def lasting(self) -> int:
        """Level without what the backlog of the moment adds."""
        return self._level

    def level(self, now_s: float, queued: bool, backlog: int) -> int:
        """Level for the current image.

        now_s : monotonic time
        queued : whether the image arrived while the previous one was processed
        backlog : number of images still queued
        """
        if queued:
            self._queued_s = now_s
            if now_s - self._raised_s >= _RISE_S and self._level < self._max_level:
                self._level, self._raised_s = self._level + 1, now_s
        elif self._level and now_s - self._queued_s >= _CALM_S:
            self._level, self._queued_s = self._level - 1, now_s
        return min(self._level + backlog, self._max_level) if self._level else 0


@runtime_checkable
class LooksAhead(Protocol):
    """A node that wants to know of pictures as soon as they are exposed."""

    def expect(self, stamp_ns: int, jpeg: Future[bytes]) -> None:
        """A picture that another node of this process will publish with this stamp; in the order of the stamps."""


class LookAhead:
    """The observations of a :class:`PoseEstimator`, for a part of the pictures in their order."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._observe = OwnProcess(_Estimator(config).observe)
        self._thread = ThreadPoolExecutor(1, "look_ahead")
        self._begun: deque[tuple[int, Future[PoseObservation]]] = deque()

    def begin(self, stamp_ns: int, jpeg: Future[bytes], roi: np.ndarray | None) -> None:
        """Begin with the next picture; ``roi`` : as of :meth:`PoseEstimator.process`."""
        self._begun.append((stamp_ns, self._thread.submit(lambda: self._observe(jpeg.result(), stamp_ns, roi))))

    def knows(self, stamp_ns: int) -> bool:
        """Whether :meth:`take` gives an observation; pictures before this one are forgotten."""
        while self._begun and self._begun[0][0] < stamp_ns:
            self._begun.popleft()
        return bool(self._begun) and self._begun[0][0] == stamp_ns

    def take(self, stamp_ns: int) -> PoseObservation | None:
        """The observation in a picture, or the error of its estimation; None where it was not begun."""
        return self._begun.popleft()[1].result() if self.knows(stamp_ns) else None

    def close(self) -> None:
        """End the process."""
        self._thread.shutdown(cancel_futures=True)
        self._observe.close()


class _Estimator:
    """Loads its networks with the first picture: they cannot be sent to another process."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._config = config
        self._estimator: PoseEstimator | None = None

    def observe(self, jpeg: bytes, stamp_ns: int, roi: np.ndarray | None) -> PoseObservation:
        """The subject in a picture."""
        # Not every function in a process of its own needs these.
        from drocap_ros.perception.estimator import PoseEstimator
        from drocap_ros.perception.load_models import models_folder
        from drocap_ros.perception.sources.image_files import decoded

        if self._estimator is None:
            self._estimator = PoseEstimator(models_folder(self._config.models_dir), self._config)
        return self._estimator.process(decoded(np.frombuffer(jpeg, np.uint8), "jpeg"), stamp_ns, roi)


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

    call : with its object, its arguments and its results it can be pickled, and its module imported by name
    niceness : Unix niceness there; above 0 the process never preempts one that is less nice

    The package's messages are those of the level that this process has now.
    """

    def __init__(self, call: Callable[_P, _R], niceness: int = 0) -> None:
        here, there = socket.socketpair()
        # A fork of this process would hold its threads' locks, and those of `multiprocessing` run the user's script
        # anew and may not start from a daemon, which a node is.
        with there:
            numbers = ", ".join(map(str, (there.fileno(), _log.level, niceness)))
            body = f"import sys; sys.path[:] = sys.argv[1:]; from {__name__} import serve; serve({numbers})"
            self._process = subprocess.Popen(
                [sys.executable, "-c", body, *sys.path],
                env={**LEAN, **os.environ},
                pass_fds=(there.fileno(),),
                stdin=subprocess.DEVNULL,
            )
        # With the other end closed here, the death of either process ends the other's wait.
        self._end = Connection(here.detach())
        self._end.send_bytes(pickle.dumps(call))

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """The result of a call, or its error; one thread calls at a time.

        Raises NodeError when the process has died.
        """
        result: _R
        try:
            self._end.send((args, kwargs))
            result, error = self._end.recv()
        except (EOFError, OSError):
            raise NodeError(f"a process of this node ended with status {self._process.wait()}") from None
        if error is not None:
            raise error
        return result

    def kill(self) -> None:
        """End the process at once: a call that runs in another thread raises NodeError."""
        self._process.kill()

    def close(self) -> None:
        """End the process after its last call."""
        self._end.close()
        self._process.wait()


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


def serve(descriptor: int, level: int, niceness: int) -> None:
    """Body of such a process."""
    _log.setLevel(level)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's Ctrl-C is for the command
    if niceness:
        with contextlib.suppress(OSError, AttributeError):  # not every system has them
            os.nice(niceness)
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    # Until the other end is closed, or has died.
    with Connection(descriptor) as end, blas_threads(1), contextlib.suppress(EOFError, OSError):
        call = pickle.loads(end.recv_bytes())
        while True:
            args, kwargs = end.recv()
            answer: tuple[object, Exception | None]
            try:
                answer = call(*args, **kwargs), None
            except Exception as error:  # noqa: BLE001 - whatever it is, the caller judges it
                answer = None, error
            end.send(answer)
