"""Pictures handed over as arrays between nodes of one process, and as JPEG to everybody else.

``rclpy`` has no transport inside a process: each picture would be encoded, copied through DDS and decoded again.
A channel belongs to a ROS context and a topic, so that graphs side by side in one process do not mix.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from rclpy.context import Context
from std_msgs.msg import Header

from drocap_ros.nodes.component import ComponentNode
from drocap_ros.nodes.conversions import compressed_image_to_ros
from drocap_ros.perception.images import encode_jpeg

#: Pictures that wait to be encoded for others: a third of a second, then the oldest is dropped.
_WAITING = 10
#: A picture that is taken up so soon after the one before had been waiting.
_AT_ONCE_S = 0.003


class Picture(NamedTuple):
    """A picture (H, W, 3) uint8 BGR, which nobody writes to, and its header."""

    header: Header
    image: np.ndarray


class PictureReader:
    """What one node has not yet taken: at most ``depth`` pictures, the newest; the others are counted."""

    def __init__(self, wake: Callable[[], None], depth: int) -> None:
        self._wake = wake
        self._depth = depth
        self._pictures: list[Picture] = []
        self._missed = 0
        self._lock = threading.Lock()

    def put(self, picture: Picture) -> None:
        """Hand over; called by the writer's thread."""
        with self._lock:
            self._pictures.append(picture)
            while len(self._pictures) > self._depth:
                self._pictures.pop(0)
                self._missed += 1
        self._wake()

    def take(self) -> tuple[Picture | None, int]:
        """Oldest picture that waits, or None, and how many were missed since the last call."""
        with self._lock:
            missed, self._missed = self._missed, 0
            picture = self._pictures.pop(0) if self._pictures else None
            if self._pictures:
                self._wake()
            return picture, missed


class PictureChannel:
    """Writers and readers of one topic in one context."""

    def __init__(self) -> None:
        self.writers = 0
        self.readers: tuple[PictureReader, ...] = ()


_channels: WeakKeyDictionary[Context, dict[str, PictureChannel]] = WeakKeyDictionary()
_channels_lock = threading.Lock()


def channel_of(context: Context, topic: str) -> PictureChannel:
    """Channel of a topic (its full name) in a context."""
    with _channels_lock:
        return _channels.setdefault(context, {}).setdefault(topic, PictureChannel())


class PictureOutput:
    """The pictures of a camera: arrays to readers in this process, ``image/compressed`` to all others.

    Where somebody in this process waits for the pictures, the encoding for others is done in a thread of its own,
    off the way of the keypoints.

    Parameters
    ----------
    node : the camera's node
    quality : of the JPEG, 1 to 100
    """

    def __init__(self, node: ComponentNode, quality: int) -> None:
        self._node = node
        self._quality = quality
        self._publisher = node.output("image/compressed")
        self._channel = channel_of(node.context, self._publisher.topic_name)
        self._channel.writers += 1
        node.handed_over["image/compressed"] = lambda: len(self._channel.readers)
        self._waiting: queue.Queue[tuple[Picture, bytes | None] | None] = queue.Queue(_WAITING)
        self._thread: threading.Thread | None = None
        self._closed = False

    def publish(self, header: Header, image: np.ndarray, jpeg: bytes | None = None) -> None:
        """Publish a picture (H, W, 3) uint8 BGR; ``jpeg`` where it came as such.  The array is not to be changed."""
        picture = Picture(header, image)
        readers = self._channel.readers
        for reader in readers:
            reader.put(picture)
        if self._publisher.get_subscription_count() == 0:
            return
        if not readers:
            self._encode(picture, jpeg)
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="jpeg", daemon=True)
            self._thread.start()
        self._node.details["images that wait to be encoded"] = str(self._waiting.qsize())
        try:
            self._waiting.put_nowait((picture, jpeg))
        except queue.Full:
            self._node.count("images dropped for the recorder: too many wait to be encoded")

    def drain(self) -> None:
        """Wait until every picture is encoded and sent."""
        if self._thread is not None:
            self._waiting.join()

    def close(self) -> None:
        """Encode what waits and end; nothing may be published any more."""
        if self._closed:
            return
        self._closed = True
        self._channel.writers -= 1
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(timeout=5.0)

    def _encode(self, picture: Picture, jpeg: bytes | None) -> None:
        data = jpeg or encode_jpeg(picture.image, self._quality)
        self._publisher.publish(compressed_image_to_ros(picture.header, data))

    def _run(self) -> None:
        while True:
            item = self._waiting.get()
            try:
                if item is None:
                    return
                self._encode(*item)
            finally:
                self._waiting.task_done()


class PictureInput:
    """The same, read: from this process where its camera runs here, else from ``image/compressed``.

    Parameters
    ----------
    node : the node that reads
    take : called in the node's thread with header and picture (H, W, 3) uint8 BGR
    decode : CompressedImage -> picture; may raise InputError

    Attributes
    ----------
    waited : whether the picture that is being taken lay there while the one before was worked on
    """

    def __init__(
        self,
        node: ComponentNode,
        take: Callable[[Header, np.ndarray], None],
        decode: Callable[..., np.ndarray],
        depth: int,
    ) -> None:
        self._node = node
        self.waited = False
        self._done_s = -1.0
        self._take = node.guarded("image/compressed", self._timed(lambda picture: take(picture.header, picture.image)))
        self._decoded = self._timed(lambda message: take(message.header, decode(message)))
        self._channel = channel_of(node.context, node.resolve_topic_name("image/compressed"))
        self._guard = node.create_guard_condition(self._on_wake)
        self._reader = PictureReader(self._guard.trigger, depth)
        self._subscription: object | None = None
        self._choose()
        # A camera's node may come and go in this process.
        node.create_timer(1.0, self._choose)

    def _choose(self) -> None:
        here = self._channel.writers > 0
        if here and self._reader not in self._channel.readers:
            self._channel.readers += (self._reader,)
        if here and self._subscription is not None:
            self._node.drop_input(self._subscription)
            self._subscription = None
        elif not here and self._subscription is None:
            self._subscription = self._node.input("image/compressed", self._decoded, count_gaps=True)

    def _timed(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def timed(what: Any) -> None:
            self.waited = time.monotonic() - self._done_s < _AT_ONCE_S
            try:
                callback(what)
            finally:
                self._done_s = time.monotonic()

        return timed

    def close(self) -> None:
        """Take no more pictures."""
        self._channel.readers = tuple(r for r in self._channel.readers if r is not self._reader)

    def _on_wake(self) -> None:
        picture, missed = self._reader.take()
        if missed:
            self._node.missed("image/compressed", missed)
        if picture is not None:
            self._take(picture)
