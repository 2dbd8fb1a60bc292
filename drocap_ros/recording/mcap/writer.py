"""Writes a session: a rosbag2 folder of MCAP files that survives crashes, power cuts and full disks."""

from __future__ import annotations

import contextlib
import logging
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.mcap import metadata as bag
from drocap_ros.recording.mcap.file import McapFile
from drocap_ros.recording.mcap.metadata import METADATA_FILE, METADATA_RECORD, FileRecord, TopicRecord, Yaml, type_hash
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig

#: MCAP's times are unsigned nanoseconds of 64 bits.
_END_NS = 1 << 64


class QueuedMessage(NamedTuple):
    """One serialized message."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class BoundedQueue:
    """Messages in order of arrival, at most ``limit_bytes`` of them.

    An image that does not fit is dropped; any other message that does not fit replaces the oldest images, and is
    dropped only when none are left.  Images use at most seven eighths of the space.

    size : queued bytes
    closed : whether further messages are refused
    dropped : messages by topic
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._images: deque[tuple[int, QueuedMessage]] = deque()
        self._others: deque[tuple[int, QueuedMessage]] = deque()
        self.size = 0
        self._arrivals = 0
        self.closed = False
        self._changed = threading.Condition()
        self.dropped: Counter[str] = Counter()

    def put(self, message: QueuedMessage, image: bool) -> bool:
        """Add without waiting; False when it was dropped."""
        size = len(message.data)
        with self._changed:
            limit = self._limit - self._limit // 8 if image else self._limit
            if not image:
                while self.size + size > limit and self._images:
                    _, victim = self._images.popleft()
                    self.size -= len(victim.data)
                    self.dropped[victim.topic] += 1
            stamped = 0 <= message.log_time_ns < _END_NS and 0 <= message.publish_time_ns < _END_NS
            if self.closed or not stamped or self.size + size > limit:
                self.dropped[message.topic] += 1
                return False
            (self._images if image else self._others).append((self._arrivals, message))
            self._arrivals += 1
            self.size += size
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> QueuedMessage | None:
        """Oldest message, None when none comes within the time-out."""
        with self._changed:
            if not self._images and not self._others and not self.closed:
                self._changed.wait(timeout_s)
            if not self._images and not self._others:
                return None
            first_is_image = bool(self._images) and (not self._others or self._images[0][0] < self._others[0][0])
            _, message = (self._images if first_is_image else self._others).popleft()
            self.size -= len(message.data)
            return message

    def close(self) -> None:
        """Refuse further messages; queued ones can still be taken."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def drop_all(self) -> None:
        """Drop and count all queued messages."""
        with self._changed:
            for _, message in (*self._images, *self._others):
                self.dropped[message.topic] += 1
            self._images.clear()
            self._others.clear()
            self.size = 0

    def drop_count(self) -> int:
        """Drops so far."""
        with self._changed:
            return sum(self.dropped.values())


#: Bytes.
_MIB = 1 << 20

logger = logging.getLogger(__name__)


class SessionWriter:
    """Accepts serialized messages from any thread and writes them in its own thread.

    Chunks are compressed and written at least every ``config.chunk_s``: a crash or power cut leaves whole chunks up to
    then.  A new, independent file starts after ``config.split_mib`` or ``config.split_s``.  ``write`` never waits:
    messages above the disk's rate are dropped, images first, and counted.  ``metadata.yaml`` exists from the start;
    :meth:`close` completes it.  With less than ``config.free_mib`` left on the disk the session is finished early.

    error : reason of an early end of the recording, one line; None without one

    folder : to create; it must not exist, or be empty
    config : chunks, files, queue, free space
    metadata : configuration, versions, model hashes and the like
    """

    def __init__(
        self,
        folder: str | Path,
        config: SessionRecorderConfig | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.config = config or SessionRecorderConfig()
        self._make_folder()
        self._custom = dict(metadata or {})
        self._new_metadata: dict[str, str] = {}
        self._topics: dict[str, TopicRecord] = {}  # counts: of the finished files
        self._schemas: dict[str, str] = {}
        self._images: set[str] = set()
        self._finished: list[FileRecord] = []
        self._unsaved_s: float | None = None  # arrival of the oldest message that is not on the disk
        self._space_checked_s = -1e9
        self._description_changed = False
        self._lock = threading.Lock()  # guards the current file and the description
        self.error: str | None = None
        self._closed = False
        self._queue = BoundedQueue(self.config.queue_mib * _MIB)
        try:
            self._file = self._new_file()
            self._write_description()
        except OSError as error:
            raise self._cannot(error) from None
        self._thread = threading.Thread(target=self._run, name="session-writer", daemon=True)
        self._thread.start()

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def path(self) -> Path:
        """The current file."""
        return self._file.path

    @property
    def dropped(self) -> int:
        """Messages that did not reach a file."""
        return self._queue.drop_count()

    @property
    def dropped_by_topic(self) -> dict[str, int]:
        """Messages that did not reach a file, by topic."""
        return dict(self._queue.dropped)

    @property
    def written(self) -> int:
        """Messages written to the files."""
        return sum(record.messages for record in self._finished) + self._file.record.messages

    @property
    def queued_bytes(self) -> int:
        """Bytes in the queue to the disk."""
        return self._queue.size

    def register(self, topic: str, type_name: str, schema: str, *, image: bool = False) -> None:
        """Declare a topic before its first message; a repeated call has no effect.

        type_name : ``package/msg/Name``
        schema : its definition with all dependencies, see :func:`drocap_ros.recording.mcap.metadata.schema_text`
        image : whether its messages may be dropped before others
        """
        with self._lock:
            known = self._topics.get(topic)
            if known is not None:
                if known.type_name != type_name:
                    raise InputError(f"{topic}: expected type {known.type_name} as registered before, got {type_name}")
                return
            profile = bag.qos_profile(reliable=not image)
            record = TopicRecord(topic, type_name, type_hash(type_name, schema), profile)
            if self.error is None:
                self._file.register(record, schema)
            self._schemas[topic] = schema
            self._topics[topic] = record
            if image:
                self._images.add(topic)
            self._description_changed = True

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> bool:
        """Queue one serialized (CDR) message; False when it was dropped, as one of a time before 1970 is."""
        if topic not in self._topics:
            raise InputError(f"{topic}: expected a registered topic; call register first")
        published_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        return self._queue.put(QueuedMessage(topic, bytes(data), log_time_ns, published_ns), topic in self._images)

    def add_metadata(self, values: Mapping[str, str]) -> None:
        """Add metadata; it reaches the disk with the next chunk."""
        with self._lock:
            self._new_metadata.update({k: v for k, v in values.items() if self._custom.get(k) != v})
            if self._new_metadata and self._unsaved_s is None:
                self._unsaved_s = time.monotonic()

    def close(self) -> None:
        """Write the queue, finish the file and ``metadata.yaml``.  A repeated call has no effect."""
        if self._closed:
            return
        self._closed = True
        self._queue.close()
        self._thread.join()
        with self._lock:
            if self.error is None:
                try:
                    self._finish_file()
                    self._write_description(current=False)
                except OSError as error:
                    self._fail(error)

    def discard(self) -> None:
        """Close and delete the files, and the folder if it is then empty."""
        self.close()
        with contextlib.suppress(OSError):
            for name in (METADATA_FILE, *(record.name for record in self._finished)):
                (self.folder / name).unlink(missing_ok=True)
            self.folder.rmdir()

    def _run(self) -> None:
        while True:
            closed = self._queue.closed  # before the look: what comes during a slow save is taken in the next turn
            message = self._queue.take(self._wait_s())
            try:
                with self._lock:
                    if message is not None:
                        self._add(message)
                    self._save_if_due(ended=message is None and closed)
            except Exception as error:  # noqa: BLE001  # the graph continues; diagnostics report the reason
                self._fail(error)
            if self.error is not None:
                self._queue.drop_all()
            if message is None and closed:
                return

    def _wait_s(self) -> float:
        """Longest sleep of the thread until the next chunk is due."""
        if self._unsaved_s is None:
            return self.config.chunk_s
        return max(0.0, self._unsaved_s + self.config.chunk_s - time.monotonic())

    def _add(self, message: QueuedMessage) -> None:
        if self.error is not None:
            self._queue.dropped[message.topic] += 1
            return
        if self._file_is_full(message.log_time_ns):
            self._finish_file()
            self._file = self._new_file()
            self._write_description()
        number = self._topics[message.topic].count + self._file.topics[message.topic].count
        self._file.add(message.topic, message.data, message.log_time_ns, message.publish_time_ns, number)
        if self._unsaved_s is None:
            self._unsaved_s = time.monotonic()

    def _save_if_due(self, ended: bool) -> None:
        if self.error is not None:
            return
        now = time.monotonic()
        due = self._unsaved_s is not None and now - self._unsaved_s >= self.config.chunk_s
        if due or ended:
            if self._new_metadata:
                self._file.add_metadata(METADATA_RECORD, self._new_metadata)
                self._custom.update(self._new_metadata)
                self._new_metadata = {}
                self._description_changed = True
            self._file.save(self.config.sync)
            self._unsaved_s = None
            if self._description_changed:
                self._description_changed = False
                self._write_description()
            if self._space_is_low(now):
                self._end_early()
        elif self._file.pending:
            self._file.commit()

    def _new_file(self) -> McapFile:
        path = self.folder / f"{self.folder.absolute().name}_{len(self._finished)}.mcap"
        file = McapFile(path, self.config.compression, self.config.chunk_kib * 1024)
        for name, topic in self._topics.items():
            file.register(topic, self._schemas[name])
        if self._custom:
            file.add_metadata(METADATA_RECORD, self._custom)
        file.commit(self.config.sync)
        bag.sync_folder(self.folder)
        return file

    def _file_is_full(self, log_time_ns: int) -> bool:
        record, config = self._file.record, self.config
        if not record.messages or record.start_ns is None:
            return False
        old = config.split_s > 0 and (log_time_ns - record.start_ns) * 1e-9 >= config.split_s
        return old or (config.split_mib > 0 and self._file.size >= config.split_mib * _MIB)

    def _finish_file(self) -> None:
        text = bag.dump_yaml(self._description(current=True))
        self._file.add_metadata("rosbag2", {"serialized_metadata": text})
        self._file.finish(self.config.sync)
        self._keep_counts()

    def _keep_counts(self) -> None:
        for name, topic in self._file.topics.items():
            self._topics[name].count += topic.count
            topic.count = 0
        self._finished.append(self._file.record)
        self._file.record = FileRecord("")

    def _space_is_low(self, now: float) -> bool:
        if now - self._space_checked_s < 1.0:
            return False
        self._space_checked_s = now
        return shutil.disk_usage(self.folder).free < self.config.free_mib * _MIB

    def _end_early(self) -> None:
        """Finish the session while the disk has space for it."""
        self._finish_file()
        self._write_description(current=False)
        self._set_error(f"less than {self.config.free_mib} MiB left on the disk; the session is complete until then")

    def _fail(self, error: Exception) -> None:
        if self.error is not None:
            return
        reason = getattr(error, "strerror", None) or first_line(error)
        for topic, count in self._file.abandon().items():
            self._queue.dropped[topic] += count
        if self._file.record.name:
            self._keep_counts()
        self._set_error(f"{reason}; earlier messages stay readable, `drocap recover` completes the session")
        try:
            self._write_description(current=False)
        except OSError:  # readers use the files themselves
            logger.debug("metadata.yaml of %s is not up to date", self.folder)

    def _set_error(self, reason: str) -> None:
        self.error = f"{self.folder}: the recording ended early: {reason}; make room and start a new session"
        logger.error("%s", self.error)

    def _description(self, current: bool) -> Yaml:
        topics = []
        for name in sorted(self._topics):
            topic = self._topics[name]
            count = topic.count + (self._file.topics[name].count if current else 0)
            topics.append(TopicRecord(name, topic.type_name, topic.type_hash, topic.qos, count))
        files = [*self._finished, self._file.record] if current else self._finished
        return bag.bag_metadata(files, topics, self._custom)

    def _write_description(self, current: bool = True) -> None:
        bag.write_atomically(self.folder / METADATA_FILE, bag.dump_yaml(self._description(current)))

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
