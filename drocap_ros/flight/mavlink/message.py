"""The type of a MAVLink message: pymavlink has no types."""

from __future__ import annotations

from typing import Any, Protocol


class Message(Protocol):
    """A message of pymavlink: ``get_type()`` and the like, and the fields of its kind."""

    def __getattr__(self, name: str) -> Any: ...
