"""Prefetch: a second thread decodes while the first computes."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor

from drocap_ros.perception.sources.base import Frame


def prefetch(frames: Iterable[Frame], ahead: int = 4) -> Generator[Frame, None, None]:
    """The same frames in the same order, up to ``ahead`` of them decoded in advance.

    An error of the source is raised in place of its frame.  Closing the generator stops the thread.
    """
    iterator = iter(frames)
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        pending = deque(pool.submit(next, iterator, None) for _ in range(ahead))
        while (frame := pending.popleft().result()) is not None:
            pending.append(pool.submit(next, iterator, None))
            yield frame
    finally:
        # A file must not be closed during a read; the read of a live source ends only by its closing.
        pool.shutdown(wait=not getattr(frames, "live", False), cancel_futures=True)
