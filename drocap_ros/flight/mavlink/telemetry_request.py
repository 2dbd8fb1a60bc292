"""Requests for telemetry, and the state of the link that carries it."""

from __future__ import annotations

import logging
import math
import struct
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot.autopilot import UNKNOWN, Autopilot, LossSettings
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.mavlink.parser import CurrentMode
from drocap_ros.stamps import NS


@dataclass
class _Setting:
    value: float = math.nan
    requested_s: float = -math.inf
    tries: int = 0


class AutopilotSettings:
    """Parameters of one autopilot.  Time is an argument.

    mount_type : whether the kind of the camera's mount is read, where the autopilot has a parameter for it
    preflight : whether everything is read that a check before a flight judges
    """

    def __init__(self, mount_type: bool = False, preflight: bool = False) -> None:
        self._autopilot = UNKNOWN
        self._mount_type, self._preflight = mount_type, preflight
        self._settings: dict[str, _Setting] = {}

    def set_autopilot(self, autopilot: Autopilot) -> None:
        """Set the autopilot, and forget what another one has reported."""
        self._autopilot = autopilot
        names = autopilot.preflight_names if self._preflight else autopilot.loss_names
        if self._mount_type and autopilot.mount_type_setting:
            names = (*names, autopilot.mount_type_setting)
        self._settings = {name: _Setting() for name in names}

    def due(self, now_s: float) -> list[str]:
        """Parameters to request now: often until they are reported or the tries are used up, then every 10 s."""
        names = []
        for name, setting in self._settings.items():
            # After ten tries the autopilot lacks the parameter, or the link its answers.
            patient = setting.tries >= 10 or not math.isnan(setting.value)
            # 0.7 s are two round trips of a slow radio; a known one may be changed by the ground station.
            if abs(now_s - setting.requested_s) >= (10.0 if patient else 0.7):
                setting.requested_s, setting.tries = now_s, setting.tries + 1
                names.append(name)
        return names

    def take(self, message: Message) -> None:
        """Take a PARAM_VALUE."""
        setting = self._settings.get(str(message.param_id).rstrip("\0"))
        if setting is None:
            return
        value = float(message.param_value)
        if self._autopilot.integers_in_bytes and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])
        setting.value = value if math.isfinite(value) else math.nan

    def loss_settings(self) -> LossSettings | None:
        """Reaction to the loss of setpoints; None for an autopilot without such settings."""
        return self._autopilot.loss_settings(self.reported())

    def warning(self) -> str:
        """A setting that should change and does not forbid motion, as a sentence; "" = none."""
        settings, meaning = self.loss_settings(), self._autopilot.loss_action
        if settings is None or meaning is None or settings.action not in meaning.leaves:
            return ""
        return (
            f"without setpoints the vehicle {meaning.leaves[int(settings.action)]} "
            f"({meaning.setting} {settings.action:g}); set it to {meaning.hold}, hold, on the autopilot"
        )

    def reported(self) -> dict[str, float]:
        """Values by their names, NaN = not reported."""
        return {name: setting.value for name, setting in self._settings.items()}


CURRENT_MODE_HZ = 2.0  # while nothing changes: measured
_GIMBAL = mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS

logger = logging.getLogger(__name__)


class LinkStatus(NamedTuple):
    """State of the link.

    connected : a message of the vehicle arrived within the time-out
    silence_s : since that message; infinity before the first
    round_trip_s : of the best time synchronization, NaN without one
    rates_hz : (real, wanted) of each requested message, by its name
    refused : MAV_RESULT of the messages that the autopilot does not grant
    bad_count : pieces of data that were no message, or not signed correctly
    refused_count : of these, whole messages that were not signed with our key
    unknown_count : messages whose number we do not know
    critical : whether the autopilot reports a critical state: one of its failsafes has triggered
    """

    connected: bool
    silence_s: float
    round_trip_s: float
    rates_hz: dict[str, tuple[float, float]]
    refused: dict[str, int]
    bad_count: int
    refused_count: int = 0
    unknown_count: int = 0
    critical: bool = False

    def warning(self) -> str:
        """What a flight over this link lacks, in words; "" = nothing."""
        if self.critical:
            return "the autopilot reports a critical state: unless it is that of lost setpoints, no orbit can begin"
        if self.refused:
            return f"the autopilot refuses to send {', '.join(sorted(self.refused))}"
        if math.isnan(self.round_trip_s):
            return (
                "the autopilot has never answered time synchronization: a late link to it is not noticed, and pictures "
                "are not matched to its clock; let the router pass TIMESYNC"
            )
        return ""


@dataclass
class _Wanted:
    rate_hz: float
    interval_hz: float = 0.0  # 0 = at the rate
    arrivals: deque[int] = field(default_factory=lambda: deque(maxlen=2048))
    requested_ns: int = -(10**18)
    request_count: int = 0
    result: int | None = None
    ever: bool = False  # whether it has arrived at all


class TelemetryRequests:
    """The wanted messages: requested, measured, requested again when their rate is too low.

    The measured rate decides, because acknowledgements are not reliable: behind a proxy 20 Hz was acknowledged and
    1.2 Hz arrived.  Refused messages are requested ten times more rarely.
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
            _GIMBAL: config.gimbal_hz,
        }
        if config.commands_enabled:
            # At their usual 1 Hz a pilot's change of mode and the echo of our setpoints would be noticed a second late.
            # A pilot's mode is seen within 0.2 s.
            rates[mavlink.MAVLINK_MSG_ID_HEARTBEAT] = 5.0
            # Two echoes arrive within the time after which a mismatch counts.
            rates[mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED] = 10.0
        self._wanted = {number: _Wanted(rate) for number, rate in rates.items() if rate > 0}
        self._since_ns: int | None = None

    def set_autopilot(self, autopilot: Autopilot) -> None:
        """Add the messages by which this autopilot reports its estimator's health and, soon, a change of its mode."""
        if autopilot.estimator_message:
            number = getattr(mavlink, f"MAVLINK_MSG_ID_{autopilot.estimator_message}")
            self._wanted.setdefault(number, _Wanted(self._config.status_hz))
        fixed = not autopilot.heartbeat_on_request
        if fixed and self._wanted.pop(mavlink.MAVLINK_MSG_ID_HEARTBEAT, None) is not None:
            # A change comes after one interval of those that are asked for.
            self._wanted[CurrentMode.id] = _Wanted(CURRENT_MODE_HZ, 20.0)

    def count(self, message_id: int, now_ns: int) -> None:
        """Count a message."""
        wanted = self._wanted.get(message_id)
        if wanted is not None:
            wanted.arrivals.append(now_ns)
            wanted.ever = True

    def acknowledge(self, result: int, now_ns: int) -> None:
        """Take the answer to a request.  It names no message: it belongs to the oldest unanswered request."""
        waiting = [w for w in self._wanted.values() if w.request_count and w.result is None]
        if not waiting or now_ns < waiting[0].requested_ns:
            return
        asked = min(waiting, key=lambda w: w.requested_ns)
        asked.result = result
        if asked is self._wanted.get(CurrentMode.id) and result != mavlink.MAV_RESULT_ACCEPTED:
            del self._wanted[CurrentMode.id]
            logger.warning(
                "the autopilot does not send CURRENT_MODE: a mode that the pilot chooses is noticed up to 1 s late"
            )

    def rate_hz(self, message_id: int, now_ns: int) -> float:
        """Real rate of a wanted message over the configured window."""
        window_ns = int(self._config.rate_window_s * NS)
        if self._since_ns is not None:
            window_ns = min(window_ns, max(now_ns - self._since_ns, 1))
        arrivals = self._wanted[message_id].arrivals
        # Called at every turn of the link: each outdated arrival is visited once.
        while arrivals and not 0 <= now_ns - arrivals[0] <= window_ns:  # below 0: the clock went back
            arrivals.popleft()
        return len(arrivals) * NS / window_ns

    def rates_hz(self, now_ns: int) -> dict[str, tuple[float, float]]:
        """(real, wanted) Hz of every wanted message by its name."""
        return {
            mavlink.mavlink_map[number].msgname: (self.rate_hz(number, now_ns), wanted.rate_hz)
            for number, wanted in self._wanted.items()
        }

    def refused(self) -> dict[str, int]:
        """MAV_RESULT of the messages that the autopilot does not grant, by their names; no mount is no refusal."""
        return {
            mavlink.mavlink_map[number].msgname: wanted.result
            for number, wanted in self._wanted.items()
            if wanted.result not in (None, mavlink.MAV_RESULT_ACCEPTED) and not self._no_mount(number)
        }

    def due(self, now_ns: int) -> list[tuple[int, int]]:
        """(message id, interval us) to request now: at most one, so that its answer is unambiguous."""
        if self._since_ns is None or now_ns < self._since_ns:
            self._since_ns = now_ns
        for number, wanted in self._wanted.items():
            if not self._no_mount(number) and self._is_due(number, wanted, now_ns):
                wanted.requested_ns, wanted.result = now_ns, None
                wanted.request_count += 1
                return [(number, round(1e6 / (wanted.interval_hz or wanted.rate_hz)))]
        return []

    def _is_due(self, number: int, wanted: _Wanted, now_ns: int) -> bool:
        """Whether a message was never requested, or arrives too rarely since the last request."""
        since_ns = abs(now_ns - wanted.requested_ns)  # a clock that went back must not wait for itself
        wait_s = self._config.request_retry_s * (1 if wanted.result in (None, 0) else 10)
        if since_ns / NS < wait_s or wanted.request_count == 0:
            return since_ns / NS >= wait_s
        settle_ns = int(self._config.rate_window_s * NS)
        measured = self._since_ns is not None and now_ns - self._since_ns >= settle_ns and since_ns >= settle_ns
        return measured and self.rate_hz(number, now_ns) < self._config.rate_shortfall * wanted.rate_hz

    def _no_mount(self, number: int) -> bool:
        wanted = self._wanted[number]
        # Without an answer for 20 s at the usual retries, or refused twice, there is none.
        enough = 10 if wanted.result in (None, mavlink.MAV_RESULT_ACCEPTED) else 2
        return number == _GIMBAL and wanted.request_count >= enough and not wanted.ever
