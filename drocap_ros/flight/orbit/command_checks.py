"""Validation of the operator's commands on entry: what they ask, and when they were given."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from drocap_ros.flight.bridge_config import (
    FENCE_ROOM_M,
    MavlinkBridgeConfig,
    OrbitGoal,
    goal_of,
    height_condition,
    orbit_condition,
)
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.flight.orbit.states import Command, CommandAnswer, OperatorCommand, Orbiting, Requesting, SafetyState
from drocap_ros.flight.subject.framing import Framing
from drocap_ros.stamps import NS

_COMMAND_AGE_S = 2.0  # as srv/OrbitCommand.srv states
_MAX_WAITING = 16  # commands: one a step is answered, so the last one waits for 0.8 s at 20 Hz


def command_condition(command: OperatorCommand, now_ns: int) -> Condition | None:
    """Why a command is refused whatever the state: an unknown number, or a stamp too far from now."""
    if command.kind not in list(Command):
        return condition(ConditionCode.UNKNOWN_COMMAND, number=command.kind)
    age_s = (now_ns - command.stamp_ns) / NS
    if command.stamp_ns and abs(age_s) > _COMMAND_AGE_S:
        return condition(ConditionCode.COMMAND_OUTDATED, age_s=age_s, limit_s=_COMMAND_AGE_S)
    return None


def commanded_goal(
    config: MavlinkBridgeConfig, command: OperatorCommand, present: OrbitGoal | None, framing: Framing | None = None
) -> OrbitGoal | Condition:
    """The goal that a command asks for, or why the limits forbid it.

    present : values that a NaN keeps; None = the configured ones
    framing : of a camera that does not follow the person, who must stay in the picture
    """
    for name in ("radius_m", "height_m", "angular_speed_deg_s"):
        if math.isinf(value := getattr(command, name)):
            return condition(ConditionCode.VALUE_NOT_FINITE, name=name, value=value)
    goal = goal_of(config, command.radius_m, command.height_m, command.angular_speed_deg_s, present)
    speed = math.degrees(goal.angular_speed_rad_s)
    beyond = orbit_condition(config, goal.radius_m, speed) or height_condition(config, goal.height_m)
    widest_m = config.fence_radius_m - FENCE_ROOM_M
    if beyond is None and goal.radius_m > widest_m * ROUNDING:
        fence = "fence_radius_m less 1 m of room"
        beyond = condition(ConditionCode.RADIUS_TOO_LARGE, value=goal.radius_m, limit=widest_m, limited_by=fence)
    return beyond or (framing.refusal(goal) if framing else None) or goal


class Order(NamedTuple):
    """A command to execute in this step, and the orbit that it asks for; None = the present one stays."""

    command: OperatorCommand
    kind: Command
    goal: OrbitGoal | None = None


class CommandDesk:
    """The operator's commands that wait, and the answers to them."""

    def __init__(self, config: MavlinkBridgeConfig) -> None:
        self._config = config
        self._waiting: deque[OperatorCommand] = deque()
        self._answers: list[tuple[OperatorCommand, CommandAnswer]] = []
        self.operator_s = -math.inf  # monotonic, of the last sign of the operator

    def hear_operator(self, now_ns: int, now_s: float) -> None:
        """Take the operator's signs among the commands; one with an old stamp is none."""
        for sign in [command for command in self._waiting if command.kind == Command.PRESENT]:
            self._waiting.remove(sign)
            late = command_condition(sign, now_ns)
            self.operator_s = self.operator_s if late else now_s
            self.answer(sign, CommandAnswer(late is None, late or condition(ConditionCode.NONE)))

    def take(self, command: OperatorCommand) -> None:
        """Take a command.  Of too many the oldest that is no stop is dropped: never a stop for another command."""
        self._waiting.append(command)
        if len(self._waiting) > _MAX_WAITING:
            index = next((i for i, c in enumerate(self._waiting) if c.kind != Command.STOP), 0)
            dropped = self._waiting[index]
            del self._waiting[index]
            self.answer(dropped, CommandAnswer(False, condition(ConditionCode.TOO_MANY_COMMANDS, limit=_MAX_WAITING)))

    def next(self, now_ns: int, state: SafetyState, goal: OrbitGoal, framing: Framing) -> Order | None:
        """The command to execute in this step, a stop before all others; an invalid one is refused here."""
        stop = next((c for c in self._waiting if c.kind == Command.STOP), None)
        if stop is not None:
            self._overrule(stop)
            return Order(stop, Command.STOP)
        if not self._waiting:
            return None
        command = self._waiting.popleft()
        order = command_condition(command, now_ns) or self._order(command, state, goal, framing)
        if isinstance(order, Order):
            return order
        self.answer(command, CommandAnswer(False, order))
        return None

    def _order(
        self, command: OperatorCommand, state: SafetyState, goal: OrbitGoal, framing: Framing
    ) -> Order | Condition:
        """The order of a valid command, or why the limits forbid what it asks for."""
        kind, running = Command(command.kind), isinstance(state, Orbiting)
        adjusts = kind == Command.ADJUST
        if adjusts != running or (isinstance(state, Requesting) and not adjusts):
            return Order(command, kind)  # the state decides, and the goal stays
        wanted = commanded_goal(self._config, command, goal if adjusts else None, framing)
        return wanted if isinstance(wanted, Condition) else Order(command, kind, wanted)

    def _overrule(self, stop: OperatorCommand) -> None:
        overruled = condition(ConditionCode.OVERRULED_BY_STOP)
        for other in self._waiting:
            if other is not stop:
                self.answer(other, CommandAnswer(other.kind == Command.STOP, overruled))
        self._waiting.clear()

    def answer(self, command: OperatorCommand, answer: CommandAnswer) -> None:
        """Note the answer to a command."""
        self._answers.append((command, answer))

    def take_answers(self) -> list[tuple[OperatorCommand, CommandAnswer]]:
        """The answers since the last call."""
        answers, self._answers = self._answers, []
        return answers


_LASTS_S = 3.0  # for which a rival counts after its last message: it sends several a second
_TIMES = 2  # that numbers go back, of a rival: those of a restarted publisher do once


class Rivals:
    """Watches ``pose2d`` and ``orbit/status`` for a second publisher.  Time is an argument, monotonic.

    One thread may report what arrives while another one reads the condition.

    namespace : of this graph, for the sentence
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._names: list[str] = []
        self._number = 0
        self._backwards_s: deque[float] = deque(maxlen=_TIMES)
        self._own: deque[int] = deque(maxlen=256)
        self._strange_s: deque[float] = deque(maxlen=1)

    def take_pose2d(self, number: int, now_s: float) -> None:
        """Take the number that the publisher of a message gave to it; 0 = unknown.

        The numbers of one publisher increase; those of two mix, so that they go back again and again.  Those of a
        restarted publisher go back once.
        """
        if 0 < number <= self._number:
            self._backwards_s.append(now_s)
        self._number = number

    def published_status(self, stamp_ns: int) -> None:
        """Note the stamp of a status of our own, before it is published."""
        self._own.append(stamp_ns)

    def take_status(self, stamp_ns: int, now_s: float) -> None:
        """Take the stamp of a status that has arrived, ours or another bridge's."""
        if stamp_ns not in self._own:
            self._strange_s.append(now_s)

    def set_names(self, names: Iterable[str]) -> None:
        """Take the names of the nodes that may publish ``pose2d``, read from the graph once a second."""
        self._names = sorted(set(names))

    def condition(self, now_s: float) -> Condition | None:
        """Why the vehicle must not be commanded; None = nobody else is there."""
        if self._strange_s and now_s - self._strange_s[-1] < _LASTS_S:
            return condition(ConditionCode.SECOND_BRIDGE, namespace=self._namespace)
        mixed = len(self._backwards_s) == _TIMES and now_s - self._backwards_s[0] < _LASTS_S
        if mixed or len(self._names) > 1:
            return condition(ConditionCode.OTHER_POSE_PUBLISHER, names=", ".join(self._names) or "unknown")
        return None
