"""A link inside one process in simulated time, with delay, loss, duplicates and packets out of order."""

from __future__ import annotations

import heapq
import itertools
import random
import socket
from collections.abc import Callable

from drocap_ros.flight.mavlink.transport import Transport


def free_udp_port() -> int:
    """A free UDP port on loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Channel:
    """One direction.  Deterministic: its randomness comes from a seed.

    delay_s, jitter_s : of each packet; jitter above the interval of the packets reorders them
    loss, duplicate : shares of the packets
    cut : no packet passes
    gaps_hz : of a busy machine: pauses of up to ``longest_gap_s``, whose packets come in one burst afterwards
    drops : packets that are lost
    """

    def __init__(self, clock_s: Callable[[], float], seed: int = 0) -> None:
        self._clock_s = clock_s
        self._random = random.Random(seed)
        self._order = itertools.count()
        self._waiting: list[tuple[float, int, bytes]] = []
        self.delay_s, self.jitter_s, self.loss, self.duplicate, self.cut = 0.01, 0.0, 0.0, 0.0, False
        self.gaps_hz, self.longest_gap_s = 0.0, 0.3
        self.drops: Callable[[bytes], bool] = lambda _: False
        self._gap_from_s = self._gap_until_s = 0.0

    def write(self, data: bytes) -> None:
        """Send a packet."""
        for _ in range(1 + (self._random.random() < self.duplicate)):
            if not self.cut and self._random.random() >= self.loss and not self.drops(data):
                due = self._after_gap(self._clock_s() + self.delay_s + self._random.uniform(0, self.jitter_s))
                heapq.heappush(self._waiting, (due, next(self._order), data))

    def _after_gap(self, due_s: float) -> float:
        """When a packet arrives that would be due then."""
        if self.gaps_hz > 0 and due_s > self._gap_until_s:
            self._gap_from_s = max(self._gap_until_s, due_s - 1e-9) + self._random.expovariate(self.gaps_hz)
            self._gap_until_s = self._gap_from_s + self._random.uniform(0.05, self.longest_gap_s)
        return self._gap_until_s if self._gap_from_s <= due_s <= self._gap_until_s else due_s

    def read(self) -> bytes:
        """Arrived packets, joined."""
        parts = []
        while self._waiting and self._waiting[0][0] <= self._clock_s():
            parts.append(heapq.heappop(self._waiting)[2])
        return b"" if self.cut else b"".join(parts)


def is_setpoint(packet: bytes) -> bool:
    """Whether a MAVLink 2 packet is SET_POSITION_TARGET_LOCAL_NED."""
    return packet[:1] == b"\xfd" and packet[7:10] == b"\x54\x00\x00"


class LoopbackTransport(Transport):
    """A transport over two channels; it never waits."""

    def __init__(self, incoming: Channel, outgoing: Channel) -> None:
        self._incoming, self._outgoing = incoming, outgoing

    def read(self, _timeout_s: float) -> bytes:
        """Arrived packets, joined."""
        return self._incoming.read()

    def write(self, data: bytes) -> bool:
        """Send."""
        self._outgoing.write(data)
        return True

    def port(self) -> tuple[int, None]:
        """None: nothing is open."""
        return -1, None

    def close(self) -> None:
        """Do nothing."""
