"""What every image source offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType

import numpy as np


@dataclass(frozen=True)
class Frame:
    """One image and its exposure time.

    stamp_ns : int, the container's or driver's presentation time, strictly increasing within a source
    image : (H, W, 3) uint8, BGR
    """

    stamp_ns: int
    image: np.ndarray


@dataclass(frozen=True)
class SourceEvent:
    """Something that a user should know about a source: ``kind`` and the words."""

    kind: str  # "stalled", "reconnecting", "recovered", "ended_early", "corrupt"
    text: str


class ImageSource(ABC):
    """Iterator of :class:`Frame` and context manager.

    size : (width, height) px of every frame
    length : number of frames where the source states it (for progress only), else None
    live : whether frames come at their own pace and are lost when nobody takes them
    """

    size: tuple[int, int]
    length: int | None = None
    live: bool = False

    def __init__(self) -> None:
        self._events: list[SourceEvent] = []

    @abstractmethod
    def read(self) -> Frame | None:
        """Next frame, or None at the end."""

    @abstractmethod
    def close(self) -> None:
        """Release the file or device; may be called twice."""

    def events(self) -> list[SourceEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the end."""
        while (frame := self.read()) is not None:
            yield frame

    def __enter__(self) -> ImageSource:
        """Enter the context."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close on leaving."""
        self.close()
