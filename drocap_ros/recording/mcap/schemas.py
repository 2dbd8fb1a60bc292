"""Message definitions as text: the schemas embedded in a session, without ROS.

A schema is the ``ros2msg`` text that rosbag2 embeds: the definition, then each definition that it depends on after a
line of 80 ``=`` and ``MSG: package/Name``.  Definitions of drocap_ros are its own ``.msg`` files, with their comments;
those of ROS come from ``rosbags``.
"""

from __future__ import annotations

import os
import sys
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

PACKAGE = "drocap_ros"
#: The ROS distribution whose message definitions a session holds; its packages are those of ``requirements.in``.
ROS_DISTRIBUTION = "jazzy"
_SEPARATOR = "=" * 80 + "\n"


def _definition_folders() -> list[Path]:
    """Folders with this package's ``.msg`` files: beside the sources, in the installed package, in ROS's share."""
    here = Path(__file__).resolve().parents[2]
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    shares = [prefix / "share" / PACKAGE / "msg" for prefix in (*prefixes, Path(sys.prefix))]
    return [folder for folder in (here / "definitions", here.parent / "msg", *shares) if any(folder.glob("*.msg"))]


def own_definitions() -> dict[str, str]:
    """``drocap_ros/msg/Name`` -> text of its ``.msg`` file; empty when none are installed."""
    folders = _definition_folders()
    if not folders:
        return {}
    return {f"{PACKAGE}/msg/{path.stem}": path.read_text(encoding="utf-8") for path in sorted(folders[0].glob("*.msg"))}


@lru_cache(maxsize=1)
def standard_types() -> Typestore:
    """Message types of the ROS distribution and this package's."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores[f"ROS2_{ROS_DISTRIBUTION.upper()}"])
    types = {}
    for name, text in own_definitions().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@lru_cache(maxsize=256)
def schema_text(type_name: str) -> str:
    """Definition of a message type (``package/msg/Name``) with those of all types in it."""
    try:
        text, _ = standard_types().generate_msgdef(type_name, ros_version=2)
    except Exception as error:  # noqa: BLE001  # rosbags passes on any error of its types
        raise InputError(
            f"message type: expected one of drocap_ros or of ROS 2 {ROS_DISTRIBUTION.capitalize()}, got {type_name!r}"
            f" ({error}); register it with its schema text"
        ) from None
    # The generated text has no comments, which give the units; the package's own files replace it.
    own = own_definitions()
    first, *rest = str(text).split(_SEPARATOR)
    parts = [own.get(type_name, first)]
    for part in rest:
        head, body = part.split("\n", 1)
        parts.append(f"{head}\n{own.get(head.removeprefix('MSG: ').replace('/', '/msg/'), body)}")
    return _SEPARATOR.join(part.rstrip("\n") + "\n" for part in parts)


def types_of(type_name: str, schema: str) -> Typestore:
    """The types of a schema text alone."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema, type_name))
    return store


def type_hash(type_name: str, schema: str) -> str:
    """REP 2011 hash of a type from its schema text; empty for unusable text."""
    try:
        return types_of(type_name, schema).hash_rihs01(type_name)
    except Exception:  # noqa: BLE001  # readers do without a hash
        return ""
