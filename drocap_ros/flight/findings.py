"""What a check before a flight finds, and how much it matters."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from drocap_ros.flight.conditions import ConditionCode


class Level(enum.IntEnum):
    """How much a finding matters."""

    OK = 0
    WARNING = 1  # it flies; the setting or the link should change
    MISSING = 2  # the bridge refuses motion, or soon ends it


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
    values: Mapping[str, float | str | bool] = field(default_factory=dict)
    conditions: tuple[ConditionCode, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """The finding for JSON, which has no NaN."""
        values = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in self.values.items()}
        words = {"name": self.name, "found": self.found, "wanted": self.wanted, "remedy": self.remedy}
        return {"code": self.code, "level": self.level.name.lower(), **words, "values": values}
