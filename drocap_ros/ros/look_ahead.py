"""Poses of pictures that are still to be published, in simulated time: a process of its own estimates them meanwhile.

A simulated camera publishes a picture long after its exposure.  In between the graph's thread has other work.
"""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol, runtime_checkable

import numpy as np

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.sources.pixels import decoded
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.ros.own_process import OwnProcess

_CALM_S = 1.0  # time without a queued image before the level falls; a shorter one lets the backlog return at once
_RISE_S = 0.2  # shortest time between two rises: each level needs time to take effect


class LoadShedding:
    """Level from 0 (full work) to ``max_level``: rises while images queue, falls by one per second without."""

    def __init__(self, max_level: int) -> None:
        self._max_level = max_level
        self._level = 0
        self._queued_s = -math.inf
        self._raised_s = -math.inf

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
        if self._estimator is None:
            self._estimator = PoseEstimator(models_folder(self._config.models_dir), self._config)
        return self._estimator.process(decoded(np.frombuffer(jpeg, np.uint8), "jpeg"), stamp_ns, roi)
