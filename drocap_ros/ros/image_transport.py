"""Pictures handed over as arrays between nodes of one process, and as JPEG to everybody else.

``rclpy`` has no transport inside a process: each picture would be encoded, copied through DDS and decoded again.
A channel belongs to a ROS context and a topic, so that graphs side by side in one process do not mix.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from rclpy.context import Context
from std_msgs.msg import Header

from drocap_ros.perception.jpeg import encode_jpeg
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.conversions import compressed_image_to_ros
from drocap_ros.ros.topics import IMAGE_IN_GRAPH_QOS, publishers_of

#: Pictures that wait to be encoded for others: a third of a second, then the oldest is dropped.
_WAITING = 10


class Picture(NamedTuple):
    """A picture (H, W, 3) uint8 BGR, which nobody writes to, and its header."""

    header: Header
    image: np.ndarray


class Taken(NamedTuple):
    """A picture, how many were missed since the one before, whether it lay there while that was worked on, and how
    many lie there still.
    """

    picture: Picture
    missed: int
    waited: bool
    behind: int


class PictureReader:
    """What one node has not yet taken: at most ``depth`` pictures, the newest; the others are counted."""

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._pictures: list[Picture] = []
        self._missed = 0
        self._busy = False
        self._closed = False
        self._changed = threading.Condition()

    def put(self, picture: Picture) -> None:
        """Hand over; called by the writer's thread."""
        with self._changed:
            self._pictures.append(picture)
            while len(self._pictures) > self._depth:
                self._pictures.pop(0)
                self._missed += 1
            self._changed.notify_all()

    def take(self) -> Taken | None:
        """Oldest picture that waits, or the next one; None at the end.  Asking again says that the last is done."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            waited = bool(self._pictures)
            self._changed.wait_for(lambda: self._pictures or self._closed)
            if self._closed:
                return None
            self._busy = True
            missed, self._missed = self._missed, 0
            return Taken(self._pictures.pop(0), missed, waited, len(self._pictures))

    def settle(self, timeout_s: float) -> bool:
        """Wait until nothing waits and nobody works on a picture; whether it came to that."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._pictures or self._busy), timeout_s)

    def close(self) -> None:
        """Give out no more pictures."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


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

    Pictures are worked on in a thread of their own: while one is, the node's thread decodes the next.

    Parameters
    ----------
    node : the node that reads
    take : called in that thread with header and picture (H, W, 3) uint8 BGR; what it raises, but for a refusal, comes
        out of the node's thread
    decode : CompressedImage -> picture; may raise InputError
    depth : pictures that may wait

    Attributes
    ----------
    waited : whether the picture that is being taken lay there while the one before was worked on
    behind : how many lie there still
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
        self.behind = 0
        # Stamps are checked where a message comes in; a camera of this process has checked its own.
        self._take = node.guarded("image/compressed", lambda picture: take(*picture), stamps=False)
        self._decode = decode
        self._channel = channel_of(node.context, node.resolve_topic_name("image/compressed"))
        self._reader = PictureReader(depth)
        self._subscription: object | None = None
        self._error: BaseException | None = None
        self._failed = node.create_guard_condition(self._raise)
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()
        self._choose()
        # A camera's node may come and go in this process.
        node.create_timer(1.0, self._choose)

    def settle(self) -> None:
        """Wait until the pictures that have arrived are worked off, but not long."""
        self._reader.settle(timeout_s=5.0)

    def close(self) -> None:
        """Take no more pictures."""
        self._channel.readers = tuple(r for r in self._channel.readers if r is not self._reader)
        self._reader.close()
        self._thread.join(timeout=5.0)

    def _choose(self) -> None:
        here = self._channel.writers > 0
        if here and self._reader not in self._channel.readers:
            self._channel.readers += (self._reader,)
        if here and self._subscription is not None:
            self._node.drop_input(self._subscription)
            self._subscription = None
        elif not here and self._subscription is None:
            qos = IMAGE_IN_GRAPH_QOS if publishers_of("image/compressed", self._node.peers) else None
            self._subscription = self._node.input("image/compressed", self._on_message, qos=qos, count_gaps=True)

    def _on_message(self, message: Any) -> None:
        self._reader.put(Picture(message.header, self._decode(message)))

    def _run(self) -> None:
        try:
            while (taken := self._reader.take()) is not None:
                if taken.missed:
                    self._node.missed("image/compressed", taken.missed)
                self.waited, self.behind = taken.waited, taken.behind
                self._take(taken.picture)
        except Exception as error:
            self._error = error
            self._failed.trigger()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error
