"""Content of a session, without what the wall clock and the disk put into it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from drocap_ros.recording.open_session import open_session

_LARGE = 1000  # elements: of a picture, not of a pose
_DECODED = ("/diagnostics", "/drocap/pose3d/refined")


def session_contents(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, each with its log time, in the order of the recording.

    A message is the digest of its fields, not of its bytes: the serializer leaves the gaps between aligned fields as
    the memory was.  In ``/diagnostics`` and ``pose3d/refined`` it is the fields, without ``solve_seconds`` (wall
    clock) and without the recorder's status, which names its folder and the disk's state.
    """
    contents: dict[str, list[tuple[int, Any]]] = {}
    with open_session(path) as session:
        for raw in session.raw_messages():
            found = str(_fields(session.decode(raw)))
            if raw.topic not in _DECODED:
                found = hashlib.blake2b(found.encode(), digest_size=16).hexdigest()
            contents.setdefault(raw.topic, []).append((raw.log_time_ns, found))
    return contents


def _fields(value: Any) -> Any:
    if hasattr(value, "hardware_id") and value.name.endswith("/session_recorder"):
        return value.name
    if hasattr(value, "__dataclass_fields__"):
        return {
            name: _fields(getattr(value, name)) for name in value.__dataclass_fields__
            if not name.startswith("__") and name != "solve_seconds"
        }  # fmt: skip
    if isinstance(value, list | tuple):
        return [_fields(element) for element in value]
    if hasattr(value, "tobytes"):
        return value.tobytes() if value.size > _LARGE else value.tolist()
    return value
