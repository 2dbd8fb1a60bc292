"""Queue of messages to the disk: bounded; when full it drops images first."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import NamedTuple

#: MCAP's times are unsigned nanoseconds of 64 bits.
_END_NS = 1 << 64


class QueuedMessage(NamedTuple):
    """One serialized message."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class BoundedQueue:
    """Messages in order of arrival, at most ``limit_bytes`` of them.

    An image that does not fit is dropped; any other message that does not fit replaces the oldest images, and is
    dropped only when none are left.  Images use at most seven eighths of the space.

    size : queued bytes
    closed : whether further messages are refused
    dropped : messages by topic
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._images: deque[tuple[int, QueuedMessage]] = deque()
        self._others: deque[tuple[int, QueuedMessage]] = deque()
        self.size = 0
        self._arrivals = 0
        self.closed = False
        self._changed = threading.Condition()
        self.dropped: Counter[str] = Counter()

    def put(self, message: QueuedMessage, image: bool) -> bool:
        """Add without waiting; False when it was dropped."""
        size = len(message.data)
        with self._changed:
            limit = self._limit - self._limit // 8 if image else self._limit
            if not image:
                while self.size + size > limit and self._images:
                    _, victim = self._images.popleft()
                    self.size -= len(victim.data)
                    self.dropped[victim.topic] += 1
            stamped = 0 <= message.log_time_ns < _END_NS and 0 <= message.publish_time_ns < _END_NS
            if self.closed or not stamped or self.size + size > limit:
                self.dropped[message.topic] += 1
                return False
            (self._images if image else self._others).append((self._arrivals, message))
            self._arrivals += 1
            self.size += size
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> QueuedMessage | None:
        """Oldest message, None when none comes within the time-out."""
        with self._changed:
            if not self._images and not self._others and not self.closed:
                self._changed.wait(timeout_s)
            if not self._images and not self._others:
                return None
            first_is_image = bool(self._images) and (not self._others or self._images[0][0] < self._others[0][0])
            _, message = (self._images if first_is_image else self._others).popleft()
            self.size -= len(message.data)
            return message

    def close(self) -> None:
        """Refuse further messages; queued ones can still be taken."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def drop_all(self) -> None:
        """Drop and count all queued messages."""
        with self._changed:
            for _, message in (*self._images, *self._others):
                self.dropped[message.topic] += 1
            self._images.clear()
            self._others.clear()
            self.size = 0

    def drop_count(self) -> int:
        """Drops so far."""
        with self._changed:
            return sum(self.dropped.values())
