"""Joins two streams of results of the same images by their stamps."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

First = TypeVar("First")
Second = TypeVar("Second")


class StampJoin(Generic[First, Second]):
    """Pairs of the same stamp; topics keep no order between them, so either part may come first.

    At most ``max_pending`` of each part wait; the oldest are dropped.
    """

    def __init__(self, max_pending: int) -> None:
        self._max_pending = max_pending
        self._first: OrderedDict[int, First] = OrderedDict()
        self._second: OrderedDict[int, Second] = OrderedDict()
        #: Parts dropped without their counterpart.
        self.dropped_first = self.dropped_second = 0

    def add_first(self, stamp_ns: int, item: First) -> tuple[First, Second] | None:
        """The pair that the item completes, or None."""
        if stamp_ns in self._second:
            return item, self._second.pop(stamp_ns)
        self._first[stamp_ns] = item
        if len(self._first) > self._max_pending:
            self._first.popitem(last=False)
            self.dropped_first += 1
        return None

    def add_second(self, stamp_ns: int, item: Second) -> tuple[First, Second] | None:
        """The pair that the item completes, or None."""
        if stamp_ns in self._first:
            return self._first.pop(stamp_ns), item
        self._second[stamp_ns] = item
        if len(self._second) > self._max_pending:
            self._second.popitem(last=False)
            self.dropped_second += 1
        return None
