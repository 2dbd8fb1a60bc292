"""Listens to an autopilot for some seconds, by a link that cannot send motion, and judges what was heard."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.telemetry_request import AutopilotSettings
from drocap_ros.flight.mavlink.transport import Address, Transport
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.motion_checks import start_condition, vehicle_condition
from drocap_ros.flight.orbit.observer import observe_vehicle
from drocap_ros.flight.preflight.findings import LASTING, Finding, Measured, Stream, check, graded
from drocap_ros.flight.preflight.link_checks import link_findings
from drocap_ros.flight.preflight.setup_checks import Setup, setup_findings
from drocap_ros.flight.preflight.vehicle_checks import vehicle_findings
from drocap_ros.flight.vehicle import LANDED_IN_AIR, VehicleState
from drocap_ros.stamps import NS

_CONDITIONS_PERIOD_S = 0.1  # between looks at the conditions for motion: two steps of the loop
_VERSION_TRIES = 4  # to read the firmware's version, once a second


class ListeningLink(MavlinkLink):
    """A link that asks for all telemetry of a flight, and that no caller can make send motion.

    It never arms, changes a mode or writes a parameter.
    """

    def __init__(
        self,
        config: MavlinkBridgeConfig,
        clock_ns: Callable[[], int],
        monotonic_s: Callable[[], float],
        transport: Transport | None,
    ) -> None:
        # With motion enabled the link asks for the rates and parameters of a flight.
        super().__init__(
            dataclasses.replace(config, commands_enabled=True), clock_ns, monotonic_s=monotonic_s, transport=transport
        )
        self.settings = AutopilotSettings(preflight=True)
        self.version = ""
        self.arrivals: defaultdict[str, list[int]] = defaultdict(list)
        self.exchanges: list[tuple[int, int]] = []  # round trip, offset, ns
        self.others: dict[tuple[int, int], int] = {}  # MAV_TYPE by system and component
        self._senders: defaultdict[Address, set[tuple[int, int]]] = defaultdict(set)
        self._version_tries = 0

    def check_motion(self, message: Message) -> NoReturn:
        """Refuse every motion.

        Raises
        ------
        AssertionError
            Always.
        """
        raise AssertionError(f"this link sends no {message.get_type()}")

    def addresses(self) -> dict[str, frozenset[tuple[int, int]]]:
        """Who was heard from which address; the one first to which setpoints would go."""
        peer = self._transport.port()[1]
        first = sorted(self._senders, key=lambda address: (address != peer, address))
        return {f"{address[0]!s}:{address[1]!s}": frozenset(self._senders[address]) for address in first}

    def _read(self, timeout_s: float) -> bytes:
        data = super()._read(timeout_s)
        if data and self._transport.sender is not None:
            self._senders[self._transport.sender] |= set()
        return data

    def _take(self, message: Message, now_ns: int) -> VehicleState | None:
        name, source = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if self._transport.sender is not None:
            self._senders[self._transport.sender].add(source)
        if name == "HEARTBEAT" and source[1] != mavlink.MAV_COMP_ID_AUTOPILOT1:
            self.others[source] = message.type
        if name == "TIMESYNC" and message.tc1 and message.ts1 in self._sync_sent:
            trip = now_ns - message.ts1
            self.exchanges.append((trip, message.ts1 + trip // 2 - message.tc1))
        elif name == "AUTOPILOT_VERSION":
            self.version = version_text(message.flight_sw_version)
        elif name == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return None  # the message itself is the answer
        state = super()._take(message, now_ns)
        if message.get_srcSystem() == self.estimator.system_id and self.estimator.component_id:
            self.arrivals[name].append(now_ns)
        return state

    def _send_due(self) -> None:
        super()._send_due()
        wanted = self._autopilot and not self.version and self._version_tries < _VERSION_TRIES
        if wanted and self._is_due("version", 1.0):
            self._version_tries += 1
            number = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            request = mavlink.MAV_CMD_REQUEST_MESSAGE
            self._send(self.mav.command_long_encode(*self.target, request, 0, number, 0, 0, 0, 0, 0, 0))


class Listening:
    """One session of listening: :meth:`turn` again and again until :attr:`done`, then :meth:`measured`.

    seconds : since the first message of the autopilot; without one, since the beginning
    keywords : of :class:`MavlinkLink`
    """

    def __init__(
        self, config: MavlinkBridgeConfig, seconds: float, *, clock_ns: Callable[[], int] = time.time_ns,
        monotonic_s: Callable[[], float] = time.monotonic, transport: Transport | None = None,
    ) -> None:  # fmt: skip
        self.link = ListeningLink(config, clock_ns=clock_ns, monotonic_s=monotonic_s, transport=transport)
        self._config, self._seconds = self.link.config, seconds
        self._clock_ns, self._monotonic_s = clock_ns, monotonic_s
        self._begin_s, self._heard_s = monotonic_s(), math.inf
        self._vehicle: VehicleState | None = None
        self._delays: list[tuple[int, float]] = []
        self._from_ns: int | None = None
        self._samples, self._next_sample_s = 0, 0.0
        self._failed: Counter[ConditionCode] = Counter()
        self._examples: dict[ConditionCode, Condition] = {}

    @property
    def progress(self) -> float:
        """Share of the time that is over."""
        begin_s = self._begin_s if math.isinf(self._heard_s) else self._heard_s
        return min((self._monotonic_s() - begin_s) / self._seconds, 1.0)

    @property
    def done(self) -> bool:
        """Whether the time is over."""
        return self.progress >= 1.0

    def turn(self, wait_s: float = 0.02) -> None:
        """Read for a moment and send the requests that are due."""
        states = self.link.spin_once(wait_s)
        now_ns, now_s = self._clock_ns(), self._monotonic_s()
        for state in states:
            self._vehicle = state
            self._delays.append((now_ns, (now_ns - state.stamp_ns) / NS))
        if math.isinf(self._heard_s) and self.link.estimator.component_id:
            self._heard_s = now_s
        # The autopilot needs the first half to grant the requests and to answer.
        if self._from_ns is None and not math.isinf(self._heard_s) and self.progress >= 0.5:
            self._from_ns = now_ns
        if self._from_ns is not None and now_s >= self._next_sample_s:
            self._next_sample_s = now_s + _CONDITIONS_PERIOD_S
            self._sample(now_ns)

    def _sample(self, now_ns: int) -> None:
        # As in flight, so that not everything hides behind "not armed".
        seen = Observed()
        if self._vehicle is not None:
            seen = observe_vehicle(self.link, self._config, self._vehicle, now_ns)
        flying = dataclasses.replace(seen.health, armed=True, landed_state=LANDED_IN_AIR)
        seen = dataclasses.replace(seen, health=flying)
        failed = vehicle_condition(seen, self._config) or start_condition(seen)
        self._samples += 1
        if failed is not None:
            self._failed[failed.code] += 1
            self._examples[failed.code] = failed

    def measured(self) -> Measured:
        """What was heard; rates and delays are those of the second half of the time."""
        link, now_ns = self.link, self._clock_ns()
        from_ns = now_ns if self._from_ns is None else self._from_ns
        status = link.status()
        trips = np.array(link.exchanges, dtype=np.int64).reshape(-1, 2)
        return Measured(
            vehicle=link.estimator.snapshot(now_ns), heard=not math.isinf(self._heard_s), version=link.version,
            streams={
                name: _stream(link.arrivals.get(name, []), from_ns, now_ns, wanted)
                for name, (_, wanted) in status.rates_hz.items()
            },
            refused=status.refused, settings=link.settings.reported(),
            round_trips_s=trips[:, 0] / NS, offsets_s=(trips[:, 1] - trips[:1, 1].sum()) / NS,
            delays_s=np.array([delay for at, delay in self._delays if at >= from_ns]),
            good_count=sum(map(len, link.arrivals.values())), bad_count=status.bad_count,
            unsigned_count=status.refused_count, packet_loss=link.estimator.packets.loss,
            systems=link.estimator.systems, others=link.others, addresses=link.addresses(),
            conditions=tuple(
                (self._examples[code], self._failed[code] / self._samples) for code in sorted(self._failed)
            ),
        )  # fmt: skip

    def close(self) -> None:
        """Close the port."""
        self.link.close()


def version_text(number: int) -> str:
    """``flight_sw_version`` of AUTOPILOT_VERSION as in "4.6.2"; a release has no suffix."""
    kinds = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}
    major, minor, patch, kind = number.to_bytes(4, "big")
    return f"{major}.{minor}.{patch}{kinds.get(kind, '')}"


def _stream(arrivals: list[int], from_ns: int, now_ns: int, wanted_hz: float) -> Stream:
    recent, seconds = [at for at in arrivals if at >= from_ns], (now_ns - from_ns) / NS
    if seconds <= 0:
        return Stream(math.nan, wanted_hz)
    gap_s = max(np.diff([from_ns, *recent, now_ns])) / NS
    return Stream(len(recent) / seconds, wanted_hz, float(gap_s))


def all_findings(config: MavlinkBridgeConfig, setup: Setup, measured: Measured) -> list[Finding]:
    """Every check.

    A condition for motion that fails and that no check explains is a finding of its own, so that no condition of the
    bridge can be forgotten here.
    """
    found = [*setup_findings(config, setup, measured.vehicle)]
    if not measured.heard:
        return [*found, _silence(config, measured)]
    found += link_findings(config, measured)
    if measured.vehicle is None:
        remedy = "wait until the autopilot has started; check that it may send ATTITUDE_QUATERNION"
        verdict = Finding(Level.MISSING, "no attitude", "attitude and position", remedy)
        found.append(verdict.named("vehicle", "vehicle"))
    else:
        found += vehicle_findings(config, measured, measured.vehicle)
    explained = {code for finding in found if finding.level != Level.OK for code in finding.conditions}
    found += [_unexplained(failed, share) for failed, share in measured.conditions if failed.code not in explained]
    return found


def is_ready(found: Sequence[Finding]) -> bool:
    """Whether nothing is missing."""
    return all(finding.level != Level.MISSING for finding in found)


def _unexplained(failed: Condition, share: float) -> Finding:
    level, words = graded(missing=share > LASTING, warning=True), f"{failed} ({share:.0%} of the time)"
    verdict = Finding(level, words, "none that fails", "see docs/flight.md, conditions for motion", {"share": share})
    return verdict.named(f"condition_{failed.code.name.lower()}", "condition for motion", (failed.code,))


@check("link", "link")
def _silence(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    data, remedy = "nothing", "check the cable, the power and the URL"
    if measured.unsigned_count:
        data = f"{measured.unsigned_count} messages that are not signed with the key of signing_key_file"
        remedy = "give the autopilot the same key, or remove signing_key_file"
    elif measured.bad_count:
        data = f"{measured.bad_count} pieces of data that are no MAVLink"
        remedy = "check the baud rate, and that the port's protocol is MAVLink 2"
    elif config.target_system_id:
        remedy += f", and target_system_id {config.target_system_id}"
    found = f"{data} {measured.bridge or f'on {config.url}'}"
    values = {"bad": measured.bad_count, "unsigned": measured.unsigned_count}
    return Finding(Level.MISSING, found, "an autopilot's heartbeat", remedy, values)
