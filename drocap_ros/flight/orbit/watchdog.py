"""Holds the vehicle when the control loop hangs: a thread of its own that shares no lock with the loop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

from drocap_ros.flight.mavlink.commands import Message

GIVE_UP_S = 10.0  # without a step: the hold mode was requested long ago, and the loop does not return


class FallbackCommands(NamedTuple):
    """Messages to send if the loop hangs: the position to hold, and the hold mode.

    in_control : whether the autopilot has just reported the mode in which it follows us; without it no mode is
        requested, because the pilot may have chosen another one
    left : whether the last report, of any age, shows another mode: the pilot's, to whom nothing is sent
    """

    hold: Message
    hold_mode: Message
    in_control: Callable[[], bool]
    left: Callable[[], bool]


class Watchdog:
    """Sends the fallback commands of the last step once the loop has not stepped for ``limit_s``.

    send : sends a message without waiting for any lock
    limit_s : time without :meth:`kick`
    hand_over : gives the hold of each step to the guardian, which outlives this process
    """

    def __init__(
        self,
        send: Callable[[Message], None],
        limit_s: float,
        hand_over: Callable[[Message | None], None] = lambda _: None,
    ) -> None:
        self._send, self._limit_s, self._hand_over = send, limit_s, hand_over
        self._latest: tuple[float, FallbackCommands | None] = (-1e18, None)  # replaced whole: no lock
        self._sent_s = self._checked_s = -1e18
        self._stood_s = 0.0  # how long this thread itself stood still since the last step of the loop
        self.fired = False
        self.mode_requested = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def kick(self, now_s: float, commands: FallbackCommands | None) -> None:
        """Note a step of the loop; ``commands`` is None while nothing is commanded."""
        self._latest, self._stood_s = (now_s, commands), 0.0
        self._hand_over(commands.hold if commands else None)

    def step(self, now_s: float) -> None:
        """Check the loop and act."""
        step_s, commands = self._latest
        gap_s, self._checked_s = now_s - max(self._checked_s, step_s), now_s
        if gap_s > self._limit_s:  # the whole process was stopped, the loop too: both resume together
            self._stood_s += gap_s
        if self._stood_s > 0.5:
            return  # the autopilot's time-out has ended the motion; the position of the last step is outdated
        silent_s = now_s - step_s
        # Five setpoints within the autopilot's time-out of 0.5 s.
        if commands is None or not self._limit_s < silent_s < GIVE_UP_S or now_s - self._sent_s < 0.1:
            return
        if commands.left():
            self.kick(step_s, None)
            return
        self.fired, self._sent_s = True, now_s
        self._send(commands.hold)
        # The vehicle stands 3 s after the last step, as after hold_s.
        if silent_s > 3.0 and not self.mode_requested and commands.in_control():
            self.mode_requested = True
            self._send(commands.hold_mode)

    def hold(self) -> None:
        """Send the hold of the last step, if there is one: the loop has failed, and nothing follows."""
        if (commands := self._latest[1]) is not None and not commands.left():
            self._send(commands.hold)

    def take_fired(self) -> tuple[bool, bool]:
        """Whether it has acted, and requested the hold mode, since the last call."""
        result = (self.fired, self.mode_requested)
        self.fired = self.mode_requested = False
        return result

    def start(self, now_s: Callable[[], float]) -> None:
        """Watch in a thread, by the clock of :meth:`kick`."""
        self._thread = threading.Thread(target=self._run, args=(now_s,), name="flight-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)

    def _run(self, now_s: Callable[[], float]) -> None:
        # A tenth of watchdog_s.
        while not self._stop.wait(0.02):
            self.step(now_s())
