"""MAVLink commands with retries until they are acknowledged."""

from __future__ import annotations

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

_RETRY_S = 0.4  # between tries: two round trips at the longest that is flown with
_TRIES = 5  # 2 s of them: an autopilot that does not answer then has not heard
_PROGRESS_S = 3.0  # more patience with an autopilot that answers IN_PROGRESS
_REPEAT_S = 1.5  # after an answer: the mode it granted has been reported by then, and a second answer has come
_NOT_ANSWERED = -1  # beside the MAV_RESULTs
_RESULTS = {
    mavlink.MAV_RESULT_ACCEPTED: "accepted",
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "rejected for now",
    mavlink.MAV_RESULT_DENIED: "denied",
    mavlink.MAV_RESULT_UNSUPPORTED: "unsupported",
    mavlink.MAV_RESULT_FAILED: "failed",
    mavlink.MAV_RESULT_IN_PROGRESS: "in progress",
    6: "cancelled",
    _NOT_ANSWERED: f"not answered after {_TRIES} tries",
}


@dataclass
class _Pending:
    parameters: tuple[float, ...]
    label: str
    tries: int = 0
    sent_s: float = -1e9
    paused: bool = False
    result: int | None = None  # MAV_RESULT, or _NOT_ANSWERED
    answered_s: float = -1e9
    refusal: int | None = None  # while there is no result: the last answer, also to the same command before


class CommandQueue:
    """At most one command of each kind is pending; time is an argument."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def request(self, command: int, parameters: tuple[float, ...], label: str, now_s: float) -> None:
        """Send a command until it is answered; it replaces another one of its kind.

        The same command is repeated only a while after its answer: a mode that is granted but not yet visible must not
        be requested again, because the pilot may have just chosen another one.
        """
        present = self._pending.get(command)
        same = present is not None and present.parameters == parameters
        if present is None or not same or (present.result is not None and now_s - present.answered_s > _REPEAT_S):
            before = None if present is None or not same else present.result
            self._pending[command] = _Pending(parameters, label, refusal=before)
        self._pending[command].paused = False

    def pause(self, command: int) -> None:
        """Do not send the command until it is requested again; its answer is still taken."""
        if command in self._pending:
            self._pending[command].paused = True

    def cancel(self, command: int) -> None:
        """Stop sending the command."""
        self._pending.pop(command, None)

    def cancel_all(self) -> None:
        """Stop sending all commands: the pilot has taken over."""
        self._pending.clear()

    def acknowledge(self, command: int, result: int, now_s: float) -> None:
        """Take an acknowledgement.

        Some autopilots answer DO_SET_MODE twice: accepted at once, and then in earnest.  A refusal that follows counts.
        """
        pending = self._pending.get(command)
        if pending is None or pending.tries == 0:
            return
        if pending.result is not None:
            accepted = pending.result == mavlink.MAV_RESULT_ACCEPTED
            if not accepted or result == pending.result or now_s - pending.answered_s > _REPEAT_S:
                return
            pending.result = None
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            pending.sent_s = now_s + _PROGRESS_S - _RETRY_S
        elif result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and pending.tries < _TRIES:
            pending.sent_s, pending.refusal = now_s, result  # retried after the usual time
        else:
            pending.result, pending.answered_s = result, now_s

    def due(self, now_s: float) -> list[tuple[int, int, tuple[float, ...]]]:
        """(command, confirmation, parameters) to send now."""
        ready = []
        for command, pending in self._pending.items():
            if pending.paused or pending.result is not None or now_s - pending.sent_s < _RETRY_S:
                continue
            if pending.tries >= _TRIES:
                pending.result, pending.answered_s = _NOT_ANSWERED, now_s
                continue
            ready.append((command, pending.tries, pending.parameters))
            pending.sent_s = now_s
            pending.tries += 1
        return ready

    def failure(self, command: int) -> str:
        """Why the last command of this kind failed, or is refused so far, as a sentence; "" = neither."""
        pending = self._pending.get(command)
        result = None if pending is None else pending.refusal if pending.result is None else pending.result
        if pending is None or result in (None, mavlink.MAV_RESULT_ACCEPTED):
            return ""
        words = _RESULTS.get(result, f"answered with result {result}")
        return f"{pending.label}: {words}"
