"""Foxglove's messages in JSON and protobuf, as objects with the fields of their definition.

Field numbers: https://github.com/foxglove/foxglove-sdk/tree/main/schemas/proto/foxglove
"""

from __future__ import annotations

import json
import struct
from types import SimpleNamespace

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.protobuf import Value, read_message

_TEXT = ("format", "encoding", "frame_id")
_FIELDS: dict[str, dict[str, int]] = {
    "foxglove.CompressedImage": {"timestamp": 1, "data": 2, "format": 3, "frame_id": 4},
    "foxglove.CompressedVideo": {"timestamp": 1, "frame_id": 2, "data": 3, "format": 4},
    "foxglove.RawImage": {
        "timestamp": 1, "width": 2, "height": 3, "encoding": 4, "step": 5, "data": 6, "frame_id": 7,
    },
}  # fmt: skip


def foxglove_message(data: bytes, encoding: str, type_name: str) -> SimpleNamespace:
    """One message.

    Raises
    ------
    InputError, ValueError
        When it is of another encoding or type, or damaged.
    """
    if encoding == "json":
        found = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
        if not isinstance(found, SimpleNamespace):
            raise InputError("message: expected an object in JSON")
        return found
    if encoding != "protobuf" or type_name not in _FIELDS:
        raise InputError(f"message: expected {', '.join(_FIELDS)}, found {type_name} in {encoding}")
    values = read_message(data)
    return SimpleNamespace(**{name: _field(name, values.get(number)) for name, number in _FIELDS[type_name].items()})


def _field(name: str, value: Value | None) -> object:
    """A field; proto3 leaves out zeros and empty ones."""
    if name == "timestamp":
        parts = read_message(value) if isinstance(value, bytes) else {}
        return SimpleNamespace(sec=parts.get(1, 0), nanosec=parts.get(2, 0))
    if name in ("data", *_TEXT):
        content = value if isinstance(value, bytes) else b""
        return content.decode("utf-8", "replace") if name in _TEXT else content
    # The reader takes 32 fixed bits for a float; these are an integer.
    return struct.unpack("<I", struct.pack("<f", value))[0] if isinstance(value, float) else int(value or 0)
