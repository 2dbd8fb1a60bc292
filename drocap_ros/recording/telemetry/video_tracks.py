"""Tracks of a video file beside its pictures: their samples, and what the file states of itself."""

from __future__ import annotations

import contextlib
import datetime
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from drocap_ros.errors import InputError, first_line
from drocap_ros.perception.sources.video import open_container, pyav, track_codes

#: Creation times of a clock that was set: the years 2000 to 2100.
_YEARS = range(2000, 2100)
_MAX_DURATION_S = 1e6  # s: eleven days


def find_track(path: Path, codes: Sequence[str]) -> tuple[int, str] | None:
    """Number and format of the track whose format comes first in ``codes``, None where there is none."""
    there = track_codes(path) or _codecs(path)
    return next(((there.index(code), code) for code in codes if code in there), None)


def _codecs(path: Path) -> list[str]:
    """Names of the codecs of the tracks of another container, empty where FFmpeg opens none."""
    with contextlib.suppress(pyav().error.FFmpegError), open_container(path) as container:
        return [stream.codec_context.name if stream.codec_context else "" for stream in container.streams]
    return []


def read_samples(path: Path, number: int) -> Iterator[tuple[int, bytes]]:
    """Times in ns, by the video's clock, and contents of the samples of a track; no other track is read."""
    av = pyav()
    try:
        with open_container(path) as container:
            for stream in container.streams:
                stream.discard = av.stream.Discard.default if stream.index == number else av.stream.Discard.all
            track = container.streams[number]
            for packet in container.demux(track):
                if packet.size and packet.pts is not None and not packet.is_discard:
                    seconds = packet.pts * packet.time_base
                    if abs(seconds) > _MAX_DURATION_S:
                        raise InputError(
                            f"expected samples within {_MAX_DURATION_S:.0f} s, found one at {float(seconds):.0f} s"
                        )
                    yield round(seconds * 10**9), bytes(packet)
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"expected a whole track, found it damaged ({first_line(error)})") from None


def stated_times(path: Path) -> tuple[int | None, float | None]:
    """Creation time (UTC, ns) and duration (s) as the file states them, None where it does not.

    A time with its zone, as Apple writes it beside the other one, comes first.
    """
    created_ns = duration_s = None
    with contextlib.suppress(pyav().error.FFmpegError), open_container(path) as container:
        stated = (container.metadata.get(key, "") for key in ("com.apple.quicktime.creationdate", "creation_time"))
        for text in stated:
            with contextlib.suppress(ValueError):
                zoned = re.sub(r"([+-]\d\d)(\d\d)$", r"\1:\2", text.replace("Z", "+00:00"))
                created = datetime.datetime.fromisoformat(zoned)
                if created_ns is None and created.tzinfo is not None and created.year in _YEARS:
                    created_ns = round(created.timestamp()) * 10**9
        if container.duration and container.duration / 1e6 < _MAX_DURATION_S:
            duration_s = container.duration / 1e6
    return created_ns, duration_s
