"""What a reconstruction writes and says: of one person, of several (``--all``, ``--subject 1,3``)."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.clip import Clip, Progress
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import Motion
    from drocap_ros.pipeline import Selection
    from drocap_ros.recording.video_telemetry import Telemetry
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
    beside: Sequence[tuple[Motion, Tracks]] = (),
) -> None:
    """Write the output folder at once.

    images : gives those of the report
    beside : the motion as further cameras see it, and what they have seen
    """
    from drocap_ros.cli.atomic_output import output_folder
    from drocap_ros.motion import save_motion
    from drocap_ros.report.page import save_report
    from drocap_ros.tracks import save_tracks

    with output_folder(out) as folder:
        save_motion(folder / "motion.npz", motion)
        for number, (further, seen) in enumerate(beside, start=2):
            save_motion(folder / f"camera_{number}.npz", further)
            save_tracks(folder / f"camera_{number}_tracks.npz", seen)
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


def add_all_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--all``."""
    parser.add_argument("--all", action="store_true", help=f"everybody in the picture, {what} in OUT/person_N")


def people_of(args: argparse.Namespace) -> tuple[int, ...] | None:
    """Numbers of ``--subject 1,3``, () of ``--all``; None = one person."""
    from drocap_ros.perception.tracking.pose_estimator_config import parse_people

    if args.all and args.subject:
        raise InputError(f"--all: expected no --subject beside it, found {args.subject}; leave one of them out")
    return () if args.all else parse_people(args.subject) or None


def save_people_tracks(folder: Path, people: Mapping[int, Tracks]) -> None:
    """Write the tracks of each into a folder of its own."""
    from drocap_ros.tracks import save_tracks

    for number, tracks in people.items():
        (folder / f"person_{number}").mkdir()
        save_tracks(folder / f"person_{number}" / "tracks.npz", tracks)


def reconstruct_people(
    args: argparse.Namespace,
    source: Path,
    out: Path,
    config: DrocapConfig,
    telemetry: Telemetry,
    selection: Selection,
    progress: Progress,
) -> str:
    """Reconstruct and write everybody, or the selected people; returns lines about them."""
    from drocap_ros.motion import people_files
    from drocap_ros.people import reconstruct_everybody

    people = reconstruct_everybody(
        source,
        method=args.method,
        config=config,
        models=args.models,
        progress=progress,
        telemetry=telemetry,
        selection=selection,
    )
    motions, video = {}, selection.images or (None if people_files(source, "tracks.npz") else source)
    for number, (motion, _) in people.items():
        meta = {**motion.meta, "command": args.command_line, "input": (video or source).name}
        motions[number] = dataclasses.replace(motion, meta=meta)
    kept = {number: tracks for number, (_, tracks) in people.items()}
    names = _save(out, motions, kept, video, report=not args.no_report)
    lines = [_words(number, motion) for number, motion in motions.items()]
    lines += next(iter(motions.values())).meta["left_out"]
    return "\n".join([*lines, f"written: {out}/{', '.join(names)}"])


def _words(number: int, motion: Motion) -> str:
    from drocap_ros.report.statistics import motion_statistics, scale_of

    s = motion_statistics(motion)
    return (
        f"person {number}: {motion.meta['seen']}; frame {motion.frame}, scale {', '.join(scale_of(motion))}, median"
        f" reprojection error {s.median_px:.1f} px, {s.median_px / s.body_px:.1%} of the body"
    )


def _save(
    out: Path, motions: Mapping[int, Motion], tracks: Mapping[int, Tracks], video: Path | None, *, report: bool
) -> list[str]:
    """Write the folder of each and the report of all; returns the names written.  Files of an older run go."""
    from drocap_ros.cli.atomic_output import output_folder
    from drocap_ros.motion import FILE, save_motion
    from drocap_ros.report.people import save_people_report

    names = [f"person_{number}" for number in motions]
    with output_folder(out) as folder:
        save_people_tracks(folder, tracks)
        for name, motion in zip(names, motions.values(), strict=True):
            save_motion(folder / name / FILE, motion)
        if report:
            save_people_report(folder / "report.html", motions, video=video)
            names.append("report.html")
    for older in (out / FILE, out / "tracks.npz", out / "report.html", *out.glob("person_*/*.npz")):
        if not {older.name, older.parent.name} & set(names):
            older.unlink(missing_ok=True)
            if older.parent != out and not any(older.parent.iterdir()):
                older.parent.rmdir()
    return names
