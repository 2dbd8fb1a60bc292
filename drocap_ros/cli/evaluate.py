"""``drocap evaluate``: a motion against its truth, the camera-motion study, the motion in the world."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drocap_ros.cli import reconstruct
from drocap_ros.cli.motion_input import HELP, read_motion
from drocap_ros.cli.options import add_seed_option
from drocap_ros.cli.progress import Progress

#: ``live`` needs a recording of the live graph.
METHODS = tuple(method for method in reconstruct.METHODS if method != "live")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "evaluate",
        help="errors of a motion; accuracy studies over MoCap",
        description="Measure accuracy: of one motion against its truth, of every method over MoCap.",
    )
    kinds = parser.add_subparsers(metavar="KIND", required=True)
    comparison = kinds.add_parser(
        "compare",
        aliases=["pair"],
        help="one motion against its truth",
        description="Errors of MOTION: per joint group, world frame, handedness, scale.",
    )
    comparison.add_argument("motion", metavar="MOTION", type=Path, help=HELP)
    comparison.add_argument(
        "truth",
        metavar="TRUTH",
        type=Path,
        help="MoCap .npz, another motion.npz, or a folder with truth.npz or motion.npz",
    )
    comparison.add_argument(
        "--out", metavar="DIR", type=Path, help="also write compare.csv, compare.md and compare.png to DIR"
    )
    comparison.set_defaults(run=_compare)
    rotation = _study_parser(
        kinds,
        "rotation",
        help="error over the speed of the orbit, for every method",
        description="All sequences of at least 5 s in MOCAP_DIR, their first 10 s at 24 fps, seen by a virtual"
        " orthographic camera that orbits the subject.",
        files="rotation.csv, rotation.md and rotation.png",
    )
    rotation.add_argument(
        "--speeds", metavar="DEG_S", type=float, nargs="+", default=[0.0, 10.0, 25.0, 50.0], help="orbit speeds"
    )
    rotation.add_argument("--methods", choices=METHODS, nargs="+", default=list(METHODS), help="default: all")
    rotation.add_argument("--processes", metavar="N", type=int, default=1, help="number of processes (default 1)")
    rotation.set_defaults(run=_rotation)
    world = _study_parser(
        kinds,
        "world",
        help="errors in the world, by a camera whose telemetry errs",
        description="The sequences of at least 8 s in MOCAP_DIR with their root motion, their first 20 s at 24 fps,"
        " seen by a perspective camera that orbits the person, with telemetry of stated errors.",
        files="world.csv and world.md",
        noisy=False,
    )
    world.add_argument("--telemetry", choices=("exact", "rtk", "gps"), default="exact", help="default: exact")
    world.add_argument("--still", action="store_true", help="the camera keeps its bearing from the person")
    world.add_argument("--method", choices=METHODS, default="ba", help="default: ba")
    world.add_argument("--every", metavar="N", type=int, default=1, help="only every N-th sequence")
    world.set_defaults(run=_world)
    return parser


def _study_parser(
    kinds: Any, name: str, help: str, description: str, files: str, noisy: bool = True
) -> argparse.ArgumentParser:
    """Parser of a study, with the options that all studies have."""
    parser: argparse.ArgumentParser = kinds.add_parser(name, help=help, description=description)
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    if noisy:
        parser.add_argument("--noisy", action="store_true", help="10 mm noise and 5 %% gross outliers in the 2D joints")
    parser.add_argument("--limit", metavar="N", type=int, help="only the first N sequences")
    add_seed_option(parser, "seed of the noise")
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"also write {files} to DIR")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the tables")
    return parser


def _study(
    args: argparse.Namespace,
    name: str,
    rows_of: Callable[[Progress], list[Any]],
    record_of: Callable[[Any], Mapping[str, object]],
    markdown: Callable[[list[Any]], str],
    save_picture: Callable[[Path, list[Any]], None] | None = None,
) -> int:
    """Run a study, print its tables and write its files."""
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.evaluation.tables import save_csv

    if args.out is not None:
        check_output_folder(args.out)
    with progress_bars(args.quiet) as progress:
        rows = rows_of(progress)
    text = markdown(rows)
    print(text, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            save_csv(out / f"{name}.csv", [record_of(row) for row in rows])
            (out / f"{name}.md").write_text(text, encoding="utf-8")
            if save_picture is not None:
                save_picture(out / f"{name}.png", rows)
    return 0


def _compare(args: argparse.Namespace) -> int:
    """Compare MOTION with TRUTH, print the table and write the files."""
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.compare import compare, load_truth

    if args.out is not None:
        check_output_folder(args.out)
    path, motion = read_motion(args.motion)
    errors = compare(motion, *load_truth(args.truth))
    name = path.parent.name if path.name == "motion.npz" else path.stem
    text = tables.comparison_markdown(name, errors)
    print(text, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            tables.save_csv(out / "compare.csv", [tables.comparison_record(name, errors)])
            (out / "compare.md").write_text(text, encoding="utf-8")
            tables.save_group_bars(out / "compare.png", errors)
    return 0


def _rotation(args: argparse.Namespace) -> int:
    """The camera-motion study."""
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.rotation import rotation_study

    def rows_of(progress: Progress) -> list[Any]:
        return rotation_study(
            args.folder, speeds_deg_s=args.speeds, methods=args.methods, noisy=args.noisy, seed=args.seed,
            limit=args.limit, processes=args.processes, progress=progress,
        )  # fmt: skip

    return _study(args, "rotation", rows_of, asdict, tables.study_markdown, tables.save_curves)


def _world(args: argparse.Namespace) -> int:
    """The study of the motion in the world."""
    from drocap_ros.evaluation.world import world_markdown, world_study

    def rows_of(progress: Progress) -> list[Any]:
        return world_study(
            args.folder, args.telemetry, still=args.still, seed=args.seed, method=args.method, every=args.every,
            limit=args.limit, progress=progress,
        )  # fmt: skip

    return _study(
        args,
        "world",
        rows_of,
        lambda row: {key: value for key, value in asdict(row).items() if key != "errors"} | asdict(row.errors),
        lambda rows: world_markdown(rows, args.telemetry, args.still),
    )
