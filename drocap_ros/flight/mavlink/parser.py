"""Bytes to MAVLink messages; no input raises."""

from __future__ import annotations

from typing import Any

from drocap_ros.flight.mavlink.signing import SigningMavlink, sign_with


class MavlinkParser:
    """Decodes a stream of bytes; counts what cannot be decoded.

    ArduPilot's dialect holds the common one whole, so PX4's messages decode too.

    Parameters
    ----------
    key : 32 bytes; then messages without its signature count as bad
    now_ns : our clock at the beginning; a stream that is a minute behind it is a replayed recording
    """

    def __init__(self, key: bytes | None = None, now_ns: int = 0) -> None:
        self._mav = self._fresh()
        if key is not None:
            sign_with(self._mav, key, now_ns)
        self.bad_count = self.refused_count = 0

    @property
    def signing(self) -> Any:
        """Pymavlink's state of the signatures: counts and times."""
        return self._mav.signing

    def feed(self, data: bytes) -> list[Any]:
        """Messages that these bytes complete; damaged ones are counted and left out."""
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # the parser raises many kinds on damaged packets; none may reach the flight loop
            signing = self._mav.signing
            self._mav = self._fresh()
            self._mav.signing = signing
            self.bad_count += 1
            return []
        for message in found:
            if message.get_type() == "BAD_DATA" and message.reason == "Invalid signature":
                self.refused_count += 1
        good = [m for m in found if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]
        self.bad_count += len(found) - len(good)
        return good

    @staticmethod
    def _fresh() -> Any:
        mav = SigningMavlink(None)
        mav.robust_parsing = True
        return mav
