"""Bytes to MAVLink messages; no input raises."""

from __future__ import annotations

from typing import Any

import drocap_ros.flight.mavlink.current_mode  # noqa: F401  registers the message
from drocap_ros.flight.mavlink.signing import SigningMavlink, sign_with


class MavlinkParser:
    """Decodes a stream of bytes; counts what cannot be decoded.

    Pymavlink's largest dialect holds the common one of its time.  Messages that it does not have are no damage: a
    healthy autopilot sends two a second.

    Parameters
    ----------
    key : 32 bytes; then messages without its signature count as bad
    now_ns : our clock at the beginning; a stream that is a minute behind it is a replayed recording

    Attributes
    ----------
    bad_count, refused_count : pieces of data that are no message; of these, whole messages without our signature
    unknown_count : messages whose number the dialect does not have; their checksum cannot be verified
    """

    def __init__(self, key: bytes | None = None, now_ns: int = 0) -> None:
        self._mav = self._fresh()
        if key is not None:
            sign_with(self._mav, key, now_ns)
        self.bad_count = self.refused_count = self.unknown_count = 0

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
        good = []
        for message in found:
            name = message.get_type()
            if name.startswith("UNKNOWN"):
                self.unknown_count += 1
            elif name == "BAD_DATA":
                self.bad_count += 1
                self.refused_count += message.reason == "Invalid signature"
            else:
                good.append(message)
        return good

    @staticmethod
    def _fresh() -> Any:
        mav = SigningMavlink(None)
        mav.robust_parsing = True
        return mav
