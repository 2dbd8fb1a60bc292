"""Holds the vehicle where the bridge's process dies or stands still: a process of its own that shares the open port.

In each step of an orbit the bridge hands over the packets that hold the vehicle where it is, and the port.  The
guardian sends them, one after the other, when that process has ended, or has been silent for a time.  It requests no
mode, and sends nothing more once the port shows the vehicle in another one, the pilot's.  While the bridge lives, the
port is the bridge's to read; an autopilot in another mode ignores the packets.  It then gives up the port and ends.
Orders bear the time at which the bridge gave them, of a clock that a suspended machine does not stop: what waited is
not sent.

This file is its program too.  It imports nothing but the standard library: what fails there fails in no other place.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.flight.mavlink.transport import Transport

#: Packets of a hold, and s between them: two within the autopilot's time-out of 0.5 s, for 1.4 s and that time-out.  A
#: vehicle stands by then: it brakes at 1.3 m/s^2 and more, from 2.3 m/s at most (``max_coast_m``).
PACKETS, PERIOD_S = 8, 0.2
_CHECK_S = 0.02  # as the watchdog's
_ENDS_S = PACKETS * PERIOD_S + 0.5  # until it has ended, one that holds too
#: What ends a group of processes, as a service manager does with those that a dead bridge leaves: it ends by itself.
_IGNORED = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

logger = logging.getLogger(__name__)


class Guardian:
    """What was handed over last, and when it is sent.  It reads no clock.

    limit_s : silence of the bridge
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._packets: list[bytes] = []
        self._heard_s = self._sent_s = -1e18
        self.ended = False  # the bridge's process

    @property
    def armed(self) -> bool:
        """Whether there is anything to be sent."""
        return bool(self._packets)

    def take(self, given_s: float, packets: Sequence[bytes]) -> None:
        """Take what the bridge gave at a time; nothing: it commands nothing."""
        self._heard_s, self._packets = given_s, list(packets)

    def due(self, now_s: float) -> bytes | None:
        """The packet to send now."""
        # The autopilot's time-out has ended the motion by then.
        if now_s - max(self._heard_s, self._sent_s) > 0.5:
            self._packets = []  # of another place than the present one
        silent = self.ended or now_s - self._heard_s > self._limit_s
        if not (silent and self._packets and now_s - self._sent_s >= PERIOD_S):
            return None
        self._sent_s = now_s
        return self._packets.pop(0)


class GuardianProcess:
    """The guardian's process, seen from the bridge.

    limit_s : silence of the bridge, after which it acts
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._armed, self._lost = limit_s, False, False
        self._start()

    def _start(self) -> None:
        self._channel, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel.setblocking(False)
        with channel:
            # In a session of its own, so that what ends the bridge's group does not end it.
            self._process = subprocess.Popen(
                [sys.executable, "-I", __file__, str(channel.fileno()), str(self._limit_s)],
                pass_fds=(channel.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )

    def revive(self) -> None:
        """Start another one where it has ended, whatever killed it."""
        if (status := self._process.poll()) is not None:
            logger.warning("the guardian of the link has ended with status %d: started again", status)
            self._channel.close()
            self._start()

    def take(self, packets: Sequence[bytes], control: tuple[int, int, int], transport: Transport) -> None:
        """Hand over packets and the port of the transport; it never waits, and never raises.

        control : system, component and custom_mode of a HEARTBEAT of the vehicle while it follows the bridge
        """
        if not packets and not self._armed:
            return
        order: dict[str, object] = {"given_s": _now_s(), "packets": [packet.hex() for packet in packets]}
        order |= {"control": control, "peer": None}
        descriptors: list[int] = []
        try:
            if packets:
                descriptor, order["peer"] = transport.port()
                descriptors = [descriptor]
            socket.send_fds(self._channel, [json.dumps(order).encode()], descriptors)
        except OSError as error:
            if not self._lost:
                logger.warning("the guardian of the link does not answer (%s): it holds nothing", error)
            self._lost = True
            return
        self._armed, self._lost = bool(packets), False

    def close(self) -> None:
        """Let it end; a motion that was commanded last, and not ended, is held until then."""
        self._channel.close()
        try:
            self._process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # it stands still, and would keep the port
            self._process.wait()


class _Port:
    """The bridge's open port, shared."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._peer: tuple[str, int] | None = None

    def take(self, descriptors: Sequence[int], peer: Sequence[str | int] | None) -> None:
        """Take a port instead of the one before; without one, none is held open."""
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor = descriptors[0] if descriptors else None
        self._peer = None if peer is None else tuple(peer)  # type: ignore[assignment]  # as the bridge has it

    def write(self, packet: bytes) -> None:
        """Send; what the port refuses is lost."""
        if self._descriptor is None:
            return
        with contextlib.suppress(OSError):
            if self._peer is None:
                os.write(self._descriptor, packet)
                return
            with socket.socket(fileno=os.dup(self._descriptor)) as shared:
                shared.sendto(packet, self._peer)

    def read(self) -> Iterator[bytes]:
        """What has arrived, once nobody else reads it."""
        with contextlib.suppress(OSError):
            # At most so many datagrams in a step: a flood delays no packet.
            for _ in range(100):
                if self._descriptor is None or not select.select([self._descriptor], [], [], 0.0)[0]:
                    return
                yield os.read(self._descriptor, 65535)


def has_left(data: bytes, control: Sequence[int]) -> bool:
    """Whether a HEARTBEAT of MAVLink 2 in the data shows another mode of the vehicle than ``control``."""
    system, component, mode = control
    message = rb"\xfd.{4}" + re.escape(bytes((system, component, 0, 0, 0))) + rb"(.{4})"
    return any(found[1] != mode.to_bytes(4, "little") for found in re.finditer(message, data, re.DOTALL))


def _now_s() -> float:
    """Time of this machine, which goes on while it is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def main(channel: socket.socket, limit_s: float) -> None:
    """Take what the bridge hands over, until its process ends; then hold, where it has commanded motion."""
    guardian, port, control = Guardian(limit_s), _Port(), (0, 0, 0)
    while guardian.armed or not guardian.ended:
        if guardian.ended:
            time.sleep(_CHECK_S)
            if any(has_left(part, control) for part in port.read()):
                guardian.take(_now_s(), [])
        elif select.select([channel], [], [], _CHECK_S if guardian.armed else None)[0]:
            # Eight signed packets of 73 bytes in digits are 1.3 kB.
            data, descriptors, *_ = socket.recv_fds(channel, 16384, 1)
            guardian.ended = not data
            if data:
                order = json.loads(data)
                port.take(descriptors, order["peer"])
                control = order["control"]
                guardian.take(order["given_s"], [bytes.fromhex(packet) for packet in order["packets"]])
            continue  # a newer order may wait
        if (packet := guardian.due(_now_s())) is not None:
            port.write(packet)


if __name__ == "__main__":
    for ignored in _IGNORED:
        signal.signal(ignored, signal.SIG_IGN)
    main(socket.socket(fileno=int(sys.argv[1])), float(sys.argv[2]))
