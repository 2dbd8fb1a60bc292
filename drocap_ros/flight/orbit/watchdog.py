"""Holds the vehicle when the control loop hangs: a thread of its own that shares no lock with the loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

_PERIOD_S = 0.1
_LOOK_S = 0.02
_ASK_MODE_S = 3.0
_GIVE_UP_S = 10.0
_STOPPED_S = 0.5


class LastWords(NamedTuple):
    """What to send if the loop is not heard of again: messages of the place to hold, and of the hold mode."""

    hold: Any
    hold_mode: Any


class Watchdog:
    """Sends the last words that the loop left, once it has not come back for ``limit_s``.

    Parameters
    ----------
    send : sends a message without waiting for any lock
    limit_s : time without :meth:`kick`
    """

    def __init__(self, send: Callable[[Any], None], limit_s: float) -> None:
        self._send, self._limit_s = send, limit_s
        self._left: tuple[float, LastWords | None] = (-1e18, None)  # replaced whole: no lock
        self._sent_s = self._looked_s = -1e18
        self._stood_s = 0.0  # how long this thread itself stood still since the loop was last heard of
        self.fired = False
        self.mode_asked = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def kick(self, now_s: float, words: LastWords | None) -> None:
        """The loop is alive; ``words`` is None while nothing is commanded."""
        self._left, self._stood_s = (now_s, words), 0.0

    def step(self, now_s: float) -> None:
        """Look at the loop and act."""
        left_s, words = self._left
        gap_s, self._looked_s = now_s - max(self._looked_s, left_s), now_s
        if gap_s > self._limit_s:  # the whole process was stopped, the loop too: it comes back with us
            self._stood_s += gap_s
        if self._stood_s > _STOPPED_S:
            return  # the autopilot's time-out has ended the motion; the place that was left is of another time
        silent_s = now_s - left_s
        if words is None or not self._limit_s < silent_s < _GIVE_UP_S or now_s - self._sent_s < _PERIOD_S:
            return
        self.fired, self._sent_s = True, now_s
        self._send(words.hold)
        if silent_s > _ASK_MODE_S and not self.mode_asked:
            self.mode_asked = True
            self._send(words.hold_mode)

    def take_fired(self) -> tuple[bool, bool]:
        """Whether it has acted, and asked for the hold mode, since the last call."""
        result = (self.fired, self.mode_asked)
        self.fired = self.mode_asked = False
        return result

    def start(self) -> None:
        """Watch in a thread, in real time."""
        self._thread = threading.Thread(target=self._run, name="flight-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)

    def _run(self) -> None:
        while not self._stop.wait(_LOOK_S):
            self.step(time.monotonic())
