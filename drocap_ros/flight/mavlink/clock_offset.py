"""Offset of the autopilot's clock: attitude and position get stamps of our clock."""

from __future__ import annotations

import logging
from collections import deque

from drocap_ros.stamps import NS

#: Both ends stamp a packet within a few ms of its way.
_TOLERANCE_NS = 20_000_000
#: Round trips that differ by less are equally good, and the newest one counts: a clock that runs slow by 0.6 % is 40 ms
#: off after 7 s, before exchanges prove it.
_EQUAL_TRIPS_NS = 5_000_000
#: Greatest rate at which the two clocks drift apart: recorded of a simulated autopilot on a busy machine.
_GREATEST_RATE = 0.035
#: Least time between two exchanges, ns, that show the rate.
_RATE_SPAN_NS = 5 * NS

logger = logging.getLogger(__name__)


class ClockOffset:
    """Offset between our clock and the autopilot's time since boot.

    Answers to TIMESYNC give it from both directions; the newest of the shortest round trips of the last minute is used,
    with the rate at which the clocks drift apart where exchanges prove one.  Before the first answer, the fastest
    message of the last ten seconds gives it from one direction, late by the shortest transmission time.  A restart of
    the autopilot or a step of either clock resets it.

    An exchange bounds the offset: the answer was given after our sending and before our reception.  However late or
    uneven a link is, these bounds contain the offset, so two exchanges that exclude each other, beyond what the clocks
    may have drifted between them, prove a step; and a drift is believed where they exclude its absence.
    """

    def __init__(self, window_s: float = 60.0, one_way_window_s: float = 10.0, jump_s: float = 1.0) -> None:
        self._window_ns = int(window_s * NS)
        self._one_way_window_ns = int(one_way_window_s * NS)
        self._jump_ns = int(jump_s * NS)
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=512)  # received, round trip, offset
        self._best: tuple[int, int, int] | None = None
        self._rate = 0.0  # of the offset
        self._fastest: deque[tuple[int, int]] = deque(maxlen=4096)  # received, offset; offsets increase
        self._suspects = 0

    @property
    def offset_ns(self) -> int | None:
        """Our clock minus the autopilot's at the last exchange or message, or None before the first message."""
        if self._best is not None:
            return self._offset_at(self._exchanges[-1][0])
        return self._fastest[0][1] if self._fastest else None

    def _offset_at(self, received_ns: int) -> int:
        """By the exchange in use, at an instant of our clock."""
        assert self._best is not None
        return self._best[2] + round(self._rate * (received_ns - self._best[0]))

    @property
    def round_trip_ns(self) -> int | None:
        """Round trip of the exchange in use, or None without one."""
        return None if self._best is None else self._best[1]

    def exchange(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Take an answer to TIMESYNC: our time of sending, the autopilot's of answering, ours of receiving."""
        trip = received_ns - sent_ns
        if not 0 <= trip <= 2 * NS:
            return
        offset = sent_ns + trip // 2 - remote_ns
        if self._exchanges:
            before = self._exchanges[-1]
            drifted = _GREATEST_RATE * abs(received_ns - before[0])
            if abs(offset - before[2]) > (trip + before[1]) // 2 + _TOLERANCE_NS + drifted:
                step_s = (offset - before[2]) / NS
                logger.warning("our clock and the autopilot's stepped apart by %+.2f s; synchronized again", step_s)
                self.reset()
        self._exchanges.append((received_ns, trip, offset))
        while received_ns - self._exchanges[0][0] > self._window_ns:
            self._exchanges.popleft()
        self._best = min(self._exchanges, key=lambda e: (-(-e[1] // _EQUAL_TRIPS_NS), -e[0]))
        self._rate = self._drift()

    def _drift(self) -> float:
        """Rate of the offset, by the fastest exchanges of the oldest and the newest third; 0 where none is proved."""
        third = len(self._exchanges) // 3
        if not third:
            return 0.0
        exchanges = list(self._exchanges)
        first, last = (min(part, key=lambda e: e[1]) for part in (exchanges[:third], exchanges[-third:]))
        change, span = last[2] - first[2], last[0] - first[0]
        proved = span >= _RATE_SPAN_NS and abs(change) > (first[1] + last[1]) // 2
        return change / span if proved else 0.0

    def observe(self, remote_ns: int, received_ns: int) -> None:
        """Take a message that contains the autopilot's time since boot."""
        offset = received_ns - remote_ns
        known = self.offset_ns
        if known is not None and not -self._jump_ns < offset - known < 5 * self._jump_ns:
            # A single outlier is a late or damaged message; several in a row mean that a clock has jumped.
            self._suspects += 1
            if self._suspects < 3:
                return
            self.reset()
        self._suspects = 0
        while self._fastest and self._fastest[-1][1] >= offset:
            self._fastest.pop()
        self._fastest.append((received_ns, offset))
        while received_ns - self._fastest[0][0] > self._one_way_window_ns and len(self._fastest) > 1:
            self._fastest.popleft()

    def to_local_ns(self, remote_ns: int, received_ns: int) -> int:
        """Our clock's stamp of an instant of the autopilot's clock; never later than its reception.

        The reception replaces an instant that would lie more than 5 s before it.
        """
        offset = self.offset_ns if self._best is None else self._offset_at(received_ns)
        if offset is None:
            return received_ns
        stamp = min(remote_ns + offset, received_ns)
        return stamp if received_ns - stamp <= 5 * NS else received_ns

    def reset(self) -> None:
        """Forget everything."""
        self._exchanges.clear()
        self._fastest.clear()
        self._best = None
        self._rate = 0.0
        self._suspects = 0
