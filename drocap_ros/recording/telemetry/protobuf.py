"""Messages in protobuf's wire format, read by field number without a schema.

Source: https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

import struct

#: An integer (varint), a number (fixed 32 or 64 bits, as float or double), or bytes (text or a message).
Value = int | float | bytes

#: Values of a varint: the sign bit of 64, and their number.
_SIGN = 1 << 63
_RANGE = 1 << 64  # values of 64 bits

#: Wire type -> bytes of a number of fixed size.
_SIZES = {1: 8, 5: 4}


def read_message(data: bytes) -> dict[int, Value]:
    """Fields of a message by number; of a repeated one the last.  Integers are signed by two's complement.

    Raises ValueError when the data is no message.
    """
    fields: dict[int, Value] = {}
    place, end = 0, len(data)
    while place < end:
        key, place = _varint(data, place)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, place = _varint(data, place)
            fields[number] = value - _RANGE if value >= _SIGN else value
            continue
        size, place = _varint(data, place) if wire == 2 else (_SIZES.get(wire, end), place)
        if number == 0 or place + size > end:
            raise ValueError("a field that is cut off or of an unknown kind")
        content = data[place : place + size]
        place += size
        fields[number] = content if wire == 2 else struct.unpack("<d" if wire == 1 else "<f", content)[0]
    return fields


class Message:
    """A message whose parts are read when they are asked for, each once; damaged parts count as missing."""

    def __init__(self, data: bytes) -> None:
        self._parts: dict[tuple[int, ...], dict[int, Value]] = {(): read_message(data)}

    def at(self, path: tuple[int, ...]) -> Value | None:
        """The value at a path of field numbers, None where there is none."""
        return self.fields(path[:-1]).get(path[-1])

    def fields(self, path: tuple[int, ...]) -> dict[int, Value]:
        """The fields of the message at a path, empty where there is none."""
        found = self._parts.get(path)
        if found is None:
            content = self.at(path)
            try:
                found = read_message(content) if isinstance(content, bytes) else {}
            except ValueError:
                found = {}
            self._parts[path] = found
        return found

    def holds(self, path: tuple[int, ...]) -> bool:
        """Whether there is a message at a path, an empty one included: proto3 leaves out zeros."""
        return isinstance(self.at(path), bytes)


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        if place >= len(data):
            raise ValueError("a number that is cut off")
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (_RANGE - 1), place
        shift += 7
    raise ValueError("a number of more than ten bytes")
