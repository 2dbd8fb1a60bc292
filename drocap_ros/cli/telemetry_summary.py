"""Telemetry of a video file or a log, for ``drocap info``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from av.stream import Stream

    from drocap_ros.recording.telemetry.log import TelemetryLog


_VIDEOS = (".mp4", ".mov", ".lrf")
#: Codes of the registry of ISO/IEC 14496-12 in words.
_FORMATS = {
    "avc1": "H.264", "hvc1": "H.265", "hev1": "H.265", "vp09": "VP9", "av01": "AV1", "mp4v": "MPEG-4", "jpeg": "JPEG",
    "mp4a": "AAC", "djmd": "DJI telemetry", "dbgi": "DJI debugging data", "mebx": "metadata", "tmcd": "time code",
}  # fmt: skip


class Summary(NamedTuple):
    """Facts by name, one table (none without columns), and warnings."""

    facts: list[tuple[str, str]]
    columns: tuple[str, ...] = ()
    rows: Sequence[tuple[str, ...]] = ()
    warnings: Sequence[str] = ()


def is_video_or_log(path: Path) -> bool:
    """Whether a file begins as a video, or its name is that of a video or a telemetry log."""
    from drocap_ros.file_kind import FileKind, file_kind
    from drocap_ros.recording.telemetry.read import LOG_SUFFIXES

    named = path.suffix.lower() in (*_VIDEOS, *LOG_SUFFIXES)
    return path.is_file() and (named or file_kind(path) is FileKind.VIDEO)


def telemetry_summary(path: Path) -> Summary:
    """What a video or log holds: rates, shares, lens, and what is missing."""
    from drocap_ros.recording.telemetry.read import LOG_SUFFIXES, read_telemetry

    warnings: list[str] = []
    facts, log = [("path", str(path))], None
    if path.suffix.lower() in LOG_SUFFIXES:
        log = read_telemetry(path)
    else:
        from drocap_ros.recording.video_telemetry import read_own

        facts += _video_facts(path)
        own, warnings = read_own(path)
        if own is not None:
            log = own[1]
            facts += [] if own[0] == path else [("beside the video", own[0].name)]
    if log is None:
        found = "not usable" if warnings else "none in the file"
        return Summary([*facts, ("telemetry", found)], warnings=warnings)
    return Summary([*facts, *_log_facts(log)], ("telemetry", "states", "share", "rate"), _rows(log), warnings)


def _video_facts(path: Path) -> list[tuple[str, str]]:
    """Kind of each track; its format, size, samples and rate in words."""
    from drocap_ros.errors import first_line
    from drocap_ros.perception.sources.video import open_container, pyav, track_codes

    codes = track_codes(path)
    try:
        with open_container(path) as container:
            streams = container.streams
            return [_track_fact(s, codes[s.index] if s.index < len(codes) else "") for s in streams]
    except pyav().error.FFmpegError as error:
        raise InputError(
            f"{path}: expected a video file with its index, found none ({first_line(error)}); copy it again"
        ) from None


def _track_fact(stream: Stream, code: str) -> tuple[str, str]:
    from av.video.codeccontext import VideoCodecContext

    context = stream.codec_context
    kind = "time code" if code == "tmcd" else {"audio": "sound", "subtitle": "subtitles"}.get(stream.type, stream.type)
    name = _FORMATS.get(code) or (context.codec.name if context else "")
    words = f"{name} ({_printable(code)})" if name and code else name or _printable(code) or "unknown format"
    if isinstance(context, VideoCodecContext):
        words += f", {context.width}x{context.height} px"
    stamps = [entry.timestamp for entry in stream.index_entries if not entry.is_discard]
    count = stream.frames and len(stamps)
    span_s = float((stamps[-1] - stamps[0]) * (stream.time_base or 0)) if count else 0.0
    words += (f", {count} samples" if count else "") + (f", {(count - 1) / span_s:.2f}/s" if span_s > 0 else "")
    return f"{kind} track", words


def _printable(code: str) -> str:
    """A damaged file may hold codes that steer a terminal."""
    return "".join(c if c.isprintable() else "?" for c in code)


def _log_facts(log: TelemetryLog) -> list[tuple[str, str]]:
    facts = [("source", log.kind), ("duration", f"{log.duration_s:.3f} s")]
    if log.video_parts:
        parts = ", ".join(f"{a * 1e-9:.1f} to {b * 1e-9:.1f} s" for a, b in log.video_parts[:20])
        facts.append(("on video", parts))
    if log.lens is not None:
        facts.append(("lens", str(log.lens)))
    return facts + [("missing", str(lack)) for lack in log.lacks]


def _rows(log: TelemetryLog) -> list[tuple[str, ...]]:
    import numpy as np

    series = {"camera attitude": log.track.gimbal, "aircraft attitude": log.track.orientation}
    rows: list[tuple[str, ...]] = []
    for name, values in {**series, "position": log.track.position}.items():
        known = np.isfinite(values).all(axis=1)
        rate = (known.sum() - 1) / log.duration_s if known.any() and log.duration_s > 0 else 0.0
        rows.append((name, str(known.sum()), f"{known.mean():.1%}", f"{max(rate, 0.0):.2f}/s"))
    return rows
