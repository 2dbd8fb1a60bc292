"""Prefetch: a second thread decodes while the first computes."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterable
from typing import Any

from drocap_ros.perception.sources.base import Frame

_END = object()


def prefetch(frames: Iterable[Frame], ahead: int = 4) -> Generator[Frame, None, None]:
    """The same frames in the same order, up to ``ahead`` of them decoded in advance.

    An error of the source is raised in place of its frame.  Closing the generator stops the thread.
    """
    ready: queue.Queue[Any] = queue.Queue(maxsize=ahead)
    stop = threading.Event()

    def put(item: Any) -> bool:
        while not stop.is_set():
            try:
                ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def run() -> None:
        try:
            for frame in frames:
                if not put(frame):
                    return
            put(_END)
        except BaseException as error:  # raised in the reader's thread
            put(error)

    thread = threading.Thread(target=run, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not _END:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        thread.join(timeout=5.0)
