"""Writes a session: a rosbag2 folder with one MCAP file that survives whatever happens to the machine."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drocap_ros.errors import InputError
from drocap_ros.recording.bag_metadata import (
    METADATA_FILE,
    TopicRecord,
    bag_metadata,
    dump_yaml,
    qos_profile,
    write_atomically,
)
from drocap_ros.recording.bounded_queue import BoundedQueue, QueuedMessage
from drocap_ros.recording.committed_file import CommittedFile
from drocap_ros.recording.config import SessionRecorderConfig
from drocap_ros.recording.schemas import type_hash

_MIB = 1 << 20

logger = logging.getLogger(__name__)


class SessionWriter:
    """Takes serialized messages from any thread and writes them in a thread of its own.

    Chunks are compressed and handed to the disk at least every ``config.chunk_s``; a crash or power cut leaves
    whole chunks up to then.  ``write`` never waits and never raises: what the disk cannot take is dropped, pictures
    first, and counted.  ``metadata.yaml`` stands from the start and is completed by :meth:`close`.

    Parameters
    ----------
    folder : to create; it must not exist, or be empty
    config : chunks, queue, free space
    metadata : what to know of the session later: configuration, versions, model hashes

    Raises
    ------
    InputError
        When the folder holds something, cannot be created, or the disk is full already.
    """

    def __init__(
        self,
        folder: str | Path,
        config: SessionRecorderConfig | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        from mcap.writer import CompressionType, Writer

        self.folder = Path(folder)
        self.config = config or SessionRecorderConfig()
        self._make_folder()
        self.path = self.folder / f"{self.folder.absolute().name}_0.mcap"
        self._custom = dict(metadata or {})
        self._topics: dict[str, TopicRecord] = {}
        self._channels: dict[str, int] = {}
        self._pictures: set[str] = set()
        self._schemas: dict[tuple[str, str], int] = {}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._unsaved_s: float | None = None  # when the oldest message that is not yet on the disk came
        self._space_checked_s = -1e9
        self._topics_changed = False
        self._lock = threading.Lock()  # of the MCAP writer and of what describes the file
        self._error: str | None = None
        self._closed = False
        self._queue = BoundedQueue(self.config.queue_mib * _MIB)
        try:
            self._file = CommittedFile(self.path)
        except OSError as error:
            raise self._cannot(error) from None
        compression = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
        self._mcap = Writer(
            self._file,  # type: ignore[arg-type]
            chunk_size=self.config.chunk_kib * 1024,
            compression=compression[self.config.compression],
        )
        try:
            self._mcap.start("ros2", _library())
            if self._custom:
                self._mcap.add_metadata("drocap_ros", self._custom)
            self._file.commit(self.config.sync)
            self._write_metadata()
            _sync_folder(self.folder)
        except OSError as error:
            self._file.close()
            raise self._cannot(error) from None
        self._thread = threading.Thread(target=self._run, name="session-writer", daemon=True)
        self._thread.start()

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def dropped(self) -> int:
        """Messages that did not reach the file."""
        return self._queue.drop_count()

    @property
    def dropped_by_topic(self) -> dict[str, int]:
        """The same by topic."""
        return dict(self._queue.dropped)

    @property
    def written(self) -> int:
        """Messages handed to the file."""
        return sum(topic.count for topic in self._topics.values())

    @property
    def error(self) -> str | None:
        """Why the recording ended before its time, in one line; None when it did not."""
        return self._error

    def register(
        self,
        topic: str,
        type_name: str,
        schema: str,
        *,
        image: bool = False,
        qos: list[dict[str, Any]] | None = None,
    ) -> None:
        """Declare a topic before its first message; a second time changes nothing.

        Parameters
        ----------
        type_name : ``package/msg/Name``
        schema : its definition with all dependencies, see :func:`drocap_ros.recording.schemas.schema_text`
        image : whether its messages may be dropped before others
        qos : offered quality of service, see :func:`drocap_ros.recording.bag_metadata.qos_profile`

        Raises
        ------
        InputError
            When the topic stands already with another type.
        """
        with self._lock:
            known = self._topics.get(topic)
            if known is not None:
                if known.type_name != type_name:
                    raise InputError(f"{topic}: expected type {known.type_name} as registered before, got {type_name}")
                return
            profile = qos or qos_profile(reliable=not image)
            self._topics[topic] = TopicRecord(topic, type_name, type_hash(type_name, schema), profile)
            key = (type_name, schema)
            if key not in self._schemas:
                self._schemas[key] = self._mcap.register_schema(type_name, "ros2msg", schema.encode())
            self._channels[topic] = self._mcap.register_channel(
                topic=topic,
                message_encoding="cdr",
                schema_id=self._schemas[key],
                metadata={"offered_qos_profiles": dump_yaml(profile)},
            )
            if image:
                self._pictures.add(topic)
            self._topics_changed = True

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> bool:
        """Queue one serialized (CDR) message; False when it was dropped.

        Raises
        ------
        InputError
            When the topic was not registered.
        """
        if topic not in self._channels:
            raise InputError(f"{topic}: expected a registered topic; call register first")
        published_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        return self._queue.put(QueuedMessage(topic, bytes(data), log_time_ns, published_ns), topic in self._pictures)

    def close(self) -> None:
        """Write what is queued, finish the file and ``metadata.yaml``.  A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._queue.close()
        self._thread.join()
        with self._lock:
            try:
                if self._error is None:
                    text = dump_yaml(self._metadata())
                    self._mcap.add_metadata("rosbag2", {"serialized_metadata": text})
                    self._mcap.finish()
                    self._file.commit(self.config.sync)
                self._write_metadata()
            except OSError as error:
                self._fail(error)
            finally:
                self._file.close()

    def _run(self) -> None:
        while True:
            message = self._queue.take(self._patience_s())
            try:
                with self._lock:
                    if message is not None:
                        self._add(message)
                    self._save_if_due(ended=message is None and self._queue.closed)
            except Exception as error:  # whatever it is, the graph lives on and the reason is told
                self._fail(error)
            if self._error is not None:
                self._queue.drop_all()
            if message is None and self._queue.closed:
                return

    def _patience_s(self) -> float:
        """How long the thread may sleep before something must go to the disk."""
        if self._unsaved_s is None:
            return self.config.chunk_s
        return max(0.0, self._unsaved_s + self.config.chunk_s - time.monotonic())

    def _add(self, message: QueuedMessage) -> None:
        topic = self._topics[message.topic]
        if self._error is not None:
            self._queue.dropped[message.topic] += 1
            return
        self._mcap.add_message(
            self._channels[message.topic],
            log_time=message.log_time_ns,
            data=message.data,
            publish_time=message.publish_time_ns,
            sequence=topic.count & 0xFFFFFFFF,
        )
        topic.count += 1
        self._start_ns = message.log_time_ns if self._start_ns is None else min(self._start_ns, message.log_time_ns)
        self._end_ns = max(self._end_ns, message.log_time_ns)
        if self._unsaved_s is None:
            self._unsaved_s = time.monotonic()

    def _save_if_due(self, ended: bool) -> None:
        if self._error is not None:
            return
        now = time.monotonic()
        due = self._unsaved_s is not None and now - self._unsaved_s >= self.config.chunk_s
        if due or ended:
            self._check_space(now)
            self._mcap.flush()
            self._file.commit(self.config.sync)
            self._unsaved_s = None
            if self._topics_changed:
                self._topics_changed = False
                self._write_metadata()
        elif self._file.pending:
            self._file.commit()

    def _check_space(self, now: float) -> None:
        if now - self._space_checked_s < 1.0:
            return
        self._space_checked_s = now
        if shutil.disk_usage(self.folder).free < self.config.free_mib * _MIB:
            raise OSError(errno.ENOSPC, f"less than {self.config.free_mib} MiB left on the disk")

    def _fail(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0] if str(error) else type(error).__name__
        self._error = (
            f"{self.folder}: the recording ended early: {reason}; what was written before stays "
            "readable; make room and start a new session"
        )
        logger.error("%s", self._error)

    def _metadata(self) -> dict[str, Any]:
        topics = [self._topics[name] for name in sorted(self._topics)]
        return bag_metadata(self.path.name, topics, self._start_ns, self._end_ns, self._custom)

    def _write_metadata(self) -> None:
        write_atomically(self.folder / METADATA_FILE, dump_yaml(self._metadata()))

    def _make_folder(self) -> None:
        folder = self.folder
        try:
            if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
                raise InputError(
                    f"{folder}: expected a new or empty folder for the session, found something in it; "
                    "choose another name"
                )
            folder.mkdir(parents=True, exist_ok=True)
            free_mib = shutil.disk_usage(folder).free // _MIB
        except OSError as error:
            raise self._cannot(error) from None
        if free_mib < self.config.free_mib:
            raise InputError(
                f"{folder}: expected at least {self.config.free_mib} MiB free on the disk, found {free_mib}; "
                "make room or lower session_recorder.free_mib"
            )

    def _cannot(self, error: OSError) -> InputError:
        return InputError(f"{self.folder}: expected a folder to write to; {error.strerror or error}; choose another")


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _library() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"drocap_ros {version('drocap_ros')}; mcap {version('mcap')}"
    except PackageNotFoundError:
        return f"drocap_ros; mcap {version('mcap')}"
