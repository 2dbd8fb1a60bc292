"""``drocap info``: content of a recording, motion or tracks file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

from drocap_ros.cli.telemetry_summary import is_video_or_log, telemetry_summary
from drocap_ros.errors import InputError


class Summary(NamedTuple):
    """Facts by name, one table (none without columns), and warnings."""

    facts: list[tuple[str, str]]
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    warnings: Sequence[str]


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "info",
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
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Print the summary: tables on a terminal, plain lines in a pipe."""
    if args.metadata:
        return _print_metadata(args.session)
    summary = summarize(args.session)
    if sys.stdout.isatty():
        _print_table(summary)
    else:
        _print_plain(summary)
    for warning in summary.warnings:
        print(f"drocap: warning: {warning}", file=sys.stderr)
    return 0


def summarize(path: Path) -> Summary:
    """Content of a file or folder.

    Raises
    ------
    InputError
        When it is missing, unreadable, or of an unknown kind.
    """
    if not (path.is_file() or path.is_dir()):  # a named pipe would be waited for
        found = "a pipe or device" if path.exists() else "no such file"
        raise InputError(f"{path}: expected a recording, motion or tracks file, found {found}; check the path")
    path = _motion_in(path)
    if path.suffix == ".npz":
        return _of_arrays(path)
    return Summary(*telemetry_summary(path)) if is_video_or_log(path) else _of_session(path)


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
    from drocap_ros.geometry.flexion import flexion_words
    from drocap_ros.motion import load_motion
    from drocap_ros.reconstruction.world.calibration_words import telemetry_words
    from drocap_ros.tracks import load_tracks, read_npz, wrong_kind

    arrays = read_npz(path, ())
    facts = [("path", str(path))]
    if "joints3d" in arrays:
        motion = load_motion(path)
        scale = "metric" if motion.metric else "assumed"
        facts += [
            ("kind", "motion"),
            *_times(motion.stamp_ns),
            ("joints", ", ".join(motion.joints)),
            ("frame", motion.frame),
            ("scale", f"{scale} ({motion.scale_source})"),
            *((("median flexion", bent),) if (bent := flexion_words(motion.joints3d, motion.joints)) else ()),
            *((("telemetry", words),) if (words := telemetry_words(motion.meta)) else ()),
            *((key, str(motion.meta[key])) for key in ("method", "input", "git_revision") if key in motion.meta),
        ]
    elif "keypoints" in arrays:
        tracks = load_tracks(path)
        seen = (tracks.keypoints == tracks.keypoints).all(axis=2)
        facts += [
            ("kind", "tracks"),
            *_times(tracks.stamp_ns),
            ("joints", ", ".join(tracks.joints)),
            ("image", f"{tracks.image_size[0]}x{tracks.image_size[1]} px"),
            ("seen", f"{seen.any(axis=1).sum()} of {len(tracks)} frames, {100 * seen.mean():.1f} % of the keypoints"),
        ]
    else:
        raise wrong_kind(path, arrays, "a motion or 2D tracks")
    rows = [(name, str(a.dtype), " x ".join(map(str, a.shape)) or "scalar") for name, a in sorted(arrays.items())]
    return Summary(facts, ("array", "type", "shape"), rows, ())


def _times(stamp_ns: Any) -> list[tuple[str, str]]:
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


def _print_table(summary: Summary) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    facts = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in summary.facts:
        facts.add_row(Text(name, style="bold"), Text(value))
    table = Table(*summary.columns)
    for row in summary.rows:
        table.add_row(*(Text(cell) for cell in row))
    console.print(facts)
    if summary.columns:
        console.print(table)


def _print_plain(summary: Summary) -> None:
    for name, value in summary.facts:
        print(f"{name}: {_one_line(value)}")
    if not summary.columns:
        return
    table = [summary.columns, *summary.rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(summary.columns))]
    for row in table:
        print("  ".join(_one_line(cell).ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _one_line(text: str) -> str:
    return " ".join(text.split())
