"""What waits for the disk: bounded, and when full it gives up pictures before anything else."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import NamedTuple


class QueuedMessage(NamedTuple):
    """One serialized message on its way to the disk."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class BoundedQueue:
    """Messages in order of arrival, at most ``limit_bytes`` of them.

    A picture that does not fit is dropped; any other message that does not fit pushes out the oldest pictures, and
    is dropped itself only when none are left.  An eighth of the space is kept free of pictures.  Every drop is
    counted by topic.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._pictures: deque[tuple[int, QueuedMessage]] = deque()
        self._others: deque[tuple[int, QueuedMessage]] = deque()
        self._size = 0
        self._arrivals = 0
        self._closed = False
        self._changed = threading.Condition()
        self.dropped: Counter[str] = Counter()

    def put(self, message: QueuedMessage, picture: bool) -> bool:
        """Add; False when it was dropped.  Never waits."""
        size = len(message.data)
        with self._changed:
            limit = self._limit - self._limit // 8 if picture else self._limit
            if not picture:
                while self._size + size > limit and self._pictures:
                    _, victim = self._pictures.popleft()
                    self._size -= len(victim.data)
                    self.dropped[victim.topic] += 1
            if self._closed or self._size + size > limit:
                self.dropped[message.topic] += 1
                return False
            (self._pictures if picture else self._others).append((self._arrivals, message))
            self._arrivals += 1
            self._size += size
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> QueuedMessage | None:
        """Oldest message, waiting for one at most so long; None when there is none."""
        with self._changed:
            if not self._pictures and not self._others and not self._closed:
                self._changed.wait(timeout_s)
            if not self._pictures and not self._others:
                return None
            first_is_picture = bool(self._pictures) and (not self._others or self._pictures[0][0] < self._others[0][0])
            _, message = (self._pictures if first_is_picture else self._others).popleft()
            self._size -= len(message.data)
            return message

    def close(self) -> None:
        """Take nothing more in; what waits can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether it takes nothing more in."""
        return self._closed

    @property
    def size(self) -> int:
        """Bytes that wait."""
        return self._size

    def drop_all(self) -> None:
        """Drop what waits, counted."""
        with self._changed:
            for _, message in (*self._pictures, *self._others):
                self.dropped[message.topic] += 1
            self._pictures.clear()
            self._others.clear()
            self._size = 0

    def drop_count(self) -> int:
        """Drops so far."""
        with self._changed:
            return sum(self.dropped.values())
