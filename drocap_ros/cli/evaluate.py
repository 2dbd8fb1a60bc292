"""``drocap evaluate``: a motion against its truth, the paper's studies and tables, the motion in the world."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from drocap_ros.cli import reconstruct
from drocap_ros.cli.options import (
    Subparsers,
    add_command,
    add_config_option,
    add_models_option,
    add_motion_argument,
    add_quiet_option,
    add_seed_option,
    read_motion,
)

#: ``live`` needs a recording of the live graph.
METHODS = tuple(method for method in reconstruct.METHODS if method != "live")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's kinds."""
    parser = subparsers.add_parser(
        "evaluate",
        help="errors of a motion; accuracy studies over MoCap",
        description="Measure accuracy: of one motion against its truth, of every method over MoCap.",
    )
    kinds = parser.add_subparsers(metavar="KIND", required=True)
    _add_compare(kinds)
    _add_rotation(kinds)
    _add_world(kinds)
    _add_table(kinds)


def _add_compare(kinds: Subparsers) -> None:
    parser = kinds.add_parser(
        "compare",
        aliases=["pair"],
        help="one motion against its truth",
        description="Errors of MOTION: per joint group, world frame, handedness, scale.",
    )
    add_motion_argument(parser)
    truth = "MoCap .npz, .c3d, .trc or .bvh, another motion.npz, or a folder with truth.npz (or .c3d ...) or motion.npz"
    parser.add_argument("truth", metavar="TRUTH", type=Path, help=truth)
    _add_out(parser, "compare.csv, compare.md and compare.png")
    parser.set_defaults(run=_compare)


def _add_rotation(kinds: Subparsers) -> None:
    parser = add_command(
        kinds,
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


def _add_world(kinds: Subparsers) -> None:
    parser = add_command(
        kinds,
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


def _add_table(kinds: Subparsers) -> None:
    parser = add_command(
        kinds,
        "table",
        _table,
        help="the paper's tables from a folder of recordings with truth",
        description="Every method on each recording with truth in DIR: a folder with truth.npz (.c3d, .trc, .bvh) and"
        " tracks.npz, session or one other input; or NAME.mp4 (.npz, ...) beside NAME_truth.npz (...).",
    )
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder of recordings with truth")
    parser.add_argument("--methods", choices=METHODS, nargs="+", help="default: the paper's rows, and ba")
    add_models_option(parser)
    add_config_option(parser)
    add_quiet_option(parser, "no progress, only the tables")
    _add_out(parser, "table.csv and table.md")


def _add_study_options(parser: argparse.ArgumentParser, files: str) -> None:
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    parser.add_argument("--limit", metavar="N", type=int, help="only the first N sequences")
    add_seed_option(parser, "seed of the noise")
    add_quiet_option(parser, "no progress, only the tables")
    _add_out(parser, files)


def _add_out(parser: argparse.ArgumentParser, files: str) -> None:
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"also write {files} to DIR")


def _compare(args: argparse.Namespace) -> int:
    """Compare MOTION with TRUTH."""
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.compare import compare, load_truth

    _check_out(args)
    path, motion = read_motion(args.motion)
    errors = compare(motion, *load_truth(args.truth))
    name = path.parent.name if path.name == "motion.npz" else path.stem
    record = {"motion": name, **tables.errors_record(errors)}
    words = tables.comparison_markdown(name, errors)
    return _finish(args, "compare", [record], words, lambda file: tables.save_group_bars(file, errors))


def _rotation(args: argparse.Namespace) -> int:
    """The camera-motion study."""
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.protocol import protocol_sequences
    from drocap_ros.evaluation.rotation import rotation_study

    _check_out(args)
    names = ("methods", "noisy", "seed", "processes")
    with progress_bars(args.quiet) as progress:
        sequences = protocol_sequences(args.folder, limit=args.limit)
        options = {name: getattr(args, name) for name in names}
        rows = rotation_study(sequences, speeds_deg_s=args.speeds, progress=progress, **options)
    records, words = [tables.study_record(row) for row in rows], tables.rotation_markdown(rows)
    return _finish(args, "rotation", records, words, lambda file: tables.save_curves(file, rows))


def _world(args: argparse.Namespace) -> int:
    """The study of the motion in the world."""
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.evaluation.tables import study_record, world_markdown
    from drocap_ros.evaluation.world import world_study
    from drocap_ros.evaluation.world_protocol import WorldCase, world_sequences

    _check_out(args)
    case = WorldCase(args.telemetry, args.still, args.reverse, args.background)
    with progress_bars(args.quiet) as progress:
        sequences = world_sequences(args.folder, args.every, args.limit)
        rows = world_study(sequences, case, seed=args.seed, method=args.method, progress=progress)
    return _finish(args, "world", [study_record(row) for row in rows], world_markdown(rows, case))


def _table(args: argparse.Namespace) -> int:
    """The paper's tables over recordings with truth."""
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.config import load_config
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.recordings import PAPER_METHODS, find_recordings, recordings_table

    _check_out(args)
    recordings, config = find_recordings(args.folder), load_config(args.config)
    with progress_bars(args.quiet) as progress:
        rows = recordings_table(recordings, args.methods or PAPER_METHODS, config, args.models, progress)
    return _finish(args, "table", [tables.study_record(row) for row in rows], tables.recordings_markdown(rows))


def _check_out(args: argparse.Namespace) -> None:
    """Refuse an unusable folder before the work."""
    from drocap_ros.cli.atomic_output import check_output_folder

    if args.out is not None:
        check_output_folder(args.out)


def _finish(
    args: argparse.Namespace,
    name: str,
    records: Sequence[Mapping[str, object]],
    markdown: str,
    draw: Callable[[Path], None] | None = None,
) -> int:
    """Print the tables and write the files."""
    from drocap_ros.cli.atomic_output import output_folder
    from drocap_ros.evaluation.tables import save_csv

    print(markdown, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            save_csv(out / f"{name}.csv", records)
            (out / f"{name}.md").write_text(markdown, encoding="utf-8")
            if draw is not None:
                draw(out / f"{name}.png")
    return 0
