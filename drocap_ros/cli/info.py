"""``drocap info``: content of a recording, motion or tracks file, tracks and telemetry of a video or log."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drocap_ros.cli.options import Subparsers, add_command, table_lines
from drocap_ros.errors import InputError
from drocap_ros.file_kind import missing

if TYPE_CHECKING:
    import numpy as np
    from av.stream import Stream

    from drocap_ros.motion import Motion
    from drocap_ros.recording.telemetry.log import TelemetryLog
    from drocap_ros.tracks import Tracks


_VIDEOS = (".mp4", ".mov", ".lrf")
#: Codes of the registry of ISO/IEC 14496-12 in words.
_FORMATS = {
    "avc1": "H.264", "hvc1": "H.265", "hev1": "H.265", "vp09": "VP9", "av01": "AV1", "mp4v": "MPEG-4", "jpeg": "JPEG",
    "mp4a": "AAC", "djmd": "DJI telemetry", "gpmd": "GoPro telemetry",
    "dbgi": "DJI debugging data", "mebx": "metadata", "tmcd": "time code",
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
    return facts + [("note", str(lack)) for lack in log.lacks]


def _rows(log: TelemetryLog) -> list[tuple[str, ...]]:
    import numpy as np

    series = {"camera attitude": log.track.gimbal, "aircraft attitude": log.track.orientation}
    rows: list[tuple[str, ...]] = []
    for name, values in {**series, "position": log.track.position}.items():
        known = np.isfinite(values).all(axis=1)
        rate = (known.sum() - 1) / log.duration_s if known.any() and log.duration_s > 0 else 0.0
        rows.append((name, str(known.sum()), f"{known.mean():.1%}", f"{max(rate, 0.0):.2f}/s"))
    return rows


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "info",
        run,
        help="print the content of a recording, motion or tracks file",
        description="Print topics, types, counts and duration of a recording (session folder, .mcap, .bag, rosbag2 "
        "folder), arrays and shapes of a motion.npz or tracks .npz, or the telemetry of a video file or log.",
    )
    parser.add_argument(
        "session", metavar="SESSION", type=Path, help="recording, motion.npz or its folder, tracks .npz, video or log"
    )
    parser.add_argument(
        "--metadata", action="store_true", help="print the parameters and other metadata of a session or motion in full"
    )


def run(args: argparse.Namespace) -> int:
    """Print facts, a table and, on stderr, warnings."""
    if args.metadata:
        return _print_metadata(args.session)
    summary = summarize(args.session)
    for name, value in summary.facts:
        print(f"{name}: {_one_line(value)}")
    if summary.columns:
        print("\n".join(table_lines([summary.columns, *([_one_line(cell) for cell in row] for row in summary.rows)])))
    for warning in summary.warnings:
        print(f"drocap: warning: {warning}", file=sys.stderr)
    return 0


def summarize(path: Path) -> Summary:
    """Content of a file or folder."""
    if not (path.is_file() or path.is_dir()):  # a named pipe would be waited for
        if not path.exists():
            raise missing(path, "a recording, motion or tracks file")
        raise InputError(f"{path}: expected a recording, motion or tracks file, found a pipe or device; name a file")
    path = _motion_in(path)
    from drocap_ros.perception.sources import open_source
    from drocap_ros.perception.sources.image_files import SUFFIXES
    from drocap_ros.recording.keypoints.files import is_keypoint_file
    from drocap_ros.recording.open_session import is_recording

    if is_keypoint_file(path):
        return _of_arrays(path)
    if (
        path.is_dir()
        and not is_recording(path)
        and not SUFFIXES.isdisjoint(p.suffix.lower() for p in path.glob("[!.]*"))
    ):
        with open_source(path) as images:
            size = f"{images.size[0]}x{images.size[1]} px"
            facts = [("path", str(path)), ("kind", f"images: {images.length}"), ("image", size)]
            return Summary([*facts, ("duration", f"{images.duration_s:.3f} s")])
    return telemetry_summary(path) if is_video_or_log(path) else _of_session(path)


def _motion_in(path: Path) -> Path:
    """The motion file of a motion's folder, else the path itself."""
    return path / "motion.npz" if path.is_dir() and (path / "motion.npz").is_file() else path


def _of_session(path: Path) -> Summary:
    from drocap_ros.recording.open_session import session_info

    info = session_info(path)
    facts = [
        ("path", str(path)),
        ("kind", info.kind),
        ("start", _time_text(info.start_ns)),
        ("duration", f"{info.duration_s:.3f} s"),
        ("messages", str(info.message_count)),
        *((key, _short(value)) for key, value in sorted(info.metadata.items())),
    ]
    rows = [(t.name, t.type_name, str(t.count), _rate_text(t.count, info.duration_s)) for t in info.topics]
    return Summary(facts, ("topic", "type", "messages", "rate"), rows, info.warnings)


def _short(value: str) -> str:
    lines = value.strip().splitlines()
    return value if len(lines) < 2 else f"{len(lines)} lines; --metadata prints them"


def _print_metadata(path: Path) -> int:
    import json

    from drocap_ros.motion import load_motion
    from drocap_ros.recording.open_session import session_info

    path = _motion_in(path)
    if path.suffix == ".npz":
        metadata = {key: json.dumps(value, indent=2) for key, value in load_motion(path).meta.items()}
    else:
        metadata = session_info(path).metadata
    for key, value in sorted(metadata.items()):
        print(f"# {key}\n{value.rstrip()}\n")
    return 0


def _of_arrays(path: Path) -> Summary:
    from drocap_ros.motion import load_motion
    from drocap_ros.recording.keypoints.files import read_keypoints
    from drocap_ros.tracks import change_lines, kind_of, read_npz, wrong_kind

    arrays = read_npz(path, ()) if path.suffix == ".npz" else {}
    if "joints3d" in arrays:
        facts = _motion_facts(load_motion(path))
    elif kind_of(arrays) == "MoCap":
        raise wrong_kind(path, arrays, "a motion or 2D tracks")
    else:
        facts = _tracks_facts(tracks := read_keypoints(path))
        if "change" in arrays and "change_ns" in arrays:
            lines = change_lines(
                list(zip(arrays["change_ns"], arrays["change"], strict=False)), int(tracks.stamp_ns[0])
            )
            facts += [("the person may change", line) for line in lines]
    columns = ("array", "type", "shape") if arrays else ()
    rows = [(name, str(a.dtype), " x ".join(map(str, a.shape)) or "scalar") for name, a in sorted(arrays.items())]
    return Summary([("path", str(path)), *facts], columns, rows)


def _motion_facts(motion: Motion) -> list[tuple[str, str]]:
    from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
    from drocap_ros.report.movement import flexion_words
    from drocap_ros.report.statistics import scale_of

    found = [
        ("median flexion", flexion_words(motion.joints3d, motion.joints)),
        ("telemetry", telemetry_words(motion.meta)),
        *((key, str(motion.meta.get(key, ""))) for key in ("method", "input", "git_revision")),
    ]
    return [
        ("kind", "motion"),
        *_times(motion.stamp_ns),
        ("joints", ", ".join(motion.joints)),
        ("frame", motion.frame),
        ("scale", ", ".join(scale_of(motion))),
        *((name, words) for name, words in found if words),
    ]


def _tracks_facts(tracks: Tracks) -> list[tuple[str, str]]:
    seen = (tracks.keypoints == tracks.keypoints).all(axis=2)
    return [
        ("kind", "tracks"),
        *_times(tracks.stamp_ns),
        ("joints", ", ".join(tracks.joints)),
        ("image", f"{tracks.image_size[0]}x{tracks.image_size[1]} px"),
        ("seen", f"{seen.any(axis=1).sum()} of {len(tracks)} frames, {100 * seen.mean():.1f} % of the keypoints"),
    ]


def _times(stamp_ns: np.ndarray) -> list[tuple[str, str]]:
    frames = len(stamp_ns)
    duration = float(stamp_ns[-1] - stamp_ns[0]) * 1e-9 if frames else 0.0
    rate = f", {(frames - 1) / duration:.2f} frames/s" if duration > 0 else ""
    return [("frames", str(frames)), ("duration", f"{duration:.3f} s{rate}")]


def _time_text(stamp_ns: int | None) -> str:
    if stamp_ns is None:
        return "no messages"
    try:
        moment = datetime.fromtimestamp(stamp_ns * 1e-9, tz=timezone.utc)
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns} ns"
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def _rate_text(count: int, seconds: float) -> str:
    return f"{(count - 1) / seconds:.2f} Hz" if seconds > 0 and count > 1 else "-"


def _one_line(text: str) -> str:
    return " ".join(text.split())
