"""The flight mode: the newer of HEARTBEAT and CURRENT_MODE counts, and no mode that was reported is overlooked."""

from __future__ import annotations

import math
from collections import deque

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import Autopilot, autopilot_by_heartbeat
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.stamps import NS

#: Packets; farther back a sequence number counts as the beginning of a new sequence.
_MAX_LATE = 32
_HISTORY_S = 1.0  # in which packets of a former mode may still arrive late
#: Share of lost packets above which no mode is requested: the pilot may have chosen one unseen.  At a quarter, the
#: chance that both reports of a mode within 0.2 s are lost is 6 %.
MAX_LOSS = 0.25
_LOSS_RATE = 1 / 64  # a packet: the share of lost ones is that of the last 64, about half a second of telemetry


class PacketOrder:
    """Which packets of one sender are late or lost, by the sequence number that MAVLink counts modulo 256.

    loss : share of the last packets that have not arrived
    """

    def __init__(self) -> None:
        self.loss = 0.0
        self._newest: int | None = None

    def is_late(self, sequence: int) -> bool:
        """Take the next packet; returns whether it arrives after newer ones."""
        sent = 0 if self._newest is None else (sequence - self._newest) % 256
        if sent >= 256 - _MAX_LATE:
            self.loss = max(self.loss - _LOSS_RATE, 0.0)  # it had counted as lost
            return True
        if sent > 0:
            missing = 1.0 - (1.0 - self.loss) * (1.0 - _LOSS_RATE) ** (sent - 1)
            self.loss = missing * (1.0 - _LOSS_RATE)
        self._newest = sequence
        return False


class ModeReports:
    """The mode of one vehicle.

    autopilot : None before the first heartbeat
    mode : by the newest report, the autopilot's own name; "" before the first
    intended : the mode that the pilot or a command has chosen last, as CURRENT_MODE reported it together with the
        present mode; "" = unknown.  An autopilot may keep it where a failsafe enters another mode.
    vehicle_type : MAV_TYPE, by the last heartbeat
    armed : by the last heartbeat
    system_status : MAV_STATE, by the last heartbeat; 0 = unknown, also where a critical state was reported together
        with a mode that has changed since: a failsafe that acts sets the mode
    received_ns : reception of the newest report that did not arrive late
    """

    def __init__(self) -> None:
        self.autopilot: Autopilot | None = None
        self.mode = self.intended = ""
        self.vehicle_type = self.system_status = 0
        self.armed = False
        self.received_ns: int | None = None
        self._heartbeat: Message | None = None
        self._before = ""
        self._changed = (0, 0)  # sequence and reception of the first report of the present mode
        self._heard: deque[str] = deque(maxlen=32)  # appended by one thread and drained by another

    def take_heartbeat(self, message: Message, late: bool, now_ns: int) -> None:
        """Take a HEARTBEAT; ``late``: it was sent before a packet that has already arrived."""
        self._heartbeat = message
        self.autopilot, self.vehicle_type = autopilot_by_heartbeat(message.autopilot), int(message.type)
        if not late:
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.system_status = int(message.system_status)
        # The mode that is intended belongs to the mode with which it was reported.
        mode = self._name(message.custom_mode)
        self._take(mode, self.intended if mode == self.mode else "", message.get_seq(), late, now_ns)

    def take_current_mode(self, message: Message, late: bool, now_ns: int) -> None:
        """Take a CURRENT_MODE; before the first heartbeat its numbers have no names."""
        if self._heartbeat is None:
            return
        intended, mode = message.intended_custom_mode, self._name(message.custom_mode)
        if not late and mode != self.mode and self.system_status == mavlink.MAV_STATE_CRITICAL:
            self.system_status = 0
        self._take(mode, self._name(intended) if intended else "", message.get_seq(), late, now_ns)

    def take_heard(self) -> frozenset[str]:
        """All modes that were reported since the last call, late ones too."""
        heard = set()
        while self._heard:
            heard.add(self._heard.popleft())
        return frozenset(heard)

    def age_s(self, now_ns: int) -> float:
        """Time in s since the newest report; infinity before the first."""
        return math.inf if self.received_ns is None else (now_ns - self.received_ns) / NS

    def _take(self, mode: str, intended: str, sequence: int, late: bool, now_ns: int) -> None:
        if late:
            # What was sent before the present mode began, with the mode of that time, is no news.  Any other mode is
            # one in between: the vehicle was in it.
            first, since_ns = self._changed
            history = 0 < (first - sequence) % 256 <= _MAX_LATE and now_ns - since_ns < _HISTORY_S * NS
            if not (history and mode == self._before):
                self._heard.append(mode)
            return
        if mode != self.mode:
            self._before, self._changed = self.mode, (sequence, now_ns)
        self.mode, self.intended, self.received_ns = mode, intended, now_ns
        self._heard.append(mode)

    def _name(self, custom_mode: int) -> str:
        """A mode by the autopilot's own name, or its number where neither its table nor pymavlink knows one."""
        from pymavlink import mavutil

        assert self.autopilot is not None
        assert self._heartbeat is not None
        if name := self.autopilot.mode_name(custom_mode):
            return name
        kind, custom = self._heartbeat, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        numbered = mavlink.MAVLink_heartbeat_message(kind.type, kind.autopilot, custom, custom_mode, 0, 3)
        return str(mavutil.mode_string_v10(numbered))
