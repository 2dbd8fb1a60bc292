"""``drocap report``: one HTML file with a motion, its plots and its warnings."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import Subparsers, add_command, add_motion_argument, add_quiet_option, read_motion
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.motion import Motion


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "report",
        run,
        help="a motion as one HTML page that works offline",
        description="Write one self-contained HTML file: 3D player, 2D keypoints, plots, warnings, provenance.",
    )
    add_motion_argument(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, help="file to write (default: report.html beside MOTION)")
    parser.add_argument(
        "--video", metavar="VIDEO", type=Path, help="video, image folder or recording of MOTION, for its images"
    )
    add_quiet_option(parser, "no output, only errors")


def run(args: argparse.Namespace) -> int:
    """Write the report."""
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.report.page import save_report

    path, motion = read_motion(args.motion)
    out = args.out or path.with_name("report.html")
    places = [] if args.video else _places(path, str(motion.meta.get("input", "")))
    with output_file(out, inputs=[path, args.video, *places]) as file:
        found = _save_with_images(file, motion, places, args.command_line)
        if not found:
            former = next((page for page in (out, path.with_name("report.html")) if page.exists()), None)
            kept = save_report(file, motion, video=args.video, former=former, command=args.command_line)
    if not args.quiet:
        if places and not found:
            words = "kept the images of the report before" if kept else "without images"
            print(f"{words}: no video of this motion as {', '.join(map(str, places))}; name it: --video FILE")
        print(f"written: {out} ({out.stat().st_size / 1e6:.1f} MB)\n{open_words(out)}")
    return 0


def _save_with_images(file: Path, motion: Motion, places: Sequence[Path], command: str) -> bool:
    """Whether a video at one of the places is that of the motion; the report is then written."""
    from drocap_ros.report.motion_images import has_images
    from drocap_ros.report.page import save_report

    for video in places:
        with contextlib.suppress(InputError):  # another video of that name
            if video.exists() and has_images(video):
                return save_report(file, motion, video=video, command=command)
    return False


def _places(motion: Path, name: str) -> list[Path]:
    """Where the source of a motion may lie, by its name: beside the motion, beside its folder, where it is called."""
    if not (name := Path(name).name) or name.endswith(".npz"):
        return []
    return list(dict.fromkeys(place / name for place in (motion.parent, motion.parent.absolute().parent, Path())))


def open_words(report: Path) -> str:
    """What a person does with a report: the last line of each command that writes one."""
    return f"open {report} in a browser"
