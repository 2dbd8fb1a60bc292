"""``metadata.yaml`` of a rosbag2 folder, read, and written as version 9 (ROS 2 Jazzy); schemas of messages."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
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


#: Definitions of images in other packages, which recordings before ROS 2 Iron do not hold.
_OTHERS = {
    name: text.replace("; ", "\n")
    for text, *names in (
        ("std_msgs/Header header; int32 width; int32 height; string encoding; uint64 pts; uint8 flags;"
         " bool is_bigendian; uint8[] data", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"),
        ("builtin_interfaces/Time timestamp; string frame_id; uint8[] data; string format",
         "foxglove_msgs/msg/CompressedImage", "foxglove_msgs/msg/CompressedVideo"),
    )
    for name in names
}  # fmt: skip


@lru_cache(maxsize=1)
def standard_types() -> Typestore:
    """Message types of the ROS distribution and this package's."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores[f"ROS2_{ROS_DISTRIBUTION.upper()}"])
    types = {}
    for name, text in {**own_definitions(), **_OTHERS}.items():
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


#: A mapping as YAML holds it.
Yaml = dict[str, object]
METADATA_FILE = "metadata.yaml"
#: Name of the metadata records that this package writes into MCAP files.
METADATA_RECORD = "drocap_ros"
#: rosbag2's duration without an end: the most nanoseconds of an int64.
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass
class TopicRecord:
    """One topic of a session."""

    name: str
    type_name: str
    type_hash: str
    qos: list[Yaml]
    count: int = 0


@dataclass
class FileRecord:
    """One storage file of a session.

    start_ns, end_ns : log times of its first and last message; None, 0 without any
    """

    name: str
    start_ns: int | None = None
    end_ns: int = 0
    messages: int = 0

    def count(self, log_time_ns: int) -> None:
        """Add one message."""
        self.start_ns = log_time_ns if self.start_ns is None else min(self.start_ns, log_time_ns)
        self.end_ns = max(self.end_ns, log_time_ns)
        self.messages += 1


def qos_profile(*, reliable: bool = True) -> list[Yaml]:
    """Offered quality of service in rosbag2's form."""
    return [
        {
            "history": "keep_last",
            "depth": 1000,
            "reliability": "reliable" if reliable else "best_effort",
            "durability": "volatile",
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }
    ]


def dump_yaml(value: object) -> str:
    """YAML text without anchors: in the copy no object stands twice."""
    import yaml

    return str(yaml.safe_dump(json.loads(json.dumps(value)), sort_keys=False, default_flow_style=False))


def bag_metadata(files: list[FileRecord], topics: list[TopicRecord], custom: dict[str, str]) -> Yaml:
    """Content of the file: storage files, topics and times."""
    starts = [f.start_ns for f in files if f.start_ns is not None]
    start_ns = min(starts, default=None)
    # Version of the file that ROS 2 Jazzy writes.
    return {
        "rosbag2_bagfile_information": {
            "version": 9,
            "storage_identifier": "mcap",
            **_time(start_ns, max((f.end_ns for f in files), default=0)),
            "message_count": sum(f.messages for f in files),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": topic.qos,
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [f.name for f in files],
            "files": [{"path": f.name, **_time(f.start_ns, f.end_ns), "message_count": f.messages} for f in files],
            "custom_data": custom or None,
            "ros_distro": ROS_DISTRIBUTION,
        }
    }


def _time(start_ns: int | None, end_ns: int) -> Yaml:
    return {
        "duration": {"nanoseconds": 0 if start_ns is None else end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": 0 if start_ns is None else start_ns},
    }


def read_metadata(folder: Path) -> tuple[Yaml, list[str]]:
    """The description in ``metadata.yaml``, empty where there is no usable one, and warnings."""
    import yaml

    path = folder / METADATA_FILE
    if not path.exists():
        return {}, [f"{METADATA_FILE} is missing; read the files in the folder"]
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        description = content["rosbag2_bagfile_information"]
        if not isinstance(description, dict):
            raise TypeError("no table")
        return description, []
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError, RecursionError):
        return {}, [f"{METADATA_FILE} cannot be read; read the files in the folder"]


def custom_metadata(description: Yaml) -> dict[str, str]:
    """The recorder's own entries of a description."""
    custom = description.get("custom_data")
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}


def storage_files(folder: Path, description: Yaml) -> list[Path]:
    """Files of a folder in their order, with MCAP files that a crash left out of the description."""
    from drocap_ros.perception.sources.image_files import natural

    there = sorted(folder.glob("[!.]*.mcap"), key=lambda file: natural(file.name))
    named = description.get("relative_file_paths")
    files = [folder / Path(str(name)).name for name in named] if isinstance(named, list) else []
    if not all(file.is_file() for file in files):
        return there
    others = any(file.suffix != ".mcap" for file in files)
    return files if others else files + [p for p in there if p not in files]


def write_atomically(path: Path, text: str) -> None:
    """Replace a file; a reader, or a restart after a power cut, finds the old content or the new."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Force new and replaced names in a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
