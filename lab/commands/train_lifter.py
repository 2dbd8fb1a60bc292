"""``python -m lab train-lifter``: train the temporal lifter on a folder of MoCap files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lab.commands.training_options import (
    add_training_options,
    progress_lines,
    training_parameters,
    use_threads,
)


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "train-lifter",
        help="train the temporal lifter on MoCap",
        description="Train the network that lifts 2D joints to 3D over time, on MoCap in virtual cameras. Needs the"
        " extra 'train' (PyTorch, onnx); uses a GPU where there is one. The learning rate follows the share of"
        " --minutes, or of --steps, that has passed.",
    )
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    parser.add_argument("--out", metavar="ONNX", type=Path, required=True, help="network file to write")
    parser.add_argument("--include", metavar="GLOB", default="*", help="only files of this name, e.g. 'cmu_*'")
    parser.add_argument(
        "--steps",
        type=int,
        default=0,
        help="batches instead of --minutes: the same seed and threads give the same weights",
    )
    parser.add_argument("--width", type=int, default=336, help="channels of the network (default 336)")
    parser.add_argument("--frames-per-batch", type=int, default=4800, help="frames of a batch (default 4800)")
    parser.add_argument(
        "--steps-per-batch",
        type=int,
        default=1,
        help="uses of each batch, where a GPU waits for samples (default 1)",
    )
    parser.add_argument("--workers", type=int, default=1, help="processes that draw samples (default 1)")
    add_training_options(parser, minutes=80.0)
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Train and write the network; a checkpoint is written to the same file every five minutes.

    Raises
    ------
    InputError
        When an option or the folder is invalid.
    """
    from drocap_ros.cli.atomic_output import check_output_file, output_file
    from drocap_ros.errors import InputError
    from lab.studies.protocol import mocap_files
    from lab.training.lifter import LifterTraining, describe_training, export_onnx, train
    from lab.training.mocap_bank import load_bank
    from lab.training.torch_extra import onnx_package

    if args.out.suffix != ".onnx" or not args.out.absolute().parent.is_dir():
        raise InputError(f"--out: expected an .onnx in a folder that exists, got {args.out}")
    check_output_file(args.out)
    use_threads(args.threads)
    onnx_package()
    options = training_parameters(LifterTraining, args)
    files = mocap_files(args.folder, args.include)
    bank = load_bank(files)
    description = describe_training(files, args.include, options)

    def save(network: Any, facts: dict[str, Any]) -> None:
        counts = {name: str(value) for name, value in facts.items()}
        with output_file(args.out) as file:
            export_onnx(network, file, description | counts)

    network, facts = train(bank, options, progress_lines(args.quiet), save)
    save(network, facts)
    if not args.quiet:
        print(f"{args.out}: {facts['steps']} steps, {facts['frames_seen']} frames, {len(files)} MoCap files")
    return 0
