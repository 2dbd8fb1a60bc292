"""The one owner of the connection to the autopilot.

It reads and requests telemetry, sends a heartbeat and synchronizes the clocks.  Only messages of the allow-list
(``messages.py``) leave the port.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.errors import InputError
from drocap_ros.flight.autopilot import Autopilot
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.commands import TELEMETRY_COMMANDS, Message, is_motion, is_telemetry
from drocap_ros.flight.mavlink.guardian import PACKETS
from drocap_ros.flight.mavlink.parser import MavlinkParser, Packer, read_signing_key
from drocap_ros.flight.mavlink.reports import Mount, is_autopilots
from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator
from drocap_ros.flight.mavlink.telemetry_request import AutopilotSettings, LinkStatus, TelemetryRequests
from drocap_ros.flight.mavlink.transport import LinkError, Transport, open_transport
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.stamps import NS

_RECONNECT_S = 1.0  # between tries to open a broken link again

logger = logging.getLogger(__name__)


class MavlinkLink:
    """Link to one autopilot.  Use as a context manager, and either call :meth:`spin_once` or :meth:`run`.

    config : where to connect, what to request
    clock_ns : our clock, ns; that of the stamps
    monotonic_s : clock of the periods and of silence
    transport : instead of that of ``config.url``
    """

    def __init__(
        self,
        config: MavlinkBridgeConfig,
        clock_ns: Callable[[], int] = time.time_ns,
        *,
        monotonic_s: Callable[[], float] = time.monotonic,
        transport: Transport | None = None,
    ) -> None:
        self.config = config
        mount = Mount(config.mount, config.camera_pitch_deg)
        self.estimator = VehicleStateEstimator(config.target_system_id, mount)
        self._clock_ns = clock_ns
        self._monotonic_s = monotonic_s
        key = read_signing_key(config.signing_key_file) if config.signing_key_file else None
        self._transport = transport or open_transport(config.url)
        self._parser = MavlinkParser(key, clock_ns())
        self._requests = TelemetryRequests(config)
        self.settings = AutopilotSettings(mount_type=config.mount == "auto")
        # The watchdog has its own and so shares nothing with a loop that hangs.
        self._own, self._watchdog, self._guardian = (
            Packer(config.system_id, config.component_id, key, clock_ns(), link_id) for link_id in range(3)
        )
        #: Takes the packets of each step that hold the vehicle, and the port, for the time after this process.
        self.guardian: Callable[[list[bytes], tuple[int, int, int], Transport], None] | None = None
        self._autopilot: Autopilot | None = None  # None = none is heard yet
        self._heard_s: float | None = None  # monotonic
        self._due: dict[str, float] = {}
        self._sync_sent: dict[int, float] = {}  # monotonic s by our stamp, ns
        self._spun_s = math.inf  # when it was read last, monotonic
        self._answered_s = math.nan  # when the message was sent that was answered last, monotonic
        # 1.6 s of them at the greatest control_hz: no echo is awaited for longer.
        self._sent: deque[tuple[float, Message]] = deque(maxlen=80)  # monotonic s
        #: Monotonic time of the control step that decides what is sent: what is older than ``watchdog_s`` is dropped.
        self.decided_s = math.inf
        self._broken_s: float | None = None
        self._lock = threading.Lock()
        self._answers: list[tuple[int, int]] = []

    def __enter__(self) -> MavlinkLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port."""
        self._transport.close()

    def run(self, on_state: Callable[[VehicleState], None], stop: threading.Event) -> None:
        """Read until ``stop`` is set; the states go to the callback.  A broken link is opened again."""
        while not stop.is_set():
            for state in self.spin_once(0.05):
                on_state(state)

    def spin_once(self, timeout_s: float = 0.0) -> list[VehicleState]:
        """Read for at most ``timeout_s``, then send what is due: one state per attitude message.  No input raises."""
        data = self._read(timeout_s)
        before_s, self._spun_s = self._spun_s, self._monotonic_s()
        if self._spun_s - before_s > self.config.watchdog_s:
            self._answered_s += self._spun_s - before_s  # meanwhile we have asked nothing
        now_ns = self._clock_ns()
        with self._lock:
            states = [self._take(message, now_ns) for message in (self._parser.feed(data) if data else [])]
            self._send_due()
        return [state for state in states if state is not None]

    @property
    def mav(self) -> mavlink.MAVLink:
        """Encoder of our own messages."""
        return self._own.mav

    @property
    def target(self) -> tuple[int, int]:
        """System and component of the autopilot."""
        return self.estimator.system_id, self.estimator.component_id

    def send_motion(self, message: Message) -> None:
        """Send a setpoint or a command of the allow-list; one that was decided too long ago is dropped.

        A process that was stopped within a control step continues with its setpoint of that time.

        Raises AssertionError when motion is not enabled, or the message is not on the list: an error in the program.
        """
        self.check_motion(message)
        with self._lock:
            if (late_s := self.decision_age_s()) > self.config.watchdog_s:
                logger.warning("dropped a %s that was decided %.1f s ago", message.get_type(), late_s)
                return
            self._note_stream(message)
            self._transmit(message)

    def check_motion(self, message: Message) -> Message:
        """The message itself, if it is on the allow-list; for the watchdog.

        raises AssertionError : as :meth:`send_motion`
        """
        if not self.config.commands_enabled or not is_motion(message):
            raise AssertionError(f"this link sends no {message.get_type()}")
        return message

    def send_unlocked(self, message: Message) -> None:
        """Send a motion message without any lock: for the watchdog of a loop that hangs."""
        self.check_motion(message)
        self._note_stream(message)
        try:
            self._transport.write(self._pack(message, self._watchdog))
        except LinkError as error:
            logger.warning("the watchdog could not send: %s", error)

    def hand_over(self, hold: Message | None) -> None:
        """Give the guardian a motion message for the time after this process; None = nothing is commanded."""
        if self.guardian is None or self._autopilot is None:
            return
        packets = [] if hold is None else [self._pack(self.check_motion(hold), self._guardian) for _ in range(PACKETS)]
        control = (*self.target, self._autopilot.modes.get(self._autopilot.control_mode, 0))
        self.guardian(packets if self._broken_s is None else [], control, self._transport)

    def stream_gap_s(self) -> float:
        """Time in s since the last setpoint was sent; infinity before the first."""
        sent = self.sent_setpoints()
        return self._monotonic_s() - sent[-1][0] if sent else math.inf

    def sent_setpoints(self) -> list[tuple[float, Message]]:
        """(monotonic s, message) of the last ones, in order of time."""
        return list(self._sent)

    def echo(self) -> tuple[float, Message] | None:
        """(age in s, POSITION_TARGET_LOCAL_NED): the target that the autopilot follows; None before the first."""
        latest = self.estimator.echo
        return None if latest is None else ((self._clock_ns() - latest[0]) / NS, latest[1])

    def fresh_mode(self, max_age_s: float) -> str:
        """The mode by a report of at most this age; "" = it cannot be seen.  Takes no lock."""
        return self.estimator.fresh_mode(self._clock_ns(), max_age_s, self.config.max_state_age_s)

    def take_answers(self) -> list[tuple[int, int]]:
        """(command, MAV_RESULT) of the acknowledgements since the last call, without those of telemetry."""
        with self._lock:
            answers, self._answers = self._answers, []
        return answers

    def answer_age_s(self) -> float:
        """Time in s since the sending of the message that was answered last: it covers both directions; NaN before."""
        return self._monotonic_s() - self._answered_s

    def decision_age_s(self) -> float:
        """Time in s since the control step began that decides what is sent; minus infinity before."""
        return self._monotonic_s() - self.decided_s

    def status(self) -> LinkStatus:
        """State of the link now."""
        silence_s = math.inf if self._heard_s is None else self._monotonic_s() - self._heard_s
        with self._lock:
            trip_ns = self.estimator.clock.round_trip_ns
            return LinkStatus(
                connected=silence_s < self.config.link_timeout_s,
                silence_s=silence_s,
                round_trip_s=math.nan if trip_ns is None else trip_ns / NS,
                rates_hz=self._requests.rates_hz(self._clock_ns()),
                refused=self._requests.refused(),
                bad_count=self._parser.bad_count,
                refused_count=self._parser.refused_count,
                unknown_count=self._parser.unknown_count,
                critical=self.estimator.modes.system_status == mavlink.MAV_STATE_CRITICAL,
            )

    def _read(self, timeout_s: float) -> bytes:
        if self._broken_s is not None and not self._reopened(timeout_s):
            return b""
        try:
            return self._transport.read(timeout_s)
        except LinkError as error:
            self._break(error)
            return b""

    def _break(self, error: LinkError) -> None:
        logger.warning("%s; trying again every %g s", error, _RECONNECT_S)
        self._broken_s = self._monotonic_s()

    def _reopened(self, timeout_s: float) -> bool:
        if self._broken_s is None or self._monotonic_s() - self._broken_s < _RECONNECT_S:
            time.sleep(min(timeout_s, _RECONNECT_S))
            return False
        self._transport.close()
        try:
            self._transport = open_transport(self.config.url)
        except InputError:
            self._broken_s = self._monotonic_s()
            return False
        self._broken_s = None
        return True

    def _take(self, message: Message, now_ns: int) -> VehicleState | None:
        name = message.get_type()
        try:
            state = self.estimator.update(message, now_ns)
        except (ValueError, TypeError, OverflowError, AttributeError) as error:  # values outside their enumerations
            logger.debug("dropped %s: %s", name, error)
            return None
        if message.get_srcSystem() != self.estimator.system_id or self.estimator.component_id == 0:
            return state
        self._heard_s = self._monotonic_s()
        kind = self.estimator.modes.autopilot
        if kind is not None and kind is not self._autopilot:
            self._adopt(kind)
        self._requests.count(message.get_msgId(), now_ns)
        # A gimbal, a camera or another companion of this vehicle answers for itself alone, and may have its own port.
        if message.get_srcComponent() == self.estimator.component_id:
            if name == "HEARTBEAT" and is_autopilots(message):
                self._transport.accept_peer()
            self._take_answer(name, message, now_ns)
        return state

    def _adopt(self, autopilot: Autopilot) -> None:
        """Take the first autopilot, or another one on the same link."""
        if self._autopilot is not None:  # nothing that it sent, refused or said of its mount is true of the new one
            self._requests = TelemetryRequests(self.config)
            self.estimator.mount.servos = None
        self._autopilot = autopilot
        self._requests.set_autopilot(autopilot)
        self.settings.set_autopilot(autopilot)

    def _take_answer(self, name: str, message: Message, now_ns: int) -> None:
        if name == "TIMESYNC":
            self._take_time_sync(message, now_ns)
        elif name == "PARAM_VALUE":
            self.settings.take(message)
        elif name == "COMMAND_ACK" and message.command in TELEMETRY_COMMANDS:
            self._requests.acknowledge(message.result, now_ns)
        elif name == "COMMAND_ACK" and message.target_system in (0, self.config.system_id):
            self._answers = [*self._answers[-31:], (int(message.command), int(message.result))]

    def _take_time_sync(self, message: Message, now_ns: int) -> None:
        if message.tc1 == 0:  # a request of the autopilot
            self._send(self.mav.timesync_encode(now_ns, message.ts1))
            return
        sent_s = self._sync_sent.pop(message.ts1, None)
        if sent_s is not None:
            self._answered_s = sent_s if math.isnan(self._answered_s) else max(self._answered_s, sent_s)
            self.estimator.clock.exchange(message.ts1, message.tc1, now_ns)

    def _send_due(self) -> None:
        if self._is_due("heartbeat", 1.0 / self.config.heartbeat_hz):
            self._send(
                self.mav.heartbeat_encode(
                    mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
                )
            )
        if self._autopilot is None:
            return
        now_ns = self._clock_ns()
        if self._is_due("time_sync", 1.0 / self.config.time_sync_hz):
            # After so many questions without an answer the link counts as one-way.
            if len(self._sync_sent) > 64:
                self._sync_sent.clear()
            self._sync_sent[now_ns] = self._monotonic_s()
            self._send(self.mav.timesync_encode(0, now_ns))
        system, component = self.estimator.system_id, self.estimator.component_id
        # An answer names no request, so one is pending at a time.
        if self._is_due("request", 0.02):
            for number, interval_us in self._requests.due(now_ns):
                self._send(
                    self.mav.command_long_encode(
                        system, component, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, interval_us, 0, 0, 0, 0, 0
                    )
                )
        for setting in self.settings.due(self._monotonic_s()):
            self._send(self.mav.param_request_read_encode(system, component, setting.encode("ascii"), -1))

    def _is_due(self, what: str, period_s: float) -> bool:
        now = self._monotonic_s()
        if 0.0 < self._due.get(what, 0.0) - now < 2.0 * period_s:  # more: a simulated time went back
            return False
        self._due[what] = now + period_s
        return True

    def _send(self, message: Message) -> None:
        if not is_telemetry(message):
            raise AssertionError(f"this link sends no {message.get_type()}")
        self._transmit(message)

    def _note_stream(self, message: Message) -> None:
        # Over a broken link nothing leaves: the stream counts as interrupted.
        if self._broken_s is None and message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            self._sent.append((self._monotonic_s(), message))

    def _transmit(self, message: Message) -> None:
        if self._broken_s is not None:
            return
        try:
            self._transport.write(self._pack(message, self._own))
        except LinkError as error:
            self._break(error)

    def _pack(self, message: Message, stream: Packer) -> bytes:
        return stream.pack(message, self._clock_ns(), self._parser.signing.timestamp)
