"""The demo's operator: decides by the bridge's status when to start and to stop the orbit.  No ROS here."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

from drocap_ros.flight.orbit.states import Command, State

#: Longest wait for the bridge to be ready: the pilot's take-off and hand-over take 6 s.
READY_TIMEOUT_S = 60.0
#: Pause between tries.
RETRY_S = 2.0
#: Time for the vehicle to come to rest after the stop.
REST_S = 3.0


class Phase(enum.Enum):
    """Phases of the flight, as the operator sees them."""

    WAITING = "waiting for the bridge to be ready"
    REQUESTED = "has commanded the orbit"
    ORBITING = "watches the orbit"
    STOPPED = "has stopped the orbit"
    DONE = "done"
    GIVEN_UP = "has given up"


class _Status(NamedTuple):
    """The bridge's status at a monotonic time, and the time since the one before."""

    state: State
    condition: int
    reason: str
    now_s: float
    passed_s: float


@dataclass
class Operator:
    """Starts the orbit when the bridge is ready, starts it again after a hold, and stops it at the end.

    seconds : wanted time of orbit, without holds
    restarts : greatest number of starts after holds
    requests_control : whether already the first start must request control from the autopilot (PX4), as every start
        after a hold does

    Attributes
    ----------
    cleared : whether the pilot has handed over; nothing is started before
    orbited_s : time spent orbiting
    holds : reasons of the holds that the operator did not command
    failure : why the operator gave up, "" = it has not
    remarks : sentences for the user, in order
    """

    seconds: float
    restarts: int = 4
    requests_control: bool = False
    cleared: bool = True
    phase: Phase = Phase.WAITING
    orbited_s: float = 0.0
    holds: list[str] = field(default_factory=list)
    failure: str = ""
    remarks: list[str] = field(default_factory=list)
    _since_s: float = math.nan
    _before_s: float = math.nan
    _ready_s: float = math.nan
    _next_try_s: float = -math.inf
    _last_remark: tuple[object, ...] = ()

    @property
    def over(self) -> bool:
        """Whether the flight has ended."""
        return self.phase in (Phase.DONE, Phase.GIVEN_UP)

    def on_answer(self, accepted: bool, condition: int, words: str, now_s: float) -> None:
        """Take the bridge's answer to a command."""
        if self.phase == Phase.REQUESTED and not accepted:
            self._remark(f"refused: {words}", "refused", condition)
            self.phase, self._next_try_s = Phase.WAITING, now_s + RETRY_S

    def on_status(self, state: State, condition: int, reason: str, now_s: float) -> Command | None:
        """Take the bridge's status at a monotonic time; returns the command to send now, or None.

        condition, reason : code and sentence of the status
        """
        if math.isnan(self._since_s):
            self._since_s = now_s
        passed_s = 0.0 if math.isnan(self._before_s) else now_s - self._before_s
        self._before_s = now_s
        if self.over:
            return None
        if state == State.TAKEN_OVER and self.phase != Phase.STOPPED:
            return self._give_up(reason)
        step = {
            Phase.WAITING: self._wait,
            Phase.REQUESTED: self._expect_orbit,
            Phase.ORBITING: self._watch,
            Phase.STOPPED: self._rest,
        }[self.phase]
        return step(_Status(state, condition, reason, now_s, passed_s))

    def _wait(self, seen: _Status) -> Command | None:
        now_s = seen.now_s
        if now_s - self._since_s > READY_TIMEOUT_S:
            return self._give_up(f"the bridge was not ready within {READY_TIMEOUT_S:g} s: {seen.reason}")
        may_try = now_s >= self._next_try_s
        if seen.state == State.FAULT and may_try:
            self._next_try_s = now_s + RETRY_S
            self._remark(f"fault: {seen.reason}; acknowledged")
            return Command.STOP
        if self._is_steady(seen) and self.cleared and may_try:
            return self._start(now_s)
        if seen.state != State.READY:
            self._remark(f"not ready yet: {seen.reason}", "not ready", seen.condition)
        elif not self.cleared:
            self._remark("waiting for the pilot", "pilot")
        return None

    def _start(self, now_s: float) -> Command:
        again = bool(self.holds)
        self._remark("starting the orbit again" if again else "ready: starting the orbit")
        self.phase = Phase.REQUESTED
        # Longest wait for the orbit after a command: the autopilot may take seconds to change its mode.
        self._next_try_s = now_s + 10.0
        return Command.ENGAGE if again or self.requests_control else Command.START

    def _is_steady(self, seen: _Status) -> bool:
        """Whether the bridge has been ready for long enough; a hold ends only by a command, which it answers."""
        if seen.state != State.READY:
            self._ready_s = math.nan
        elif math.isnan(self._ready_s):
            self._ready_s = seen.now_s
        # The bridge must be ready for this long before the start.
        return seen.state == State.HOLDING or seen.now_s - self._ready_s >= 1.0

    def _expect_orbit(self, seen: _Status) -> None:
        if seen.state == State.ORBITING:
            self._remark("orbiting")
            self._enter(Phase.ORBITING, seen.now_s)
        elif seen.now_s >= self._next_try_s:
            self._remark(f"no orbit: {seen.reason}", "no orbit", seen.condition)
            self.phase, self._next_try_s = Phase.WAITING, seen.now_s + RETRY_S

    def _watch(self, seen: _Status) -> Command | None:
        if seen.state == State.ORBITING:
            self.orbited_s += seen.passed_s
            if self.orbited_s < self.seconds:
                return None
            self._remark(f"{self.orbited_s:.0f} s of orbit flown: stopping")
            self._enter(Phase.STOPPED, seen.now_s)
            return Command.STOP
        self.holds.append(seen.reason)
        self._remark(f"the bridge holds after {self.orbited_s:.1f} s of orbit: {seen.reason}")
        if len(self.holds) > self.restarts:
            return self._give_up(f"the orbit was stopped {len(self.holds)} times, the last time: {seen.reason}")
        self._enter(Phase.WAITING, seen.now_s)
        self._next_try_s = seen.now_s + REST_S
        return None

    def _rest(self, seen: _Status) -> None:
        if seen.now_s - self._since_s >= REST_S and seen.state != State.ORBITING:
            self._enter(Phase.DONE, seen.now_s)

    def _give_up(self, why: str) -> Command:
        self.failure, self.phase = why, Phase.GIVEN_UP
        return Command.STOP

    def _enter(self, phase: Phase, now_s: float) -> None:
        self.phase, self._since_s = phase, now_s

    def _remark(self, words: str, *key: object) -> None:
        """Add a remark; one with the key of the remark before it is left out."""
        if not key or key != self._last_remark:
            self.remarks.append(words)
        self._last_remark = key
