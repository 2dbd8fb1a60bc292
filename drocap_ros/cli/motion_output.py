"""What a reconstruction writes and says; ``drocap reconstruct`` of one recording and of several has it in common."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.clip import Clip
    from drocap_ros.motion import Motion
    from drocap_ros.report.motion_images import MotionImages
    from drocap_ros.tracks import Tracks


def output_names(args: argparse.Namespace, out: Path, clip: Clip) -> list[str]:
    """Names of the files to write; refuses a folder that cannot be written, and a file that is the input."""
    from drocap_ros.cli.atomic_output import check_output_folder, is_same, refuse_inputs

    check_output_folder(out)
    names = ["motion.npz", "tracks.npz", *([] if args.no_report else ["report.html"])]
    if clip.whole and is_same(out / "tracks.npz", args.input):
        names.remove("tracks.npz")  # they stay as they are
    refuse_inputs([out / name for name in names], [args.input])
    return names


def write_outputs(
    out: Path,
    names: list[str],
    motion: Motion,
    tracks: Tracks,
    images: Callable[[Motion], MotionImages | None],
    beside: Sequence[Motion] = (),
) -> None:
    """Write the output folder at once.

    images : gives those of the report
    beside : the motion as further cameras see it
    """
    from drocap_ros.cli.atomic_output import output_folder
    from drocap_ros.motion import save_motion
    from drocap_ros.report.page import save_report
    from drocap_ros.tracks import save_tracks

    with output_folder(out) as folder:
        save_motion(folder / "motion.npz", motion)
        for number, further in enumerate(beside, start=2):
            save_motion(folder / f"camera_{number}.npz", further)
        if "tracks.npz" in names:
            save_tracks(folder / "tracks.npz", tracks)
        if "report.html" in names:
            save_report(folder / "report.html", motion, images=images(motion), former=out / "report.html")
    if "report.html" not in names:
        (out / "report.html").unlink(missing_ok=True)  # of an older motion


def summary(motion: Motion, method: str, waited_s: float | None = None) -> str:
    """Four lines: frames, method, frame and scale; reprojection error as in the report; seconds; quality.

    waited_s : since the command's begin; what the motion did not take is that of start, report and files
    """
    from drocap_ros.report.checks import quality_sentence, run_checks
    from drocap_ros.report.statistics import motion_statistics, scale_of, stage_seconds

    s = motion_statistics(motion)
    stages = stage_seconds(motion.meta)
    total = stages.pop("total", sum(stages.values()))
    if waited_s is not None:
        total, stages["report"] = waited_s, waited_s - total
    poses = "; 2D poses as recorded (--redetect estimates them from the images)"
    return (
        f"{len(motion.joints3d)} frames, a subject in {s.seen.mean():.1%}; method {method}, frame {motion.frame},"
        f" scale {', '.join(scale_of(motion))}{poses if motion.meta.get('pose2d') == 'recorded' else ''}\n"
        f"median reprojection error {s.median_px:.1f} px, {s.median_px / s.body_px:.1%} of the body\n"
        f"{total:.2f} s: {', '.join(f'{name} {value:.2f} s' for name, value in stages.items())}\n"
        f"{quality_sentence(run_checks(motion, s))}"
    )
