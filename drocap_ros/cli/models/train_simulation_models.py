"""``drocap train-simulation-models``: the networks that see rendered persons, from the project's own renders."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "train-simulation-models",
        help="train the networks that see the simulated person",
        description="Train the person detector and the 2D pose network of the simulation on the project's own renders."
        " They are for simulation only and know no real person. Needs the extra 'train' (PyTorch, onnx). The time is"
        " a budget, the schedule fits itself to it.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the two ONNX files")
    parser.add_argument("--minutes", type=float, default=40.0, help="time to train for (default 40)")
    parser.add_argument(
        "--steps", type=int, default=0, help="end after this many rounds instead, for the same result from a seed"
    )
    parser.add_argument(
        "--only", choices=("both", "detector", "pose"), default="both", help="which networks to train (default both)"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of renders and first weights (default 0)")
    parser.add_argument("--quiet", action="store_true", help="no progress, only errors")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Train, write, and print what was seen; a checkpoint is written to the same folder every four minutes.

    Raises
    ------
    InputError
        When an option cannot be used.
    """
    from drocap_ros.errors import InputError
    from drocap_ros.training.simulation_models import SimulationTraining, export, set_threads, train

    if not args.out.absolute().parent.is_dir() or args.out.is_file():
        raise InputError(f"--out: expected a folder, or a name in one that exists, got {args.out}")
    if not 1 <= args.threads <= 64:
        raise InputError(f"--threads: expected 1 to 64, got {args.threads}")
    options = SimulationTraining(minutes=args.minutes, steps=args.steps, seed=args.seed, only=args.only)
    set_threads(args.threads)
    length = f"--steps {args.steps}" if args.steps else f"--minutes {args.minutes:g}"
    chosen = "" if args.only == "both" else f" --only {args.only}"

    def save(detector: Any, pose: Any, facts: dict[str, Any]) -> None:
        described = {
            "only_for": "simulation",
            "notice": "trained on this project's own renders, for simulation only, not for pictures of real people",
            "licence": "Apache-2.0",
            "command": f"drocap train-simulation-models {length}{chosen} --seed {args.seed} --out DIR",
            **{name: str(value) for name, value in facts.items()},
        }
        export(detector, pose, args.out, described)

    def show(line: str) -> None:
        if not args.quiet:
            print(line, file=sys.stderr, flush=True)

    detector, pose, facts = train(options, show, save)
    save(detector, pose, facts)
    print(f"{args.out}: {facts['detector_steps']} batches of the detector, {facts['pose_steps']} of the pose network")
    return 0
