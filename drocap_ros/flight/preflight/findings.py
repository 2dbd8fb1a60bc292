"""What is heard before a flight, what a check of it finds, and how much that matters."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, ParamSpec

import numpy as np

from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.conditions import Condition, ConditionCode
from drocap_ros.flight.vehicle import VehicleState

#: Share of the time above which a failing condition is no mere gap.
LASTING = 0.5


class Stream(NamedTuple):
    """A wanted message: rates in Hz, and the longest time between two in s; NaN = not measured."""

    real_hz: float
    wanted_hz: float
    longest_gap_s: float = math.nan


@dataclass(frozen=True)
class Measured:
    """What was heard of an autopilot within some seconds.

    vehicle : its last state; None = no heartbeat or no attitude
    heard : whether an autopilot was heard at all
    version : of its firmware; "" = not reported
    streams : the wanted messages by their names
    refused : MAV_RESULT of the messages that it refuses to send
    settings : its parameters; NaN = asked for and not reported, absent = not asked for
    round_trips_s : of time synchronization
    offsets_s : (N,) our clock minus its clock, one by each exchange; their spread counts
    delays_s : (N,) age of each state at its arrival
    good_count, bad_count, unsigned_count : messages; data that is none; messages without our signature
    packet_loss : share of the autopilot's last packets that did not arrive
    systems : MAVLink systems of all autopilots on the link
    others : MAV_TYPE of ground stations, gimbals and the like, by system and component
    addresses : systems and components heard by the address of their datagrams, the one first to which setpoints go;
        empty = the port has one peer
    conditions : conditions for motion that failed, with the share of the time, in the order of the checks; as if the
        vehicle were armed and in the air
    bridge : state and reason of the running bridge that was listened to; "" = the link itself
    """

    vehicle: VehicleState | None = None
    heard: bool = False
    version: str = ""
    streams: Mapping[str, Stream] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    settings: Mapping[str, float] = field(default_factory=dict)
    round_trips_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    offsets_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    delays_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    good_count: int = 0
    bad_count: int = 0
    unsigned_count: int = 0
    packet_loss: float = 0.0
    systems: frozenset[int] = frozenset()
    others: Mapping[tuple[int, int], int] = field(default_factory=dict)
    addresses: Mapping[str, frozenset[tuple[int, int]]] = field(default_factory=dict)
    conditions: tuple[tuple[Condition, float], ...] = ()
    bridge: str = ""

    def setting(self, name: str) -> float:
        """A parameter of the autopilot; NaN = not reported, or not asked for."""
        return self.settings.get(name, math.nan)


P = ParamSpec("P")
Values = Mapping[str, float | str | bool]


@dataclass(frozen=True)
class Finding:
    """One check; :func:`check` and :meth:`named` give it its names.

    found, wanted, remedy : sentences; "" where there is nothing to write
    values : measured values by names with their units; NaN = unknown
    code : of programs
    name : of people
    conditions : that this finding explains
    """

    level: Level
    found: str
    wanted: str = ""
    remedy: str = ""
    values: Values = field(default_factory=dict)
    code: str = ""
    name: str = ""
    conditions: tuple[ConditionCode, ...] = ()

    def named(self, code: str, name: str, conditions: tuple[ConditionCode, ...] = ()) -> Finding:
        """The finding of this name; the remedy of what is OK does not count."""
        remedy = "" if self.level == Level.OK else self.remedy
        return dataclasses.replace(self, code=code, name=name, conditions=conditions, remedy=remedy)

    def as_dict(self) -> dict[str, object]:
        """The finding for JSON, which has no NaN."""
        values = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in self.values.items()}
        words = {"name": self.name, "found": self.found, "wanted": self.wanted, "remedy": self.remedy}
        return {"code": self.code, "level": self.level.name.lower(), **words, "values": values}


def check(code: str, name: str, *conditions: ConditionCode) -> Callable[[Callable[P, Finding]], Callable[P, Finding]]:
    """Make a check of a function that judges."""

    def made(judge: Callable[P, Finding]) -> Callable[P, Finding]:
        @functools.wraps(judge)
        def finding(*args: P.args, **keywords: P.kwargs) -> Finding:
            return judge(*args, **keywords).named(code, name, conditions)

        return finding

    return made


def graded(*, missing: bool = False, warning: bool = False) -> Level:
    """The level of a finding that lacks something, or should change."""
    return Level.MISSING if missing else Level.WARNING if warning else Level.OK
