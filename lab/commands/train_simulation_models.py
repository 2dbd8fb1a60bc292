"""``python -m lab train-simulation-models``: train the simulation's networks on rendered images."""

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
        "train-simulation-models",
        help="train the networks for the simulated person",
        description="Train the simulation's person detector and 2D pose network on rendered images. They are for"
        " simulation only, not for real people. Needs the extra 'train' (PyTorch, onnx). The learning rate follows the"
        " share of --minutes, or of --steps, that has passed.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the two ONNX files")
    parser.add_argument(
        "--steps", type=int, default=0, help="number of rounds instead of --minutes; reproducible from the seed"
    )
    parser.add_argument(
        "--only", choices=("both", "detector", "pose"), default="both", help="networks to train (default both)"
    )
    add_training_options(parser, minutes=40.0)
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Train and write the networks; a checkpoint is written to the same folder every four minutes.

    Raises
    ------
    InputError
        When an option is invalid.
    """
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.errors import InputError
    from lab.training.simulation_models import SimulationTraining, export, train
    from lab.training.torch_extra import onnx_package

    if not args.out.absolute().parent.is_dir() or args.out.is_file():
        raise InputError(f"--out: expected a folder, or a name in one that exists, got {args.out}")
    options = training_parameters(SimulationTraining, args)
    check_output_folder(args.out)
    use_threads(args.threads)
    onnx_package()
    length = f"--steps {args.steps}" if args.steps else f"--minutes {args.minutes:g}"
    chosen = "" if args.only == "both" else f" --only {args.only}"

    def save(detector: Any, pose: Any, facts: dict[str, Any]) -> None:
        described = {
            "only_for": "simulation",
            "notice": "trained on this project's own renders, for simulation only, not for pictures of real people",
            "licence": "Apache-2.0",
            "command": f"python -m lab train-simulation-models {length}{chosen} --seed {args.seed} --out DIR",
            **{name: str(value) for name, value in facts.items()},
        }
        with output_folder(args.out) as folder:
            export(detector, pose, folder, described)

    detector, pose, facts = train(options, progress_lines(args.quiet), save)
    save(detector, pose, facts)
    if not args.quiet:
        batches = f"{facts['detector_steps']} batches of the detector, {facts['pose_steps']} of the pose network"
        print(f"{args.out}: {batches}")
    return 0
