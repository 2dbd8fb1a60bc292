"""Which telemetry is asked of the autopilot, whether it really comes, and when to ask again."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig

_NS = 1_000_000_000
_FAST_HEARTBEAT_HZ = 5.0
_ECHO_HZ = 10.0


@dataclass
class _Wanted:
    rate_hz: float
    arrivals: deque[int] = field(default_factory=lambda: deque(maxlen=2048))
    asked_ns: int = -(10**18)
    asked_count: int = 0
    result: int | None = None


class TelemetryRequests:
    """The wanted messages with their rates: asked for, measured, asked for again when they fall short.

    An acknowledgement says little (behind a proxy 20 Hz was acknowledged and 1.2 Hz came): the arrivals count.
    What the autopilot refuses is asked for ever more rarely, for a mount may appear later.
    """

    def __init__(self, config: MavlinkBridgeConfig) -> None:
        self._config = config
        rates = {
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: config.attitude_hz,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: config.position_hz,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: config.status_hz,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: config.status_hz,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: config.status_hz,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: config.status_hz,
            mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: config.gimbal_hz,
        }
        if config.commands_enabled:
            # A pilot's change of mode and the echo of our setpoints must not be seen a second late.
            rates[mavlink.MAVLINK_MSG_ID_HEARTBEAT] = _FAST_HEARTBEAT_HZ
            rates[mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED] = _ECHO_HZ
        self._wanted = {number: _Wanted(rate) for number, rate in rates.items() if rate > 0}
        self._since_ns: int | None = None

    def set_autopilot(self, autopilot: str) -> None:
        """Add the estimator's health by the message that this autopilot has for it."""
        px4 = autopilot == "px4"
        number = mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS if px4 else mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT
        self._wanted.setdefault(number, _Wanted(self._config.status_hz))

    def count(self, message_id: int, now_ns: int) -> None:
        """A message has come."""
        wanted = self._wanted.get(message_id)
        if wanted is not None:
            wanted.arrivals.append(now_ns)

    def acknowledge(self, result: int, now_ns: int) -> None:
        """An answer to a request.  It does not name the message: it is that of the oldest one unanswered."""
        waiting = [w for w in self._wanted.values() if w.asked_count and w.result is None]
        if waiting and now_ns >= waiting[0].asked_ns:
            min(waiting, key=lambda w: w.asked_ns).result = result

    def rate_hz(self, message_id: int, now_ns: int) -> float:
        """Real rate of a wanted message over the configured window."""
        window_ns = int(self._config.rate_window_s * _NS)
        if self._since_ns is not None:
            window_ns = min(window_ns, max(now_ns - self._since_ns, 1))
        arrivals = self._wanted[message_id].arrivals
        # This is asked for at every turn of the link: what is too old is looked at once.
        while arrivals and now_ns - arrivals[0] > window_ns:
            arrivals.popleft()
        return len(arrivals) * _NS / window_ns

    def rates_hz(self, now_ns: int) -> dict[str, tuple[float, float]]:
        """(real, wanted) Hz of every wanted message by its name."""
        return {
            mavlink.mavlink_map[number].msgname: (self.rate_hz(number, now_ns), wanted.rate_hz)
            for number, wanted in self._wanted.items()
        }

    def refused(self) -> dict[str, int]:
        """MAV_RESULT of the messages that the autopilot does not grant, by their names."""
        return {
            mavlink.mavlink_map[number].msgname: wanted.result
            for number, wanted in self._wanted.items()
            if wanted.result not in (None, mavlink.MAV_RESULT_ACCEPTED)
        }

    def due(self, now_ns: int) -> list[tuple[int, int]]:
        """(message id, interval us) to ask for now: one at most at a time, so that answers can be told apart."""
        if self._since_ns is None:
            self._since_ns = now_ns
        settle_ns = int(self._config.rate_window_s * _NS)
        for number, wanted in self._wanted.items():
            wait_s = self._config.request_retry_s * (1 if wanted.result in (None, 0) else 10)
            if (now_ns - wanted.asked_ns) / _NS < wait_s:
                continue
            measured = now_ns - self._since_ns >= settle_ns and now_ns - wanted.asked_ns >= settle_ns
            short = measured and self.rate_hz(number, now_ns) < self._config.rate_shortfall * wanted.rate_hz
            if wanted.asked_count == 0 or short:
                wanted.asked_ns, wanted.result = now_ns, None
                wanted.asked_count += 1
                return [(number, round(1e6 / wanted.rate_hz))]
        return []

    def unanswered(self) -> bool:
        """Whether the autopilot seems not to know the request at all: asked thrice, never answered."""
        asked = [w for w in self._wanted.values() if w.asked_count]
        return bool(asked) and all(w.result is None for w in asked) and max(w.asked_count for w in asked) >= 3
