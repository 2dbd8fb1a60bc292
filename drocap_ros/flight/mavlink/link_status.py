"""State of the link to the autopilot, as it is reported."""

from __future__ import annotations

import math
from typing import NamedTuple


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
            return "the autopilot reports a critical state: one of its failsafes has triggered; no orbit can begin"
        if self.refused:
            return f"the autopilot refuses to send {', '.join(sorted(self.refused))}"
        if math.isnan(self.round_trip_s):
            return (
                "the autopilot has never answered time synchronization: a late link to it is not noticed, and pictures "
                "are not matched to its clock; let the router pass TIMESYNC"
            )
        return ""
