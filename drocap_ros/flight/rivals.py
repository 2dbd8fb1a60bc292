"""Others that publish what a bridge steers by or what only a bridge publishes: the vehicle must not fly among them.

They are found by what they send.  The middleware's list of endpoints names them; alone it does not suffice, because a
killed node stays in it for up to 20 s and its successor has the same name.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from drocap_ros.flight.conditions import Condition, ConditionCode, condition

_LASTS_S = 3.0  # for which a rival counts after its last message: it sends several a second
_TIMES = 2  # that numbers go back, of a rival: those of a restarted publisher do once


class Rivals:
    """Watches ``pose2d`` and ``orbit/status`` for a second publisher.  Time is an argument, monotonic.

    One thread may report what arrives while another one reads the condition.

    namespace : of this graph, for the sentence
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._names: list[str] = []
        self._number = 0
        self._backwards_s: deque[float] = deque(maxlen=_TIMES)
        self._own: deque[int] = deque(maxlen=256)
        self._strange_s: deque[float] = deque(maxlen=1)

    def take_pose2d(self, number: int, now_s: float) -> None:
        """Take the number that the publisher of a message gave to it; 0 = unknown.

        The numbers of one publisher increase; those of two mix, so that they go back again and again.  Those of a
        restarted publisher go back once.
        """
        if 0 < number <= self._number:
            self._backwards_s.append(now_s)
        self._number = number

    def published_status(self, stamp_ns: int) -> None:
        """Note the stamp of a status of our own, before it is published."""
        self._own.append(stamp_ns)

    def take_status(self, stamp_ns: int, now_s: float) -> None:
        """Take the stamp of a status that has arrived, ours or another bridge's."""
        if stamp_ns not in self._own:
            self._strange_s.append(now_s)

    def set_names(self, names: Iterable[str]) -> None:
        """Take the names of the nodes that may publish ``pose2d``, read from the graph once a second."""
        self._names = sorted(set(names))

    def condition(self, now_s: float) -> Condition | None:
        """Why the vehicle must not be commanded; None = nobody else is there."""
        if self._strange_s and now_s - self._strange_s[-1] < _LASTS_S:
            return condition(ConditionCode.SECOND_BRIDGE, namespace=self._namespace)
        mixed = len(self._backwards_s) == _TIMES and now_s - self._backwards_s[0] < _LASTS_S
        if mixed or len(self._names) > 1:
            return condition(ConditionCode.OTHER_POSE_PUBLISHER, names=", ".join(self._names) or "unknown")
        return None
