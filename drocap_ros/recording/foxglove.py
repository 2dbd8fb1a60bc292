"""Foxglove's messages in JSON and protobuf, as objects with the fields of their definition.

Field numbers: https://github.com/foxglove/foxglove-sdk/tree/main/schemas/proto/foxglove
"""

from __future__ import annotations

import base64
import json
import struct
from types import SimpleNamespace

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.protobuf import Value, read_message

_TEXT = ("format", "encoding", "frame_id")
_COUNTS = ("width", "height", "step")
_FIELDS: dict[str, dict[str, int]] = {
    "foxglove.CompressedImage": {"timestamp": 1, "data": 2, "format": 3, "frame_id": 4},
    "foxglove.CompressedVideo": {"timestamp": 1, "frame_id": 2, "data": 3, "format": 4},
    "foxglove.RawImage": {"timestamp": 1, "width": 2, "height": 3, "encoding": 4, "step": 5, "data": 6, "frame_id": 7},
}
_LATEST_S = 2**63 // 10**9  # s: ns must fit into 64 bits with a sign


def foxglove_message(data: bytes, encoding: str, type_name: str) -> SimpleNamespace:
    """One message.

    Raises
    ------
    Exception
        Of any kind, when it is of another encoding or type, or damaged.
    """
    numbers = _FIELDS[type_name]
    if encoding == "json":
        found = json.loads(data)
        time = found.get("timestamp", {})
        values = {name: found.get(name, "" if name in _TEXT else 0) for name in numbers}
        values["data"] = base64.b64decode(found.get("data", ""), validate=True)
        time = {1: time.get("sec", 0), 2: time.get("nsec", 0)}
    else:
        by_number = read_message(data)
        values = {name: _of_protobuf(name, by_number.get(number)) for name, number in numbers.items()}
        stamp = by_number.get(numbers["timestamp"], b"")
        time = read_message(stamp) if isinstance(stamp, bytes) else {}
    sec, nanosec = int(time.get(1, 0)), int(time.get(2, 0))
    if not 0 <= sec < _LATEST_S:
        raise InputError(f"timestamp: expected a time after 1970, got {sec} s")
    values["timestamp"] = SimpleNamespace(sec=sec, nanosec=nanosec)
    kinds = {**dict.fromkeys(_TEXT, str), **dict.fromkeys(_COUNTS, int)}
    return SimpleNamespace(**{name: kinds.get(name, lambda v: v)(value) for name, value in values.items()})


def _of_protobuf(name: str, value: Value | None) -> Value | str:
    """A field; proto3 leaves out zeros and empty ones."""
    if name == "data" or name in _TEXT:
        content = value if isinstance(value, bytes) else b""
        return content.decode("utf-8", "replace") if name in _TEXT else content
    # The reader takes 32 fixed bits for a float; these are an integer.
    return struct.unpack("<I", struct.pack("<f", value))[0] if isinstance(value, float) else 0
