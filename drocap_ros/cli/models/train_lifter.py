"""``drocap train-lifter``: the learned temporal start, from a folder of MoCap files."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "train-lifter",
        help="train the learned temporal start from MoCap",
        description="Train the network that lifts 2D joints to 3D over time, on MoCap seen by virtual cameras. Needs"
        " the extra 'train' (PyTorch, onnx). One core is used; the time is a budget, the schedule fits itself to it.",
    )
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    parser.add_argument("--out", metavar="ONNX", type=Path, required=True, help="network file to write")
    parser.add_argument("--include", metavar="GLOB", default="*", help="only files of this name, e.g. 'cmu_*'")
    parser.add_argument("--minutes", type=float, default=80.0, help="time to train for (default 80)")
    parser.add_argument("--width", type=int, default=240, help="channels of the network (default 240)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of samples and first weights (default 0)")
    parser.add_argument("--quiet", action="store_true", help="no progress, only errors")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Train, write, and print what was seen; a checkpoint is written to the same file every five minutes.

    Raises
    ------
    InputError
        When an option or the folder cannot be used.
    """
    from drocap_ros.errors import InputError
    from drocap_ros.mocap import mocap_files
    from drocap_ros.training.lifter import (
        LifterTraining,
        describe_training,
        export_onnx,
        set_threads,
        train,
    )
    from drocap_ros.training.lifter_samples import load_bank

    if args.out.suffix != ".onnx" or not args.out.absolute().parent.is_dir():
        raise InputError(f"--out: expected an .onnx in a folder that exists, got {args.out}")
    if not 1 <= args.threads <= 64:
        raise InputError(f"--threads: expected 1 to 64, got {args.threads}")
    options = LifterTraining(minutes=args.minutes, width=args.width, seed=args.seed)
    files = mocap_files(args.folder, args.include)
    set_threads(args.threads)
    bank = load_bank(files)

    def save(network: Any, facts: dict[str, Any]) -> None:
        export_onnx(network, args.out, describe_training(files, args.include, options, facts))

    def show(line: str) -> None:
        if not args.quiet:
            print(line, file=sys.stderr, flush=True)

    network, facts = train(bank, options, show, save)
    save(network, facts)
    print(f"{args.out}: {facts['steps']} steps, {facts['frames_seen']} frames seen, {len(files)} MoCap files")
    return 0
