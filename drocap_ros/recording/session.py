"""A recording that is open for reading: its topics, metadata and messages, independent of the file format."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from drocap_ros.errors import InputError

#: A message as rclpy or rosbags decodes it: the fields of its definition, no common class.
Message: TypeAlias = Any
POSE2D = "drocap_ros/msg/Pose2D"
BACKGROUND_TRACKS = "drocap_ros/msg/BackgroundTracks"
POSE3D = "drocap_ros/msg/Pose3D"
POSE3D_WINDOW = "drocap_ros/msg/Pose3DWindow"
VEHICLE_STATE = "drocap_ros/msg/VehicleState"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
#: Types of calibrations.
CALIBRATIONS = (CAMERA_INFO, "foxglove_msgs/msg/CameraCalibration", "foxglove.CameraCalibration")
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
#: Types of images and of packets of a video.
_FOXGLOVE = ("RawImage", "CompressedImage", "CompressedVideo")
IMAGES = (
    *(IMAGE, COMPRESSED_IMAGE, "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"),
    *(f"{package}{kind}" for package in ("foxglove_msgs/msg/", "foxglove.") for kind in _FOXGLOVE),
)

#: Bytes of a message: an image of 8000x6000 px and more; a longer one is damage.
_MAX_MESSAGE = 1 << 29
#: Forms of a recording, for messages.
FORMS = "a session folder, .mcap, .bag, .db3 or rosbag2 folder"


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a recording."""

    name: str
    type_name: str
    count: int


@dataclass(frozen=True)
class SessionInfo:
    """Content of a recording.

    start_ns, end_ns : log times of the first and last message, None without any
    metadata : written by the recorder
    warnings : text, parts that could not be read
    """

    path: Path
    kind: str
    topics: tuple[TopicInfo, ...]
    start_ns: int | None
    end_ns: int | None
    metadata: dict[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return 0.0 if self.start_ns is None or self.end_ns is None else (self.end_ns - self.start_ns) * 1e-9

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(topic.count for topic in self.topics)


class RawMessage(NamedTuple):
    """One serialized message; :meth:`Session.decode` decodes it."""

    topic: str
    type_name: str
    log_time_ns: int
    data: bytes
    source: object


class Session(ABC):
    """A recording; use as a context manager.  Messages are streamed, never loaded whole.

    Definitions of messages come from the recording: topics of types that are not installed stay readable.

    warnings : text, parts that could not be read so far
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self._info: SessionInfo | None = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def info(self) -> SessionInfo:
        """Topics, counts and times; read once."""
        if self._info is None:
            self._info = self._read_info()
        return dataclasses.replace(self._info, warnings=tuple(self.warnings))

    def topics_of(self, *type_names: str) -> list[TopicInfo]:
        """Topics of some types that have messages, those with most messages first."""
        found = [topic for topic in self.info.topics if topic.type_name in type_names and topic.count]
        return sorted(found, key=lambda topic: (-topic.count, topic.name))

    def choose_topic(self, *type_names: str) -> TopicInfo:
        """The topic of some types with most messages."""
        found = self.topics_of(*type_names)
        kinds = " or ".join(type_names)
        if not found:
            nothing = "no messages" if self.info.topics else "no topics"
            there = ", ".join(f"{t.name} ({t.type_name})" for t in self.info.topics if t.count) or nothing
            raise InputError(f"{self.path}: expected a topic of type {kinds}, found {there}; record one")
        if len(found) > 1:
            self.warn(f"several topics of type {kinds}: {', '.join(t.name for t in found)}; took {found[0].name}")
        return found[0]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[RawMessage, Message]]:
        """Decoded messages of some topics; messages that cannot be decoded are left out with a warning."""
        failed = Counter[str]()
        for raw in self.raw_messages(topics):
            try:
                message = self.decode(raw)
            except Exception:  # noqa: BLE001  # a damaged message fails in many ways
                failed[raw.type_name] += 1
                continue
            yield raw, message
        if failed:
            kinds = ", ".join(failed)
            self.warn(f"{failed.total()} messages could not be decoded and were left out ({kinds}; damaged, or the"
                      " recording lacks their definition)")  # fmt: skip

    def warn(self, text: str) -> None:
        """Add a warning, once."""
        if text not in self.warnings:
            self.warnings.append(text)

    @abstractmethod
    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of the recording."""

    @abstractmethod
    def decode(self, raw: RawMessage) -> Message:
        """The message as an object with the fields of its definition."""

    @abstractmethod
    def _read_info(self) -> SessionInfo: ...

    def _info_of(
        self, kind: str, counts: Counter[tuple[str, str]], times: Sequence[int], metadata: dict[str, str]
    ) -> SessionInfo:
        """From the numbers of messages by topic and type, and times of first and last ones."""
        topics = tuple(TopicInfo(name, of, count) for (name, of), count in sorted(counts.items()))
        return SessionInfo(self.path, kind, topics, min(times, default=None), max(times, default=None), metadata)

    def _counted(self, kind: str) -> SessionInfo:
        """By reading all messages."""
        counts, times = Counter[tuple[str, str]](), list[int]()
        for message in self.raw_messages():
            counts[message.topic, message.type_name] += 1
            times = [min([*times, message.log_time_ns]), max([*times, message.log_time_ns])]
        return self._info_of(kind, counts, times, {})

    def close(self) -> None:
        """Release the files, where they stay open between readings."""
        return


def unpacked(data: bytes) -> bytes:
    """A message, which a recorder may have compressed alone: zstd's first bytes are those of no message."""
    if data[:4] != b"\x28\xb5\x2f\xfd":
        return data
    import zstandard

    if zstandard.get_frame_parameters(data).content_size > _MAX_MESSAGE:
        return data
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=_MAX_MESSAGE)


def header_stamp_ns(message: Message) -> int:
    """Stamp of a message's header, or of Foxglove's messages, ns."""
    return stamp_of(message.header.stamp if hasattr(message, "header") else message.timestamp)


def numbers_of(message: Message, name: str) -> np.ndarray:
    """(N,) a field by the name of ROS 2, or of ROS 1, in capitals; empty where there is none."""
    return np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64)


def xyzw_of(quaternion: Message) -> np.ndarray:
    """(4,) x y z w of a ``geometry_msgs/Quaternion``."""
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)


def stamp_of(time: Message) -> int:
    """A ``builtin_interfaces/Time`` in ns; ROS 1 and JSON name its second part otherwise."""
    return int(time.sec) * 10**9 + int(time.nanosec if hasattr(time, "nanosec") else time.nsec)
