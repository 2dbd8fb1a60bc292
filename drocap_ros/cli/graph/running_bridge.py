"""What the ``mavlink_bridge`` of a running graph hears of the autopilot, read from its topics."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.flight.autopilot import AUTOPILOTS, autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode
from drocap_ros.flight.mavlink.telemetry_request import TelemetryRequests
from drocap_ros.flight.orbit.states import State
from drocap_ros.flight.preflight.findings import Measured, Stream
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.recording.session import Message
from drocap_ros.ros.diagnostics import Key, number, of, values_of

if TYPE_CHECKING:
    from drocap_ros.bringup import Graph

#: A running bridge publishes its status five times a second; discovery may take longer.
_FIND_S = 2.0
#: Rates at which a bridge publishes its status and, usually, its state.
_STATUS_HZ, _STATE_HZ = 5.0, 50.0
_STATE_FIELDS = (
    "autopilot",
    "mode",
    "armed",
    "landed_state",
    "gps_fix_type",
    "satellites",
    "position_ok",
    "battery_fraction",
    "battery_voltage_v",
)


_CODES = {code.value: code for code in ConditionCode}
#: Without those of place and subject, which follow a take-off.
_OF_VEHICLE = range(ConditionCode.COMMANDS_DISABLED, ConditionCode.TOO_FAST)


@dataclass(frozen=True)
class _Reported(Condition):
    """A condition in the bridge's own words: its values are not on the topic."""

    words: str = ""

    def __str__(self) -> str:
        return self.words


class BridgeListener:
    """Collects the messages of one bridge, those of about the last ``keep_s``."""

    def __init__(self, graph: Graph, keep_s: float = 300.0) -> None:
        from drocap_ros.ros.topics import TOPICS

        self.statuses: deque[Message] = deque(maxlen=round(_STATUS_HZ * keep_s))
        # Age at the arrival, message.
        self.states: deque[tuple[float, Message]] = deque(maxlen=round(_STATE_HZ * keep_s))
        self.values: dict[str, str] = {}
        self._graph = graph
        takers = {
            "orbit/status": lambda message: self.statuses.append(message),
            "vehicle/state": self._take_state,
            "/diagnostics": self._take_diagnostics,
        }
        for topic, take in takers.items():
            graph.node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)

    def _take_state(self, message: Message) -> None:
        stamp = message.header.stamp
        now_ns = self._graph.node.get_clock().now().nanoseconds
        self.states.append((now_ns * 1e-9 - stamp.sec - stamp.nanosec * 1e-9, message))

    def _take_diagnostics(self, message: Message) -> None:
        for status in message.status:
            if status.name == f"{self._graph.namespace.strip('/')}/mavlink_bridge":
                self.values.update(values_of(status))

    def _failed(self) -> tuple[tuple[Condition, float], ...]:
        """Conditions for motion that the bridge has reported, with their share of the time."""
        idle = {status.condition: status.reason for status in self.statuses if status.state == State.IDLE}
        times = Counter(status.condition for status in self.statuses)
        return tuple(
            (_Reported(_CODES[code], words=reason), times[code] / len(self.statuses))
            for code, reason in sorted(idle.items())
            if code in _OF_VEHICLE
        )

    def measured(self, config: MavlinkBridgeConfig, namespace: str) -> Measured:
        """What the bridge has reported; it reads fewer of the autopilot's parameters than a link of our own."""
        status = self.statuses[-1]
        state = State(status.state).name.lower().replace("_", " ")
        requests = TelemetryRequests(dataclasses.replace(config, commands_enabled=True))
        vehicle = None
        if self.states:
            message = self.states[-1][1]
            q = message.gimbal_orientation
            vehicle = VehicleState(
                0,
                **{name: getattr(message, name) for name in _STATE_FIELDS},
                gimbal_orientation_xyzw=np.array([q.x, q.y, q.z, q.w]),
            )
            requests.set_autopilot(autopilot_of(vehicle.autopilot))
        known = {name for autopilot in AUTOPILOTS.values() for name in autopilot.preflight_names}
        streams = {
            name: Stream(number(self.values[of(Key.STREAM_RATE, name)]), wanted)
            for name, (_, wanted) in requests.rates_hz(0).items()
            if of(Key.STREAM_RATE, name) in self.values
        }
        trips_s = np.array([number(self.values.get(Key.ROUND_TRIP, ""))])
        return Measured(
            vehicle=vehicle,
            heard=vehicle is not None,
            streams=streams,
            round_trips_s=trips_s[np.isfinite(trips_s)],
            settings={name: number(text) for name, text in self.values.items() if name in known},
            delays_s=np.array([age for age, _ in list(self.states)]),
            conditions=self._failed(),
            bridge=f"by the running bridge in {namespace}, {state}: {status.reason}",
        )


def listen_to_bridge(
    config: MavlinkBridgeConfig, namespace: str, domain_id: int, seconds: float, progress: Progress
) -> Measured | None:
    """What a running bridge reports within some seconds; None = no bridge runs there, or ROS is missing."""
    with contextlib.ExitStack() as stack:
        try:
            from drocap_ros.bringup import watch
        except ImportError:
            return None
        graph = stack.enter_context(watch(namespace, domain_id))
        listener = BridgeListener(graph)
        begin_s = time.monotonic()
        while not listener.statuses:
            if time.monotonic() - begin_s > _FIND_S:
                return None
            graph.spin_for(0.1)
        begin_s = time.monotonic()
        while (share := (time.monotonic() - begin_s) / seconds) < 1.0:
            graph.spin_for(0.1)
            progress("listening", share)
        return listener.measured(config, namespace)
