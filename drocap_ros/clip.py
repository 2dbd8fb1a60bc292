"""A part of a recording, by seconds from its first image."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar

from drocap_ros.errors import InputError
from drocap_ros.tracks import Tracks

#: Called with the name of a stage and its completed share, 0 to 1; a negative share = unknown length.
Progress: TypeAlias = Callable[[str, float], None]

#: Tolerance of the bounds against rounded stamps.
_SLACK_NS = 500_000


class Stamped(Protocol):
    """Anything with an exposure time in ns."""

    @property
    def stamp_ns(self) -> int:
        """Exposure time."""


S = TypeVar("S", bound=Stamped)


@dataclass(frozen=True)
class Clip:
    """The images from ``start_s`` to ``end_s``, both included; the default is the whole recording."""

    start_s: float = 0.0
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < self.end_s or math.isinf(self.start_s):
            raise InputError(
                f"--start {self.start_s:g}, --end {self.end_s:g}: expected 0 <= start < end in seconds; correct them"
            )

    @property
    def whole(self) -> bool:
        """Whether nothing is left out."""
        return self.start_s == 0.0 and math.isinf(self.end_s)

    @property
    def meta(self) -> dict[str, float | None]:
        """JSON-compatible bounds; None = the end of the recording."""
        return {"start_s": self.start_s, "end_s": None if math.isinf(self.end_s) else self.end_s}

    def holds(self, after_ns: int) -> bool:
        """Whether a time after the first image, ns, lies in the clip."""
        return self.start_s * 1e9 - _SLACK_NS <= after_ns <= self.end_s * 1e9 + _SLACK_NS

    def select(self, items: Iterable[S]) -> Iterable[S]:
        """The items, in the order of time, whose stamps lie in the clip; nothing after its end is read.

        The items themselves for the whole recording: a stream stays a stream.
        """
        return items if self.whole else self._select(items)

    def _select(self, items: Iterable[S]) -> Iterator[S]:
        first_ns: int | None = None
        last_ns, found = 0, False
        for item in items:
            first_ns = item.stamp_ns if first_ns is None else first_ns
            last_ns = item.stamp_ns - first_ns
            if last_ns > self.end_s * 1e9 + _SLACK_NS:
                break
            if last_ns >= self.start_s * 1e9 - _SLACK_NS:
                found = True
                yield item
        if first_ns is not None and not found:
            raise self._too_late(last_ns)

    def cut(self, tracks: Tracks) -> Tracks:
        """The frames of tracks whose stamps lie in the clip."""
        if self.whole:
            return tracks
        at_ns = tracks.stamp_ns - tracks.stamp_ns[0]
        use = (at_ns >= self.start_s * 1e9 - _SLACK_NS) & (at_ns <= self.end_s * 1e9 + _SLACK_NS)
        if not use.any():
            raise self._too_late(int(at_ns[-1]))
        return tracks.of_frames(use)

    def meter(
        self, progress: Progress | None, stage: str, duration_s: float | None
    ) -> Callable[[Stamped, object], None]:
        """A function of each selected item that reports the completed share; -1 where the duration is unknown."""
        end_s = min(self.end_s, math.inf if duration_s is None else duration_s)
        first_ns: int | None = None

        def report(item: Stamped, _: object) -> None:
            nonlocal first_ns
            first_ns = item.stamp_ns if first_ns is None else first_ns
            if progress is not None:
                share = (item.stamp_ns - first_ns) * 1e-9 / max(end_s - self.start_s, 1e-9)
                progress(stage, -1.0 if math.isinf(end_s) else min(share, 1.0))

        return report

    def _too_late(self, last_ns: int) -> InputError:
        return InputError(
            f"--start {self.start_s:g}: expected a time within the recording's {last_ns * 1e-9:.2f} s; choose another"
        )
