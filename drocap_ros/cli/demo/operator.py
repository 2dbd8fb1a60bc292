"""The demo's operator: what a person at the ground station would do, from what the bridge says.  No ROS here."""

from __future__ import annotations

import enum
import math
import re
from dataclasses import dataclass, field

from drocap_ros.flight.orbit.safety import Command, State

#: How long the operator waits for the bridge to be ready, for an answer to a command, and between tries.
READY_TIMEOUT_S, ANSWER_TIMEOUT_S, RETRY_S = 60.0, 10.0, 2.0
#: Nobody starts at the first blink of a green light.
STEADY_S = 1.0
#: After the stop: the vehicle comes to rest.
REST_S = 3.0


class Phase(enum.Enum):
    """What the operator is about."""

    WAITING = "waiting for the bridge to be ready"
    ASKED = "has asked for the orbit"
    ORBITING = "watches the orbit"
    STOPPED = "has stopped the orbit"
    DONE = "done"
    GIVEN_UP = "has given up"


@dataclass
class Operator:
    """Starts the orbit when the bridge is ready, starts it again after a hold, stops it in the end.

    Parameters
    ----------
    seconds : time of orbit that is wanted, holds not counted
    restarts : how often at most the orbit is started again
    takes_control : whether the bridge has to ask the autopilot for control from the first start on (PX4); after a
        hold it always has to

    Attributes
    ----------
    cleared : whether the pilot has handed over; nothing is started before
    orbited_s : time spent orbiting
    holds : reasons of the holds that nobody asked for
    failure : why the operator gave up, "" = not
    said : words for whoever watches, in order
    """

    seconds: float
    restarts: int = 4
    takes_control: bool = False
    cleared: bool = True
    phase: Phase = Phase.WAITING
    orbited_s: float = 0.0
    holds: list[str] = field(default_factory=list)
    failure: str = ""
    said: list[str] = field(default_factory=list)
    _since_s: float = math.nan
    _before_s: float = math.nan
    _ready_s: float = math.nan
    _next_try_s: float = -math.inf
    _last_words: str = ""

    @property
    def over(self) -> bool:
        """Whether there is nothing left to do."""
        return self.phase in (Phase.DONE, Phase.GIVEN_UP)

    def look(self, state: State, reason: str, now_s: float) -> Command | None:
        """Look at the bridge's present state at a monotonic time; the command to give now, or None."""
        if math.isnan(self._since_s):
            self._since_s = now_s
        passed_s = 0.0 if math.isnan(self._before_s) else now_s - self._before_s
        self._before_s = now_s
        if self.over:
            return None
        if state == State.TAKEN_OVER and self.phase != Phase.STOPPED:
            return self._give_up(reason)
        if self.phase == Phase.WAITING:
            return self._wait(state, reason, now_s)
        if self.phase == Phase.ASKED:
            return self._hope(state, reason, now_s)
        if self.phase == Phase.ORBITING:
            return self._watch(state, reason, now_s, passed_s)
        if now_s - self._since_s >= REST_S and state != State.ORBITING:
            self._enter(Phase.DONE, now_s)
        return None

    def _wait(self, state: State, reason: str, now_s: float) -> Command | None:
        if now_s - self._since_s > READY_TIMEOUT_S:
            return self._give_up(f"the bridge was not ready within {READY_TIMEOUT_S:g} s: {reason}")
        if state == State.FAULT and now_s >= self._next_try_s:
            self._next_try_s = now_s + RETRY_S
            self._say(f"fault: {reason}; acknowledged")
            return Command.STOP
        # A hold ends only by the operator's word: the bridge answers whether its conditions are met again.
        if state != State.READY:
            self._ready_s = math.nan
        elif math.isnan(self._ready_s):
            self._ready_s = now_s
        ready = state == State.HOLDING or now_s - self._ready_s >= STEADY_S
        if not ready or not self.cleared or now_s < self._next_try_s:
            if state != State.READY:
                self._say(f"not ready yet: {reason}", changed_only=True)
            elif not self.cleared:
                self._say("waiting for the pilot", changed_only=True)
            return None
        again = bool(self.holds)
        self._say("starting the orbit again" if again else "ready: starting the orbit")
        self.phase = Phase.ASKED
        self._next_try_s = now_s + ANSWER_TIMEOUT_S
        return Command.ENGAGE if again or self.takes_control else Command.START

    def _hope(self, state: State, reason: str, now_s: float) -> Command | None:
        if state == State.ORBITING:
            self._say("orbiting")
            self._enter(Phase.ORBITING, now_s)
        elif reason.startswith("refused") or now_s >= self._next_try_s:
            self._say(reason if reason.startswith("refused") else f"no orbit: {reason}", changed_only=True)
            self.phase, self._next_try_s = Phase.WAITING, now_s + RETRY_S
        return None

    def _watch(self, state: State, reason: str, now_s: float, passed_s: float) -> Command | None:
        if state == State.ORBITING:
            self.orbited_s += passed_s
            if self.orbited_s < self.seconds:
                return None
            self._say(f"{self.orbited_s:.0f} s of orbit flown: stopping")
            self._enter(Phase.STOPPED, now_s)
            return Command.STOP
        self.holds.append(reason)
        self._say(f"the bridge holds after {self.orbited_s:.1f} s of orbit: {reason}")
        if len(self.holds) > self.restarts:
            return self._give_up(f"the orbit was stopped {len(self.holds)} times, the last time: {reason}")
        self._enter(Phase.WAITING, now_s)
        self._next_try_s = now_s + REST_S
        return None

    def _give_up(self, why: str) -> Command:
        self.failure, self.phase = why, Phase.GIVEN_UP
        return Command.STOP

    def _enter(self, phase: Phase, now_s: float) -> None:
        self.phase, self._since_s = phase, now_s

    def _say(self, words: str, changed_only: bool = False) -> None:
        """Put into words; with ``changed_only`` not the same again."""
        # Numbers in a reason change all the time; the words before them tell what is the matter.
        kind = re.sub(r"[\d.]+", "#", words)
        if not changed_only or kind != self._last_words:
            self.said.append(words)
        self._last_words = kind
