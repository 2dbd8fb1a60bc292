"""Several persons at once: ``--all`` and ``--subject 1,3`` of ``drocap track`` and ``drocap reconstruct``."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.clip import Progress
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import Motion
    from drocap_ros.pipeline import Selection
    from drocap_ros.recording.video_telemetry import Telemetry
    from drocap_ros.tracks import Tracks


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
    motions = {}
    for number, (motion, _) in people.items():
        motions[number] = dataclasses.replace(motion, meta={**motion.meta, "command": args.command_line})
    names = _save(out, motions, {number: tracks for number, (_, tracks) in people.items()}, source, args.no_report)
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
    out: Path, motions: Mapping[int, Motion], tracks: Mapping[int, Tracks], source: Path, no_report: bool
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
        if not no_report:
            save_people_report(folder / "report.html", motions, video=source)
            names.append("report.html")
    for older in (out / FILE, out / "tracks.npz", out / "report.html", *out.glob("person_*/*.npz")):
        if not {older.name, older.parent.name} & set(names):
            older.unlink(missing_ok=True)
            if older.parent != out and not any(older.parent.iterdir()):
                older.parent.rmdir()
    return names
