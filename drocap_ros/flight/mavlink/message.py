"""The type of a MAVLink message: pymavlink has no types."""

from __future__ import annotations

from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink


class Message(Protocol):
    """What every message of pymavlink has; the fields of its kind are attributes too."""

    def get_type(self) -> str:
        """Name, as in MAVLink's definition."""

    def get_msgId(self) -> int:  # noqa: N802  pymavlink's name, as the next two
        """Number of the kind."""

    def get_srcSystem(self) -> int:  # noqa: N802
        """System of the sender."""

    def get_srcComponent(self) -> int:  # noqa: N802
        """Component of the sender."""

    def get_seq(self) -> int:
        """Sequence number of the packet, modulo 256."""

    def pack(self, mav: mavlink.MAVLink) -> bytes:
        """The packet's bytes by an encoder; its sequence number is not advanced."""

    def __getattr__(self, name: str) -> Any: ...
