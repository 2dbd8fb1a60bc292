"""Commands with their acknowledgements: sent again until answered, and the answer in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

_RETRY_S = 0.4
_TRIES = 5
_PROGRESS_S = 3.0
_AGAIN_S = 1.5
RESULT_WORDS = {
    mavlink.MAV_RESULT_ACCEPTED: "accepted",
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "rejected for now",
    mavlink.MAV_RESULT_DENIED: "denied",
    mavlink.MAV_RESULT_UNSUPPORTED: "unsupported",
    mavlink.MAV_RESULT_FAILED: "failed",
    mavlink.MAV_RESULT_IN_PROGRESS: "in progress",
    6: "cancelled",
}


@dataclass
class _Pending:
    parameters: tuple[float, ...]
    label: str
    tries: int = 0
    sent_s: float = -1e9
    outcome: str = ""
    answered_s: float = -1e9


class CommandQueue:
    """At most one command of each kind is under way; time is an argument."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def request(self, command: int, parameters: tuple[float, ...], label: str, now_s: float) -> None:
        """Send a command until it is answered; another takes its place.

        The same one, asked for again, waits a while after its answer: whoever repeats a mode that has been granted
        before it is seen takes it back from a pilot who has just chosen another.
        """
        present = self._pending.get(command)
        same = present is not None and present.parameters == parameters
        if present is None or not same or (present.outcome and now_s - present.answered_s > _AGAIN_S):
            self._pending[command] = _Pending(parameters, label)

    def cancel(self, command: int) -> None:
        """Send it no more."""
        self._pending.pop(command, None)

    def cancel_all(self) -> None:
        """Send nothing more: the pilot has taken over."""
        self._pending.clear()

    def acknowledge(self, command: int, result: int, now_s: float) -> None:
        """An answer has come."""
        pending = self._pending.get(command)
        if pending is None or pending.outcome or pending.tries == 0:
            return
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            pending.sent_s = now_s + _PROGRESS_S - _RETRY_S
        elif result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and pending.tries < _TRIES:
            pending.sent_s = now_s  # tried again after the usual time
        else:
            pending.outcome = RESULT_WORDS.get(result, f"answered with result {result}")
            pending.answered_s = now_s

    def due(self, now_s: float) -> list[tuple[int, int, tuple[float, ...]]]:
        """(command, confirmation, parameters) to send now."""
        ready = []
        for command, pending in self._pending.items():
            if pending.outcome or now_s - pending.sent_s < _RETRY_S:
                continue
            if pending.tries >= _TRIES:
                pending.outcome, pending.answered_s = f"not answered after {pending.tries} tries", now_s
                continue
            ready.append((command, pending.tries, pending.parameters))
            pending.sent_s = now_s
            pending.tries += 1
        return ready

    def failure(self, command: int) -> str:
        """In words, why the last command of this kind did not succeed; "" while that is not so."""
        pending = self._pending.get(command)
        if pending is None or pending.outcome in ("", "accepted"):
            return ""
        return f"{pending.label}: {pending.outcome}"


def command_message(
    mav: Any, target: tuple[int, int], command: int, confirmation: int, parameters: tuple[float, ...]
) -> Any:
    """COMMAND_LONG of a command."""
    return mav.command_long_encode(*target, command, confirmation, *parameters)
