"""``drocap report``: one HTML file with a motion, its plots and its warnings."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Mapping, Sequence
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
    parser.add_argument(
        "--mp4", action="store_true", help="also write the video beside the body in 3D, H.264, beside the page"
    )
    add_quiet_option(parser, "no output, only errors")


def run(args: argparse.Namespace) -> int:
    """Write the report, and the video beside it."""
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.motion import people_files
    from drocap_ros.report.page import save_report

    if people := people_files(args.motion):
        return _report_people(args, people)
    path, motion = read_motion(args.motion)
    out = args.out or path.with_name("report.html")
    places = [args.video] if args.video else _places(path, str(motion.meta.get("input", "")))
    video = args.video or _own_video(motion, places)
    looked = f"no video of this motion as {', '.join(map(str, places))}; name it: --video FILE"
    if args.mp4 and video is None:
        raise InputError(f"--mp4: expected the motion's images, found {looked}")
    with output_file(out, inputs=[path, *places]) as file:
        former = next((page for page in (out, path.with_name("report.html")) if page.exists()), None)
        shown = save_report(file, motion, video=video, former=former, command=args.command_line)
        mp4 = [_save_mp4(out.with_suffix(".mp4"), motion, video, args.quiet)] if args.mp4 and video else []
    if not args.quiet:
        if places and video is None:
            print(f"{'kept the images of the report before' if shown else 'without images'}: {looked}")
        print("".join(f"written: {file} ({file.stat().st_size / 1e6:.1f} MB)\n" for file in (out, *mp4)), end="")
        print(open_words(out))
    return 0


def _report_people(args: argparse.Namespace, files: Mapping[int, Path]) -> int:
    """Write the one report of several persons."""
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.motion import load_motion
    from drocap_ros.report.people import leader, save_people_report

    if args.mp4:
        raise InputError(f"--mp4: expected one motion, found persons {', '.join(map(str, files))}; name one")
    people = {number: load_motion(path) for number, path in files.items()}
    motion, out = people[leader(people)], args.out or args.motion / "report.html"
    places = [args.video] if args.video else _places(args.motion / "motion.npz", str(motion.meta.get("input", "")))
    video = args.video or _own_video(motion, places)
    with output_file(out, inputs=[*files.values(), *places]) as file:
        save_people_report(file, people, video=video, command=args.command_line)
    if not args.quiet:
        print(f"written: {out} ({out.stat().st_size / 1e6:.1f} MB)\n{open_words(out)}")
    return 0


def _own_video(motion: Motion, places: Sequence[Path]) -> Path | None:
    """The first of the places with images of the motion; None = there is none."""
    from drocap_ros.report.motion_images import each_image, has_images

    for place in places:
        with contextlib.suppress(InputError):  # another video of that name
            if place.exists() and has_images(place):
                next(each_image(place, motion))
                return place
    return None


def _save_mp4(out: Path, motion: Motion, video: Path, quiet: bool) -> Path:
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.report.side_by_side import save_side_by_side

    with output_file(out, inputs=[video], option="--mp4") as file, progress_bars(quiet) as progress:
        save_side_by_side(file, motion, video, progress)
    return out


def _places(motion: Path, name: str) -> list[Path]:
    """Where the source of a motion may lie, by its name: beside the motion, beside its folder, where it is called."""
    if not (name := Path(name).name) or name.endswith(".npz"):
        return []
    return list(dict.fromkeys(place / name for place in (motion.parent, motion.parent.absolute().parent, Path())))


def open_words(report: Path) -> str:
    """What a person does with a report: the last line of each command that writes one."""
    return f"open {report} in a browser"
