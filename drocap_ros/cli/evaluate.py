"""``drocap evaluate``: a motion against its truth, and the paper's tables over recordings with truth."""

from __future__ import annotations

import argparse
import math
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
    read_motion,
)

#: ``live`` needs a recording of the live graph.
METHODS = tuple(method for method in reconstruct.METHODS if method != "live")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's kinds."""
    parser = subparsers.add_parser(
        "evaluate",
        help="errors of a motion; the paper's tables",
        description="Measure accuracy: of one motion against its truth, of every method on recordings with truth.",
    )
    kinds = parser.add_subparsers(metavar="KIND", required=True)
    _add_compare(kinds)
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
    parser.add_argument(
        "--time-offset",
        metavar="S|find",
        type=_offset,
        help="seconds from the truth's first frame to the motion's; find: by the poses (default: by the clocks of both,"
        " where their times overlap, else find)",
    )
    add_out(parser, "compare.csv, compare.md and compare.png")
    parser.set_defaults(run=_compare)


def _offset(text: str) -> float:
    """Type of ``--time-offset``; NaN is to be found."""
    try:
        if text == "find" or math.isfinite(float(text)):
            return math.nan if text == "find" else float(text)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"expected seconds or find, got {text}")


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
    add_out(parser, "table.csv and table.md")


def add_out(parser: argparse.ArgumentParser, files: str) -> None:
    """Add ``--out``."""
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"also write {files} to DIR")


def _compare(args: argparse.Namespace) -> int:
    """Compare MOTION with TRUTH."""
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.compare import compare, load_truth

    check_out(args)
    path, motion = read_motion(args.motion)
    errors = compare(motion, *load_truth(args.truth), offset_s=args.time_offset)
    name = path.parent.name if path.name == "motion.npz" else path.stem
    record = {"motion": name, **tables.errors_record(errors)}
    words = tables.comparison_markdown(name, errors)
    return finish(args, "compare", [record], words, lambda file: tables.save_group_bars(file, errors))


def _table(args: argparse.Namespace) -> int:
    """The paper's tables over recordings with truth."""
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.config import load_config
    from drocap_ros.evaluation import tables
    from drocap_ros.evaluation.tables import PAPER_METHODS, find_recordings, recordings_table

    check_out(args)
    recordings, config = find_recordings(args.folder), load_config(args.config)
    with progress_bars(args.quiet) as progress:
        rows = recordings_table(recordings, args.methods or PAPER_METHODS, config, args.models, progress)
    return finish(args, "table", [tables.study_record(row) for row in rows], tables.recordings_markdown(rows))


def check_out(args: argparse.Namespace) -> None:
    """Refuse an unusable folder before the work."""
    from drocap_ros.cli.atomic_output import check_output_folder

    if args.out is not None:
        check_output_folder(args.out)


def finish(
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
