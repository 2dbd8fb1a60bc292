"""``metadata.yaml`` of a rosbag2 folder, version 9, as ROS 2 Jazzy writes it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

METADATA_FILE = "metadata.yaml"
_VERSION = 9
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass
class TopicRecord:
    """One topic of a session."""

    name: str
    type_name: str
    type_hash: str
    qos: list[dict[str, Any]]
    count: int = 0


def qos_profile(*, reliable: bool = True, depth: int = 1000) -> list[dict[str, Any]]:
    """Offered quality of service in rosbag2's form."""
    return [
        {
            "history": "keep_last",
            "depth": depth,
            "reliability": "reliable" if reliable else "best_effort",
            "durability": "volatile",
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }
    ]


def dump_yaml(value: Any) -> str:
    """YAML text without anchors."""
    import yaml

    class Plain(yaml.SafeDumper):
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return str(yaml.dump(value, Dumper=Plain, sort_keys=False, default_flow_style=False))


def bag_metadata(
    file_name: str, topics: list[TopicRecord], start_ns: int | None, end_ns: int, custom: dict[str, str]
) -> dict[str, Any]:
    """Content of the file: one storage file, its topics, its time."""
    count = sum(topic.count for topic in topics)
    begin = {"nanoseconds_since_epoch": 0 if start_ns is None else start_ns}
    duration = {"nanoseconds": 0 if start_ns is None else end_ns - start_ns}
    return {
        "rosbag2_bagfile_information": {
            "version": _VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": begin,
            "message_count": count,
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
            "relative_file_paths": [file_name],
            "files": [{"path": file_name, "starting_time": begin, "duration": duration, "message_count": count}],
            "custom_data": custom or None,
            "ros_distro": "jazzy",
        }
    }


def write_atomically(path: Path, text: str) -> None:
    """Replace a file so that a reader or a power cut finds the old content or the new, never half of it."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
