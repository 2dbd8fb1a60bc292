"""Validation of a stream's stamps, in the nodes and when their work is repeated offline."""

from __future__ import annotations

from drocap_ros.errors import InputError

#: A stamp this far from the previous one belongs to another time.
JUMP_S = 3600.0
#: Successive stamps of another time after which the stream has moved there: a replay began, a clock was set.
CONFIRMED_AFTER = 5


class StampValidator:
    """Refuses stamps that lie an hour or more from the previous ones, such as one image of 1970.

    Smaller steps, forward or back, are for the algorithms to judge.  No clock is read: simulated time and replays
    are as good as today.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._other_ns: int | None = None
        self._others = 0

    def check(self, sec: int, nanosec: int) -> None:
        """Take the next stamp.

        Raises
        ------
        InputError
            When it lies before 1970, is no time, or is far from the others of its stream.
        """
        if sec < 0 or nanosec >= 10**9:
            raise InputError(f"stamp: expected a time after 1970, got {sec} s {nanosec} ns; set the sender's clock")
        stamp_ns = sec * 10**9 + nanosec
        if self._last_ns is not None and _far(stamp_ns, self._last_ns):
            agrees = self._other_ns is not None and not _far(stamp_ns, self._other_ns)
            self._others = self._others + 1 if agrees else 1
            self._other_ns = stamp_ns
            if self._others < CONFIRMED_AFTER:
                away_s = (stamp_ns - self._last_ns) * 1e-9
                raise InputError(
                    f"stamp: expected a time near the last one, got one {away_s:+.0f} s away; check the sender's clock"
                )
        self._last_ns, self._other_ns, self._others = stamp_ns, None, 0


def _far(a_ns: int, b_ns: int) -> bool:
    return abs(a_ns - b_ns) > JUMP_S * 1e9
