"""A recording opened for reading: ours, rosbag2's (MCAP or sqlite3), a lone ``.mcap``, or a rosbag1 ``.bag``."""

from __future__ import annotations

import dataclasses
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import METADATA_FILE
from drocap_ros.recording.mcap.stream import McapChannel, McapStream

POSE2D = "drocap_ros/msg/Pose2D"
POSE3D = "drocap_ros/msg/Pose3D"
POSE3D_WINDOW = "drocap_ros/msg/Pose3DWindow"
VEHICLE_STATE = "drocap_ros/msg/VehicleState"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

_SUFFIXES = (".mcap", ".bag", ".db3")
FORMS = "a session folder, .mcap, .bag, .db3 or rosbag2 folder"


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a recording."""

    name: str
    type_name: str
    count: int


@dataclass(frozen=True)
class SessionInfo:
    """What a recording holds.

    start_ns, end_ns : log times of the first and last message, None without any
    metadata : what the recorder noted of the session
    warnings : what could not be read, in words
    """

    path: Path
    kind: str
    topics: tuple[TopicInfo, ...]
    start_ns: int | None
    end_ns: int | None
    metadata: dict[str, str]
    warnings: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return 0.0 if self.start_ns is None or self.end_ns is None else (self.end_ns - self.start_ns) * 1e-9

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(topic.count for topic in self.topics)


class RawMessage(NamedTuple):
    """One message as it was recorded; decode it with :meth:`Session.decode`."""

    topic: str
    type_name: str
    log_time_ns: int
    data: bytes
    source: Any


class Session(ABC):
    """A recording; use as a context manager.  Messages are streamed, never loaded whole.

    warnings : what could not be read so far, in words
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

    @property
    def has_pose2d(self) -> bool:
        """Whether it holds keypoints."""
        return bool(self.topics_of(POSE2D))

    @property
    def has_images(self) -> bool:
        """Whether it holds pictures."""
        return bool(self.topics_of(IMAGE, COMPRESSED_IMAGE))

    def topics_of(self, *type_names: str) -> list[TopicInfo]:
        """Topics of some types that have messages, those with most messages first."""
        found = [topic for topic in self.info.topics if topic.type_name in type_names and topic.count]
        return sorted(found, key=lambda topic: (-topic.count, topic.name))

    def choose_topic(self, wanted: str | None, *type_names: str) -> TopicInfo:
        """The topic of some types: the one named (its end suffices), else the one with most messages.

        Raises
        ------
        InputError
            When there is none.
        """
        found = self.topics_of(*type_names)
        kinds = " or ".join(type_names)
        if not found:
            there = ", ".join(f"{t.name} ({t.type_name})" for t in self.info.topics) or "no topics"
            raise InputError(f"{self.path}: expected a topic of type {kinds}, found {there}; record one")
        if wanted is None:
            if len(found) > 1:
                self.warn(f"several topics of type {kinds}: {', '.join(t.name for t in found)}; took {found[0].name}")
            return found[0]
        named = [t for t in found if t.name == wanted or t.name.endswith("/" + wanted.lstrip("/"))]
        if not named:
            raise InputError(
                f"{self.path}: expected topic {wanted!r} of type {kinds}, found {', '.join(t.name for t in found)}; "
                "name one of these"
            )
        return named[0]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[RawMessage, Any]]:
        """Messages of some topics, decoded; what cannot be decoded is left out with a warning."""
        failed = 0
        for raw in self.raw_messages(topics):
            try:
                message = self.decode(raw)
            except Exception:  # a damaged message fails in many ways
                failed += 1
                continue
            yield raw, message
        if failed:
            self.warn(f"{failed} messages could not be decoded and were left out")

    def warn(self, text: str) -> None:
        """Note something that a user should know, once."""
        if text not in self.warnings:
            self.warnings.append(text)

    @abstractmethod
    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (none named: all) in the order of the recording."""

    @abstractmethod
    def decode(self, raw: RawMessage) -> Any:
        """The message as an object with the fields of its definition."""

    @abstractmethod
    def _read_info(self) -> SessionInfo: ...

    def close(self) -> None:
        """Release the files; there are none to release where each reading opens its own."""
        return


def is_recording(path: str | Path) -> bool:
    """Whether a path looks like something that :func:`open_session` reads."""
    path = Path(path)
    if path.is_dir():
        return (path / METADATA_FILE).is_file() or any(p.suffix in (".mcap", ".db3") for p in path.iterdir())
    return path.suffix in _SUFFIXES


def open_session(path: str | Path) -> Session:
    """Open a recording.

    Raises
    ------
    InputError
        When it is missing, of another kind, or nothing of it can be read.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: expected {FORMS}, found no such file; check the path")
    if not is_recording(path):
        raise InputError(f"{path}: expected {FORMS}, found something else; check the path")
    try:
        if path.suffix == ".mcap" and path.is_file():
            return McapSession(path, [path], {})
        if path.is_dir():
            description, warnings = read_bag_metadata(path)
            storage = description.get("storage_identifier", "")
            packed = str(description.get("compression_mode", "")).lower() not in ("", "none")
            files = storage_files(path, description)
            if files and storage in ("mcap", "") and not packed and all(f.suffix == ".mcap" for f in files):
                session: Session = McapSession(path, files, description.get("custom_data") or {})
            else:
                session = RosbagsSession(path)
            session.warnings += warnings
            return session
        return RosbagsSession(path)
    except OSError as error:
        raise InputError(f"{path}: expected a readable recording; {error.strerror or error}") from None


def read_bag_metadata(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """The description in a rosbag2 folder's ``metadata.yaml``, empty where there is no usable one, and warnings."""
    import yaml

    path = folder / METADATA_FILE
    if not path.exists():
        return {}, [f"{METADATA_FILE} is missing; read the files that are there"]
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        description = content["rosbag2_bagfile_information"]
        if not isinstance(description, dict):
            raise TypeError("no table")
        return description, []
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError, RecursionError):
        return {}, [f"{METADATA_FILE} cannot be read; read the files that are there"]


def storage_files(folder: Path, description: dict[str, Any]) -> list[Path]:
    """Files of a folder in their order; one that a crash left out of the list is taken in."""
    there = sorted((p for p in folder.iterdir() if p.suffix == ".mcap"), key=_by_number)
    named = description.get("relative_file_paths")
    if isinstance(named, list) and named:
        files = [folder / Path(str(name)).name for name in named]
        if all(file.is_file() for file in files):
            beside = [p for p in there if p not in files] if all(f.suffix == ".mcap" for f in files) else []
            return files + beside
    return there


def _by_number(path: Path) -> tuple[Any, ...]:
    """``s_10`` comes after ``s_9``."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name))


class McapSession(Session):
    """One or several MCAP files."""

    def __init__(self, path: Path, files: list[Path], custom: dict[str, str]) -> None:
        super().__init__(path)
        # A power cut right after a file was made leaves it empty: it says nothing of the others.
        empty = [file for file in files if file.stat().st_size == 0] if len(files) > 1 else []
        files = [file for file in files if file not in empty]
        self.warnings += [f"{file.name} is empty; `drocap recover` puts that right" for file in empty]
        self._streams = [McapStream(file) for file in files]
        self._custom = {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
        self._stores: dict[McapChannel, Any] = {}
        for file in files:
            with file.open("rb") as opened:
                if opened.read(8) != b"\x89MCAP0\r\n":
                    raise InputError(f"{file}: expected an MCAP file, found other content at its start; check the path")

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (none named: all) in the order of the files."""
        for stream in self._streams:
            stream.damage.clear()
            count = 0
            for message in stream.messages():
                count += 1
                if not topics or message.channel.topic in topics:
                    yield RawMessage(
                        message.channel.topic,
                        message.channel.type_name,
                        message.log_time_ns,
                        message.data,
                        message.channel,
                    )
            if stream.damage:
                self.warn(f"{stream.path.name}: {'; '.join(stream.damage)}; read the {count} messages that are whole")

    def decode(self, raw: RawMessage) -> Any:
        """The message as an object with the fields of its definition."""
        channel: McapChannel = raw.source
        store = self._stores.get(channel)
        if store is None:
            store = self._stores[channel] = _typestore(channel)
        if channel.message_encoding == "ros1":
            return store.deserialize_ros1(raw.data, channel.type_name)
        return store.deserialize_cdr(raw.data, channel.type_name)

    def _read_info(self) -> SessionInfo:
        counts: dict[tuple[str, str], int] = {}
        times: list[int] = []
        metadata = dict(self._custom)
        for stream in self._streams:
            for key, value in stream.metadata().get("drocap_ros", {}).items():
                metadata.setdefault(key, value)
            if not self._info_of_summary(stream, counts, times):
                self._info_of_messages(stream, counts, times)
        topics = tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items()))
        return SessionInfo(
            path=self.path,
            kind="rosbag2 folder, MCAP" if self.path.is_dir() else "MCAP",
            topics=topics,
            start_ns=min(times, default=None),
            end_ns=max(times, default=None),
            metadata=metadata,
            warnings=(),
        )

    @staticmethod
    def _info_of_summary(stream: McapStream, counts: dict[tuple[str, str], int], times: list[int]) -> bool:
        summary = stream.summary()
        if summary is None or summary.statistics is None:
            return False
        statistics = summary.statistics
        if len(summary.channels) != statistics.channel_count:
            return False
        for number, record in summary.channels.items():
            schema = summary.schemas.get(record.schema_id)
            kind = schema.name if schema is not None else ""
            kind = kind if kind.count("/") != 1 else kind.replace("/", "/msg/")
            key = (record.topic, kind)
            counts[key] = counts.get(key, 0) + statistics.channel_message_counts.get(number, 0)
        if statistics.message_count:
            times += [statistics.message_start_time, statistics.message_end_time]
        return True

    def _info_of_messages(self, stream: McapStream, counts: dict[tuple[str, str], int], times: list[int]) -> None:
        stream.damage.clear()
        total, first, last = 0, None, None
        for message in stream.messages():
            key = (message.channel.topic, message.channel.type_name)
            counts[key] = counts.get(key, 0) + 1
            total += 1
            first = message.log_time_ns if first is None else min(first, message.log_time_ns)
            last = message.log_time_ns if last is None else max(last, message.log_time_ns)
        times += [time for time in (first, last) if time is not None]
        if stream.damage:
            self.warn(f"{stream.path.name}: {'; '.join(stream.damage)}; read the {total} messages that are whole")
        else:
            self.warn(f"{stream.path.name}: no usable summary at its end; counted its {total} messages")


class RosbagsSession(Session):
    """Anything that the package ``rosbags`` reads: rosbag1, rosbag2 with sqlite3 or compressed files."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        from rosbags.highlevel import AnyReader

        from drocap_ros.recording.mcap.schemas import standard_types

        try:
            self._reader = AnyReader([path], default_typestore=standard_types())
            self._reader.open()
        except InputError:
            raise
        except Exception as error:  # rosbags passes on what its storages raise
            raise InputError(f"{path}: expected {FORMS} that can be read; {_first_line(error)}") from None

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (none named: all) in the order of their log times."""
        connections = [c for c in self._reader.connections if not topics or c.topic in topics]
        if not connections:
            return
        messages = self._reader.messages(connections)
        while True:
            try:
                connection, log_time_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # a damaged file: what came before is whole
                self.warn(f"cut off or damaged: {_first_line(error)}; read the messages before it")
                return
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, bytes(data), connection)

    def decode(self, raw: RawMessage) -> Any:
        """The message as an object with the fields of its definition."""
        return self._reader.deserialize(raw.data, raw.type_name)

    def _read_info(self) -> SessionInfo:
        counts: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        there = sum(counts.values()) > 0
        return SessionInfo(
            path=self.path,
            kind="rosbag2 folder" if self.path.is_dir() else f"rosbag ({self.path.suffix})",
            topics=tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items())),
            start_ns=self._reader.start_time if there else None,
            end_ns=self._reader.end_time - 1 if there else None,
            metadata={},
            warnings=(),
        )

    def close(self) -> None:
        """Release the files."""
        if self._reader.stack is not None:
            self._reader.close()


def _typestore(channel: McapChannel) -> Any:
    """Types of one channel, from its embedded schema; from the standard ones where it has none."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    from drocap_ros.recording.mcap.schemas import standard_types

    if not channel.schema:
        return standard_types()
    store = get_typestore(Stores.EMPTY)
    if channel.schema_encoding == "ros2idl":
        types: dict[str, Any] = {}
        line = "=" * 80 + "\n"
        for part in channel.schema.split(line):
            text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            if text.strip():
                types.update(get_types_from_idl(text))
        store.register(types)
    else:
        store.register(get_types_from_msg(channel.schema, channel.type_name))
    return store


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__
