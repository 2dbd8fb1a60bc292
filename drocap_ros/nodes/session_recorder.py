"""Node ``session_recorder``: every topic of the graph into a rosbag2 MCAP session.

Subscribes to all topics of ``topics.TOPICS`` as serialized bytes and writes them as they are.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from drocap_ros.nodes.component import OK, WARN, ComponentNode
from drocap_ros.nodes.run import node_main
from drocap_ros.nodes.topics import IMAGE_RECORDING_QOS, TOPICS
from drocap_ros.recording.schemas import schema_text
from drocap_ros.recording.session_writer import SessionWriter


class SessionRecorderNode(ComponentNode):
    """Hands the bytes of every message to the writer's queue."""

    component = "session_recorder"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._writer = SessionWriter(Path(self.config.session_dir), self.config)
        for topic, entry in TOPICS.items():
            name = topic if topic.startswith("/") else f"{self.get_namespace().rstrip('/')}/{topic}"
            kind = _type_name(entry.message)
            image = topic == "image/compressed"
            self._writer.register(name, kind, schema_text(kind), image=image)
            qos = IMAGE_RECORDING_QOS if image else entry.qos
            self.input(topic, partial(self._on_message, name), raw=True, qos=qos)
        self.create_timer(1.0, self._on_second)

    def _on_message(self, name: str, data: bytes) -> None:
        self._writer.write(name, data, self.get_clock().now().nanoseconds)
        self.count("messages")

    def _on_second(self) -> None:
        if self._writer.dropped:
            self.report(WARN, f"{self._writer.dropped} messages dropped: the disk is too slow")
        else:
            self.report(OK, f"recording to {self.config.session_dir}")

    def close(self) -> None:
        """Write what is queued and finish the files."""
        self._writer.close()


def _type_name(message: type) -> str:
    package = message.__module__.split(".")[0]
    return f"{package}/msg/{message.__name__}"


def main() -> int:
    """Run the node as a process."""
    return node_main(SessionRecorderNode)


if __name__ == "__main__":
    raise SystemExit(main())
