"""The operator's desk: what `drocap orbit` and the station check, send and say."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import OrbitConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Command, State

if TYPE_CHECKING:
    from drocap_ros.recording.session import Message
    from drocap_ros.ros.graph import Graph

#: Value of a command -> parameter of the orbit: its range is checked here, its limits by the bridge.
PARAMETERS = {"radius": "radius_m", "height": "height_m", "speed": "angular_speed_deg_s"}


def check_values(action: str, values: Mapping[str, float | None], prefix: str = "") -> None:
    """Refuse values, None = not given, that an action does not take; ``prefix`` stands before their names."""
    given = {name: value for name, value in values.items() if value is not None}
    if action == "adjust" and not given:
        first, second, third = (prefix + name for name in PARAMETERS)
        raise InputError(f"adjust: expected {first}, {second} or {third}, got none; state what to change")
    for name, value in given.items():
        # To the bridge NaN means the configured value: a failed computation must not start another orbit.
        if not math.isfinite(value):
            raise InputError(
                f"{prefix}{name}: expected a finite number, got {value:g}; correct the value or leave it out"
            )
        if action not in ("start", "engage", "adjust"):
            raise InputError(f"{prefix}{name}: {action} takes no values; leave it out")
        _check_range(name, value, prefix)


def _check_range(name: str, value: float, prefix: str) -> None:
    meta = range_of(name)
    low, high = meta["minimum"], meta["maximum"]
    if value < low or value > high:
        raise InputError(
            f"{prefix}{name}: expected {low:g} to {high:g} {meta['unit']}, got {value:g}; choose a value in the range"
        )


def range_of(name: str) -> Mapping[str, Any]:
    """Minimum, maximum, unit and description of a value of a command."""
    return next(spec.metadata for spec in dataclasses.fields(OrbitConfig) if spec.name == PARAMETERS[name])


def sentence(status: Message) -> str:
    """An `orbit/status` in words."""
    state = State(status.state)
    text = f"{state.name.lower().replace('_', ' ')}: {status.reason}"
    if not math.isnan(status.radius_m):
        text += f"; {status.radius_m:.1f} m from the subject, {status.height_m:.1f} m high"
    if state == State.HOLDING and status.condition != ConditionCode.SUBJECT_NEAR:
        text += "; it stays there, also where somebody walks up to it"
    if state == State.ORBITING:
        text += f", {status.angular_speed_deg_s:.0f} deg/s, yaw error {status.yaw_error_deg:+.1f} deg"
    return text


class Desk:
    """Hears `orbit/status` and calls `orbit/command` of one graph.

    statuses : the last one; ``on_status`` is called with each
    """

    def __init__(self, graph: Graph, on_status: Callable[[Message], None] = lambda _: None) -> None:
        from drocap_ros.ros.topics import RESULT_QOS, SERVICES, TOPICS

        self.statuses: deque[Message] = deque(maxlen=1)
        self._node = graph.node
        self._sign: Any = None
        self._client = self._node.create_client(SERVICES["orbit/command"], "orbit/command", qos_profile=RESULT_QOS)

        def take(message: Message) -> None:
            self.statuses.append(message)
            on_status(message)

        self._node.create_subscription(TOPICS["orbit/status"].message, "orbit/status", take, RESULT_QOS)

    def is_reachable(self) -> bool:
        """Whether a bridge serves the commands."""
        return bool(self._client.service_is_ready())

    def order(self, action: str, values: Mapping[str, float | None]) -> Any:
        """Send a command whose values are checked; returns the future of its answer."""
        from drocap_ros.ros.conversions import orbit_request

        given = [math.nan if (value := values.get(name)) is None else value for name in PARAMETERS]
        return self._client.call_async(orbit_request(self._node, int(Command[action.upper()]), *given))

    def present(self) -> None:
        """Tell the bridge that the operator's console lives; one answer at most is waited for."""
        from drocap_ros.ros.conversions import orbit_request

        if self._sign is not None and not self._sign.done():
            self._client.remove_pending_request(self._sign)
        self._sign = self._client.call_async(orbit_request(self._node, int(Command.PRESENT)))
