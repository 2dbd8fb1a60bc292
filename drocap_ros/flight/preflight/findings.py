"""What a check before a flight finds, and how much it matters."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, ParamSpec

from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.conditions import ConditionCode

P = ParamSpec("P")
Values = Mapping[str, float | str | bool]


@dataclass(frozen=True)
class Finding:
    """One check.

    code : of programs
    name : of people
    found, wanted, remedy : sentences; "" where there is nothing to write
    values : measured values by names with their units; NaN = unknown
    conditions : that this finding explains
    """

    code: str
    name: str
    level: Level
    found: str
    wanted: str = ""
    remedy: str = ""
    values: Values = field(default_factory=dict)
    conditions: tuple[ConditionCode, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """The finding for JSON, which has no NaN."""
        values = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in self.values.items()}
        words = {"name": self.name, "found": self.found, "wanted": self.wanted, "remedy": self.remedy}
        return {"code": self.code, "level": self.level.name.lower(), **words, "values": values}


class Verdict(NamedTuple):
    """Content of a finding; the remedy of what is OK does not count."""

    level: Level
    found: str
    wanted: str = ""
    remedy: str = ""
    values: Values | None = None

    def finding(self, code: str, name: str, conditions: tuple[ConditionCode, ...] = ()) -> Finding:
        """The finding of this name."""
        remedy = "" if self.level == Level.OK else self.remedy
        return Finding(code, name, self.level, self.found, self.wanted, remedy, self.values or {}, conditions)


def check(code: str, name: str, *conditions: ConditionCode) -> Callable[[Callable[P, Verdict]], Callable[P, Finding]]:
    """Make a check of a function that judges."""

    def made(judge: Callable[P, Verdict]) -> Callable[P, Finding]:
        @functools.wraps(judge)
        def finding(*args: P.args, **keywords: P.kwargs) -> Finding:
            return judge(*args, **keywords).finding(code, name, conditions)

        return finding

    return made


def graded(*, missing: bool = False, warning: bool = False) -> Level:
    """The level of a finding that lacks something, or should change."""
    return Level.MISSING if missing else Level.WARNING if warning else Level.OK
