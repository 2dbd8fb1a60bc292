"""Damages of MCAP files, as data; their text is made here."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class DamageKind(Enum):
    """Kind of a damage; the value is its text with the fields of :class:`Damage`."""

    CUT_OFF = "cut off or damaged at byte {offset} of {amount}"
    SKIPPED_BYTES = "{amount} bytes skipped at byte {offset}"
    DAMAGED_CHUNKS = "{amount} damaged chunks"
    UNKNOWN_CHANNELS = "{amount} messages of unknown channels"
    NO_SUMMARY = "no summary at the end"
    NO_MESSAGE = "no message in it"


#: Damages behind or in which other tools may find more data.
_RECOVERABLE = frozenset({DamageKind.SKIPPED_BYTES, DamageKind.DAMAGED_CHUNKS, DamageKind.UNKNOWN_CHANNELS})


class Damage(NamedTuple):
    """One damage of a file.

    offset : byte at which it starts, where known
    amount : bytes, chunks or messages, by kind; CUT_OFF: size of the file
    """

    kind: DamageKind
    offset: int = 0
    amount: int = 0

    @property
    def keeps_data(self) -> bool:
        """Whether the damaged file may hold more data than was read."""
        return self.kind in _RECOVERABLE

    def __str__(self) -> str:
        return self.kind.value.format(offset=self.offset, amount=self.amount)
