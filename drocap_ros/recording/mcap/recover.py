"""Repairs a session after a crash or power cut, for every reader of MCAP and rosbag2.

Each damaged file is copied, the copy is read back and compared message by message, and only then it replaces the file;
``metadata.yaml`` is made from the files.  Where data in the middle of a file could not be read, the damaged file is
kept, named ``*.damaged``.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap import metadata as bag
from drocap_ros.recording.mcap.file import McapFile
from drocap_ros.recording.mcap.metadata import FileRecord, TopicRecord, type_hash
from drocap_ros.recording.mcap.stream import MAGIC, Damage, DamageKind, McapChannel, McapStream, counted_channels

_BESIDE = ".recovering"

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class RecoveredFile:
    """Result for one file.

    repaired : False = it was whole and is unchanged
    messages : in it, each read back
    damage : parts that could not be read
    kept : the damaged file, where data in its middle could not be read
    """

    path: Path
    repaired: bool
    messages: int
    damage: tuple[Damage, ...]
    kept: Path | None = None


def recover_session(path: str | Path, progress: Progress | None = None) -> list[RecoveredFile]:
    """Repair a session folder or a single ``.mcap`` in place."""
    path = Path(path)
    files, custom = _files(path)
    done = []
    topics: dict[str, TopicRecord] = {}
    records: list[FileRecord] = []
    try:
        for number, file in enumerate(files):
            if progress is not None:
                progress("files", number / len(files))
            done.append(_recover_file(file, len(files) > 1))
            records.append(_describe(file, topics))
            custom = McapStream(file).metadata().get(bag.METADATA_RECORD, {}) | custom
        if path.is_dir():
            ordered = [topics[name] for name in sorted(topics)]
            bag.write_atomically(path / bag.METADATA_FILE, bag.dump_yaml(bag.bag_metadata(records, ordered, custom)))
            for left in path.glob("*.tmp"):
                left.unlink()
    except OSError as error:
        raise InputError(
            f"{path}: expected space for a repaired copy; {error.strerror or error}; the session is unchanged: make"
            " room, or copy the session to another disk"
        ) from None
    if progress is not None:
        progress("files", 1.0)
    return done


def _files(path: Path) -> tuple[list[Path], dict[str, str]]:
    if not path.exists():
        raise InputError(f"{path}: expected a session folder or .mcap, found no such file; check the path")
    if not path.is_dir():
        if not path.is_file() or path.suffix != ".mcap":
            raise InputError(f"{path}: expected a session folder or .mcap, found another kind of file; check the file")
        return [path], {}
    description, _ = bag.read_metadata(path)
    files = bag.storage_files(path, description)
    if not files or any(file.suffix != ".mcap" for file in files):
        raise InputError(f"{path}: expected a session of MCAP files, found none or others; check the path")
    return files, bag.custom_metadata(description)


def _recover_file(path: Path, one_of_several: bool) -> RecoveredFile:
    beside = path.with_name(path.name + _BESIDE)
    beside.unlink(missing_ok=True)  # of an interrupted recovery
    stream = McapStream(path, resync=True)
    size = path.stat().st_size
    if size < len(MAGIC):
        if not one_of_several and size == 0:
            raise InputError(f"{path}: expected an MCAP file, found 0 bytes; there is nothing in it to repair")
        if not MAGIC.startswith(path.read_bytes()):
            raise InputError(f"{path}: expected an MCAP file, found other content at its start; check the file")
        return _replace(stream, beside, 0, (Damage(DamageKind.NO_MESSAGE),))
    count = sum(1 for _ in stream.messages())
    damage = tuple(stream.damage)
    if not damage and _is_whole(stream, count):
        return RecoveredFile(path, False, count, ())
    return _replace(stream, beside, count, damage or (Damage(DamageKind.NO_SUMMARY),))


def _is_whole(stream: McapStream, count: int) -> bool:
    summary = stream.summary()
    return (
        summary is not None
        and summary.statistics is not None
        and summary.statistics.message_count == count
        and len(summary.chunk_indexes) == summary.statistics.chunk_count
    )


def _replace(stream: McapStream, beside: Path, count: int, damage: tuple[Damage, ...]) -> RecoveredFile:
    path = stream.path
    has_header = path.stat().st_size >= len(MAGIC)
    try:
        if has_header:
            _copy(stream, beside)
        else:
            McapFile(beside).finish(sync=True)
        copy = McapStream(beside)
        pairs = itertools.zip_longest(stream.messages() if has_header else (), copy.messages())
        if not all(old == new for old, new in pairs) or copy.damage or not _is_whole(copy, count):
            raise InputError(f"{path}: expected {count} equal messages in the repaired copy; the session is unchanged")
        kept = None
        if any(d.keeps_data for d in damage):
            kept = path.with_name(path.name + ".damaged")
            if not kept.exists():
                os.link(path, kept)
        os.replace(beside, path)
        bag.sync_folder(path.parent)
    finally:
        beside.unlink(missing_ok=True)
    return RecoveredFile(path, True, count, damage, kept)


def _copy(stream: McapStream, target: Path) -> None:
    file = McapFile(target, profile=stream.profile)
    keys: dict[McapChannel, str] = {}
    try:
        for name, values in stream.metadata().items():
            if name != "rosbag2":  # holds the counts of the damaged file
                file.add_metadata(name, values)
        for channel, log_ns, data, publish_ns, sequence in stream.messages():
            if channel not in keys:
                # Two channels of one topic (two publishers) stay separate.
                keys[channel] = channel.topic if channel.topic not in keys.values() else f"{channel.topic}#{len(keys)}"
                file.register(
                    TopicRecord(channel.topic, channel.raw_type_name, "", []),
                    channel.schema,
                    encoding=channel.message_encoding,
                    schema_encoding=channel.schema_encoding,
                    metadata=dict(channel.metadata),
                    key=keys[channel],
                )
            file.add(keys[channel], data, log_ns, publish_ns, sequence)
            if file.pending:
                file.commit()
        file.finish(sync=True)
    except OSError:
        file.abandon()
        raise


def _describe(path: Path, topics: dict[str, TopicRecord]) -> FileRecord:
    """Add the counts of a whole file to those of the session."""
    record = FileRecord(path.name)
    summary = McapStream(path).summary()
    if summary is None or summary.statistics is None:
        return record
    statistics = summary.statistics
    if statistics.message_count:
        record.start_ns, record.end_ns = statistics.message_start_time, statistics.message_end_time
        record.messages = statistics.message_count
    for channel, count in counted_channels(summary):
        kind = channel.raw_type_name
        if channel.topic not in topics:
            qos = _qos(dict(channel.metadata))
            topics[channel.topic] = TopicRecord(channel.topic, kind, type_hash(kind, channel.schema), qos)
        topics[channel.topic].count += count
    return record


def _qos(metadata: dict[str, str]) -> list[bag.Yaml]:
    import yaml

    try:
        profiles = yaml.safe_load(metadata.get("offered_qos_profiles", ""))
    except yaml.YAMLError:
        profiles = None
    return profiles if isinstance(profiles, list) and profiles else bag.qos_profile()
