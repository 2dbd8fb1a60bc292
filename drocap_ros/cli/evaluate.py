"""``drocap evaluate``: the camera-motion study, the live method, and one motion against its truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

METHODS = ("ba", "paper", "paper-no-articulation", "initial", "mf-nnm")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "evaluate",
        help="errors of a motion; the camera-motion study",
        description="Measure accuracy: of one motion against its truth, or of every method over MoCap.",
    )
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    pair = kinds.add_parser(
        "pair",
        help="one motion against its truth",
        description="Errors of MOTION: per joint group, world frame, handedness, scale.",
    )
    pair.add_argument("motion", metavar="MOTION", type=Path, help="motion.npz, or the folder that holds it")
    pair.add_argument("truth", metavar="TRUTH", type=Path, help="MoCap .npz or another motion.npz")
    pair.add_argument("--out", metavar="DIR", type=Path, help="also write pair.csv, pair.md and pair.png there")
    pair.set_defaults(run=run)
    rotation = kinds.add_parser(
        "rotation",
        help="error over the speed of the orbit, for every method",
        description="All sequences of at least 5 s in MOCAP_DIR, their first 10 s at 24 fps, seen by a virtual"
        " orthographic camera that orbits the subject.",
    )
    rotation.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    rotation.add_argument(
        "--speeds", metavar="DEG_S", type=float, nargs="+", default=[0.0, 10.0, 25.0, 50.0], help="orbit speeds"
    )
    rotation.add_argument("--noisy", action="store_true", help="10 mm noise and 5 %% gross outliers in the 2D joints")
    rotation.add_argument("--methods", choices=METHODS, nargs="+", default=list(METHODS), help="default: all")
    rotation.add_argument("--limit", metavar="N", type=int, help="only the first N sequences")
    rotation.add_argument("--seed", type=int, default=0, help="seed of the noise (default 0)")
    rotation.add_argument("--processes", metavar="N", type=int, default=1, help="work in N processes (default 1)")
    rotation.add_argument("--out", metavar="DIR", type=Path, help="also write rotation.csv, .md and .png there")
    rotation.add_argument("--quiet", action="store_true", help="no progress, only the tables")
    rotation.set_defaults(run=run)
    live = kinds.add_parser(
        "live",
        help="error of what the live graph publishes, when it does, beside the offline result",
        description="The sequences of MOCAP_DIR as in `evaluate rotation`, image by image through the live method:"
        " the initial and the latest pose when they are published, and the refined pose 2 s after its image.",
    )
    live.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    live.add_argument("--speed", metavar="DEG_S", type=float, default=25.0, help="orbit speed (default 25)")
    live.add_argument("--noisy", action="store_true", help="10 mm noise and 5 %% gross outliers in the 2D joints")
    live.add_argument(
        "--delay", metavar="S", type=float, default=0.5, help="time that an adjustment takes (default 0.5 s)"
    )
    live.add_argument("--config", metavar="FILE", type=Path, help="configuration file with other parameters")
    live.add_argument("--limit", metavar="N", type=int, help="only the first N sequences")
    live.add_argument("--seed", type=int, default=0, help="seed of the noise (default 0)")
    live.add_argument("--out", metavar="DIR", type=Path, help="also write live.csv and live.md there")
    live.add_argument("--quiet", action="store_true", help="no progress, only the tables")
    live.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure, print the Markdown table, and write the files.

    Raises
    ------
    InputError
        When an option or a file cannot be used.
    """
    kinds = {"pair": _pair, "rotation": _rotation, "live": _live}
    return kinds[args.kind](args)


def _pair(args: argparse.Namespace) -> int:
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.compare import compare, load_truth
    from drocap_ros.motion import load_motion

    if args.out is not None:
        check_output_folder(args.out)
    path = args.motion / "motion.npz" if args.motion.is_dir() else args.motion
    errors = compare(load_motion(path), *load_truth(args.truth))
    name = path.parent.name if path.name == "motion.npz" else path.stem
    text = tables.pair_markdown(name, errors)
    print(text, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            tables.save_pair_csv(out / "pair.csv", name, errors)
            (out / "pair.md").write_text(text, encoding="utf-8")
            tables.save_joint_bars(out / "pair.png", {name: errors.per_group_mm})
    return 0


def _rotation(args: argparse.Namespace) -> int:
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.rotation import rotation_study

    if args.out is not None:
        check_output_folder(args.out)
    with progress_bars(args.quiet) as progress:
        rows = rotation_study(
            args.folder,
            speeds_deg_s=args.speeds,
            methods=args.methods,
            noisy=args.noisy,
            seed=args.seed,
            limit=args.limit,
            processes=args.processes,
            progress=progress,
        )
    text = tables.study_markdown(rows)
    print(text, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            tables.save_csv(out / "rotation.csv", rows)
            (out / "rotation.md").write_text(text, encoding="utf-8")
            tables.save_curves(out / "rotation.png", rows)
    return 0


def _live(args: argparse.Namespace) -> int:
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.config import DrocapConfig, load_config
    from drocap_ros.evaluation.live import live_study
    from drocap_ros.evaluation.live_table import live_markdown, save_live_csv

    if args.out is not None:
        check_output_folder(args.out)
    config = DrocapConfig() if args.config is None else load_config(args.config)
    with progress_bars(args.quiet) as progress:
        rows = live_study(
            args.folder,
            speed_deg_s=args.speed,
            noisy=args.noisy,
            delay_s=args.delay,
            seed=args.seed,
            limit=args.limit,
            initializer=config.initializer,
            adjuster=config.bundle_adjuster,
            progress=progress,
        )
    text = live_markdown(rows, args.delay)
    print(text, end="")
    if args.out is not None:
        with output_folder(args.out) as out:
            save_live_csv(out / "live.csv", rows)
            (out / "live.md").write_text(text, encoding="utf-8")
    return 0
