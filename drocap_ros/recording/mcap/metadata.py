"""``metadata.yaml`` of a rosbag2 folder: reading, and writing of version 9 (since ROS 2 Jazzy)."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.recording.mcap.schemas import ROS_DISTRIBUTION

#: A mapping as YAML holds it.
Yaml = dict[str, object]
METADATA_FILE = "metadata.yaml"
#: Name of the metadata records that this package writes into MCAP files.
METADATA_RECORD = "drocap_ros"
#: Version of the file that ROS 2 Jazzy writes.
_VERSION = 9
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
    return {
        "rosbag2_bagfile_information": {
            "version": _VERSION,
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
    there = sorted(folder.glob("*.mcap"), key=_by_number)
    named = description.get("relative_file_paths")
    files = [folder / Path(str(name)).name for name in named] if isinstance(named, list) else []
    if not all(file.is_file() for file in files):
        return there
    others = any(file.suffix != ".mcap" for file in files)
    return files if others else files + [p for p in there if p not in files]


def _by_number(path: Path) -> tuple[int | str, ...]:
    """``s_10`` comes after ``s_9``."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name))


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
