"""Bytes to MAVLink messages: whatever comes, it does not raise."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink


class MavlinkParser:
    """Decodes a stream of bytes; counts what cannot be decoded.

    ArduPilot's dialect holds the common one whole, so PX4's messages decode too.
    """

    def __init__(self) -> None:
        self._mav = self._fresh()
        self.bad_count = 0

    def feed(self, data: bytes) -> list[Any]:
        """Messages that are complete with these bytes; damaged ones are counted and left out."""
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # the parser raises many kinds on damaged packets; none may reach the flight loop
            self._mav = self._fresh()
            self.bad_count += 1
            return []
        good = [m for m in found if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]
        self.bad_count += len(found) - len(good)
        return good

    @staticmethod
    def _fresh() -> Any:
        mav = mavlink.MAVLink(None)
        mav.robust_parsing = True
        return mav
