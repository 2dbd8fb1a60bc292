"""Images of ``image/compressed`` for a node that needs long for each."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header

from drocap_ros.ros.component import ComponentNode, Gaps, MessageInfo
from drocap_ros.ros.topics import IMAGE_IN_GRAPH_QOS, publishers_of

_TOPIC = "image/compressed"


class ImageSample(NamedTuple):
    """An image (H, W, 3) uint8 BGR that waited to be processed.

    missed : images dropped since the one before
    waited : whether it arrived while the one before was processed
    behind : how many wait behind it
    """

    header: Header
    image: np.ndarray
    missed: int
    waited: bool
    behind: int


class ImageQueue:
    """Images between the thread that receives and the thread that processes: the newest ``depth``."""

    def __init__(self, depth: int) -> None:
        self._images: deque[tuple[Header, np.ndarray]] = deque(maxlen=depth)
        self._missed = 0
        self._busy = False
        self._closed = False
        self._changed = threading.Condition()

    def put(self, header: Header, image: np.ndarray, missed: int = 0) -> None:
        """Append an image; ``missed`` images before it were lost elsewhere."""
        with self._changed:
            self._missed += missed + (len(self._images) == self._images.maxlen)
            self._images.append((header, image))
            self._changed.notify_all()

    def take(self) -> ImageSample | None:
        """Oldest image that waits, or the next one; None at the end.  The image taken before is then done."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            waited = bool(self._images)
            self._changed.wait_for(lambda: self._images or self._closed)
            if self._closed:
                return None
            self._busy = True
            missed, self._missed = self._missed, 0
            return ImageSample(*self._images.popleft(), missed, waited, len(self._images))

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until no image waits or is processed; returns whether that was reached."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._images or self._busy), timeout_s)

    def close(self) -> None:
        """Return no more images."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class ImageInput:
    """Subscription to ``image/compressed`` that decodes in the node's thread and processes in one of its own.

    In simulated time it processes each image on arrival: however long that takes, no image waits or is dropped.

    node : the node that subscribes
    process : called in that thread with a sample; an InputError is counted, any other error ends the node
    decode : CompressedImage -> image; may raise InputError
    depth : images that may wait
    """

    def __init__(
        self,
        node: ComponentNode,
        process: Callable[[ImageSample], None],
        decode: Callable[..., np.ndarray],
        depth: int,
    ) -> None:
        self._node = node
        self._process = node.guarded(_TOPIC, process, stamps=False)  # validated on arrival
        self._decode = decode
        self._gaps = Gaps()
        self._queue = ImageQueue(depth)
        qos = IMAGE_IN_GRAPH_QOS if publishers_of(_TOPIC, node.peers) else None
        node.input(_TOPIC, self._on_message, qos=qos, with_info=True)
        self._thread = node.thread(self._run, "images")
        if not node.simulated:
            self._thread.start()

    def wait_idle(self) -> None:
        """Wait until the images that have arrived are processed, at most 5 s."""
        self._queue.wait_idle(timeout_s=5.0)

    def close(self) -> None:
        """Process no more images."""
        self._queue.close()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _on_message(self, message: CompressedImage, info: MessageInfo) -> None:
        image, missed = self._decode(message), self._gaps.before(info)
        if self._node.simulated:
            self._process_now(ImageSample(message.header, image, missed, waited=False, behind=0))
        else:
            self._queue.put(message.header, image, missed)

    def _process_now(self, sample: ImageSample) -> None:
        if sample.missed:
            self._node.missed(_TOPIC, sample.missed)
        self._process(sample)

    def _run(self) -> None:
        while (sample := self._queue.take()) is not None:
            self._process_now(sample)
