"""``drocap info``: content of a recording, motion or tracks file."""

from __future__ import annotations

import argparse
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import Subparsers, add_command, table_lines
from drocap_ros.cli.telemetry_summary import Summary, is_video_or_log, telemetry_summary
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from drocap_ros.motion import Motion
    from drocap_ros.tracks import Tracks


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
        found = "a pipe or device" if path.exists() else "no such file"
        raise InputError(f"{path}: expected a recording, motion or tracks file, found {found}; check the path")
    path = _motion_in(path)
    from drocap_ros.recording.keypoints.files import is_keypoint_file

    if is_keypoint_file(path):
        return _of_arrays(path)
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
    from drocap_ros.tracks import kind_of, read_npz, wrong_kind

    arrays = read_npz(path, ()) if path.suffix == ".npz" else {}
    if "joints3d" in arrays:
        facts = _motion_facts(load_motion(path))
    elif kind_of(arrays) == "MoCap":
        raise wrong_kind(path, arrays, "a motion or 2D tracks")
    else:
        facts = _tracks_facts(read_keypoints(path))
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
