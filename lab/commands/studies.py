"""``python -m lab rotation`` and ``world``: the paper's camera-motion study and the motion in the world, over MoCap."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.evaluate import METHODS, add_out, check_out, finish
from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option, add_seed_option
from drocap_ros.cli.running import progress_bars


def add_parser(subparsers: Subparsers) -> None:
    """Add both commands."""
    _add_rotation(subparsers)
    _add_world(subparsers)


def _add_rotation(subparsers: Subparsers) -> None:
    parser = add_command(
        subparsers,
        "rotation",
        _rotation,
        help="error over the speed of the orbit, for every method",
        description="All sequences of at least 5 s in MOCAP_DIR, their first 10 s at 24 fps, seen by a virtual"
        " orthographic camera that orbits the subject.",
    )
    _add_study_options(parser, "rotation.csv, rotation.md and rotation.png")
    parser.add_argument(
        "--speeds", metavar="DEG_S", type=float, nargs="+", default=[0.0, 10.0, 25.0, 50.0], help="orbit speeds"
    )
    parser.add_argument("--noisy", action="store_true", help="10 mm noise and 5 %% gross outliers in the 2D joints")
    parser.add_argument("--methods", choices=METHODS, nargs="+", default=list(METHODS), help="default: all")
    parser.add_argument("--processes", metavar="N", type=int, default=1, help="number of processes (default 1)")


def _add_world(subparsers: Subparsers) -> None:
    parser = add_command(
        subparsers,
        "world",
        _world,
        help="errors in the world, by a camera whose telemetry errs",
        description="The sequences of at least 8 s in MOCAP_DIR with their root motion, their first 20 s at 24 fps,"
        " seen by a perspective camera that orbits the person, with telemetry of stated errors.",
    )
    _add_study_options(parser, "world.csv and world.md")
    levels = ("none", "exact", "rtk", "gps")
    parser.add_argument("--telemetry", choices=levels, default="exact", help="default: exact")
    parser.add_argument("--background", action="store_true", help="the tracks hold fixed points of the scene")
    parser.add_argument(
        "--reverse", metavar="S", type=float, default=0.0, help="the orbit turns back every S seconds (default: never)"
    )
    parser.add_argument("--still", action="store_true", help="the camera keeps its bearing from the person")
    parser.add_argument("--method", choices=METHODS, default="ba", help="default: ba")
    parser.add_argument("--every", metavar="N", type=int, default=1, help="only every N-th sequence")


def _add_study_options(parser: argparse.ArgumentParser, files: str) -> None:
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    parser.add_argument("--limit", metavar="N", type=int, help="only the first N sequences")
    add_seed_option(parser, "seed of the noise")
    add_quiet_option(parser, "no progress, only the tables")
    add_out(parser, files)


def _rotation(args: argparse.Namespace) -> int:
    """The camera-motion study."""
    from drocap_ros.evaluation.tables import study_record
    from lab.studies.protocol import protocol_sequences
    from lab.studies.rotation import rotation_markdown, rotation_study, save_curves

    check_out(args)
    names = ("methods", "noisy", "seed", "processes")
    with progress_bars(args.quiet) as progress:
        sequences = protocol_sequences(args.folder, limit=args.limit)
        options = {name: getattr(args, name) for name in names}
        rows = rotation_study(sequences, speeds_deg_s=args.speeds, progress=progress, **options)
    records = [study_record(row) for row in rows]
    return finish(args, "rotation", records, rotation_markdown(rows), lambda file: save_curves(file, rows))


def _world(args: argparse.Namespace) -> int:
    """The study of the motion in the world."""
    from drocap_ros.evaluation.tables import study_record
    from lab.studies.world import world_markdown, world_study
    from lab.studies.world_protocol import WorldCase, world_sequences

    check_out(args)
    case = WorldCase(args.telemetry, args.still, args.reverse, args.background)
    with progress_bars(args.quiet) as progress:
        sequences = world_sequences(args.folder, args.every, args.limit)
        rows = world_study(sequences, case, seed=args.seed, method=args.method, progress=progress)
    return finish(args, "world", [study_record(row) for row in rows], world_markdown(rows, case))
