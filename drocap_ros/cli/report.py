"""``drocap report``: one HTML file with a motion, its plots and its warnings."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command, add_motion_argument, add_quiet_option, read_motion
from drocap_ros.errors import InputError


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
    name = Path(str(motion.meta.get("input", "")))
    video = args.video or _beside(path, name)
    with output_file(out, inputs=[path, video]) as file:
        try:
            save_report(file, motion, video=video, command=args.command_line)
        except InputError:
            if video is None or args.video:
                raise
            video = None  # another video of that name
            save_report(file, motion, command=args.command_line)
    if not args.quiet:
        if video is None and name.suffix != ".npz":
            print(f"without images; --video {name} with its folder shows them")
        print(f"written: {out} ({out.stat().st_size / 1e6:.1f} MB)\n{open_words(out)}")
    return 0


def _beside(motion: Path, name: Path) -> Path | None:
    """A motion's source of this name with images, where it lies beside the motion or its folder; None = elsewhere."""
    from drocap_ros.report.motion_images import has_images

    places = (motion.parent, motion.parent.parent, Path())
    found = (place / name.name for place in places if name.suffix)
    return next((file for file in found if file.is_file() and has_images(file)), None)


def open_words(report: Path) -> str:
    """What a person does with a report: the last line of each command that writes one."""
    return f"open {report} in a browser"
