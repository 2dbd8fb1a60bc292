"""``python -m lab learn-dictionary``: learn a pose dictionary from a folder of MoCap files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option, add_seed_option
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.reconstruction.paper.dictionary import Dictionary


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "learn-dictionary",
        run,
        help="learn a pose dictionary from MoCap",
        description="Learn a sparse pose dictionary from the MoCap .npz files of a folder.",
    )
    parser.add_argument("folder", metavar="MOCAP_DIR", type=Path, help="folder of MoCap .npz files")
    parser.add_argument("--out", metavar="NPZ", type=Path, required=True, help="dictionary file to write")
    parser.add_argument("--atoms", type=int, default=128, help="size of the dictionary (default 128)")
    parser.add_argument(
        "--sparsity", type=float, default=0.03, help="weight of the L1 norm in metres; larger = sparser (default 0.03)"
    )
    parser.add_argument("--include", metavar="GLOB", default="*", help="only files of this name, e.g. 'cmu_*'")
    parser.add_argument("--every", type=int, default=3, help="take every n-th frame (default 3)")
    add_seed_option(parser, "seed of the batches")
    add_quiet_option(parser, "no output, only errors")


def run(args: argparse.Namespace) -> int:
    """Learn and write the dictionary, print its quality."""
    from drocap_ros.cli.atomic_output import output_file
    from lab.training.dictionary import save_dictionary

    for name, low, high in (("atoms", 8, 4096), ("every", 1, 1000)):
        if not low <= getattr(args, name) <= high:
            raise InputError(f"--{name}: expected {low} to {high}, got {getattr(args, name)}")
    if not 0.0 < args.sparsity <= 10.0:
        raise InputError(f"--sparsity: expected more than 0 up to 10, got {args.sparsity:g}")
    if args.out.suffix != ".npz" or not args.out.absolute().parent.is_dir():
        raise InputError(f"--out: expected a .npz in a folder that exists, got {args.out}")
    with output_file(args.out) as file:
        dictionary = learn_from_folder(args)
        save_dictionary(file, dictionary)
    if not args.quiet:
        m = dictionary.metadata
        print(f"{args.out}: {args.atoms} atoms from {m['poses']} poses of {m['files']} files")
        print(f"reconstruction error {m['reconstruction_error_mm']:.1f} mm, {m['mean_active_atoms']:.1f} active atoms")
    return 0


def learn_from_folder(args: argparse.Namespace) -> Dictionary:
    """Dictionary from every n-th frame of the files of a MoCap folder whose names match ``--include``."""
    import numpy as np

    from drocap_ros.cli.running import progress_bars
    from drocap_ros.evaluation.truth_files import load_mocap
    from drocap_ros.reconstruction.common.engine import blas_threads
    from drocap_ros.reconstruction.paper.dictionary import normalize_poses
    from drocap_ros.tracks import read_npz
    from lab.studies.protocol import mocap_files
    from lab.training.dictionary import Learning, learn

    files = mocap_files(args.folder, args.include)
    poses, frames, stated = [], 0, []
    for path in files:
        take, arrays = load_mocap(path)[0], read_npz(path, ()) if path.suffix == ".npz" else {}
        poses.append(normalize_poses(take[:: args.every]))
        frames += len(take)
        stated.append({name: str(arrays[name]) for name in ("licence", "source") if name in arrays})
    metadata = {
        "files": len(files),
        "frames": frames,
        "include": args.include,
        "every": args.every,
        "licence": sorted({facts["licence"] for facts in stated if "licence" in facts}),
        "origin": sorted({facts["source"] for facts in stated if "source" in facts}),
        "command": f"python -m lab learn-dictionary MOCAP_DIR --out NPZ --include '{args.include}' --every {args.every}"
        f" --atoms {args.atoms} --sparsity {args.sparsity:g} --seed {args.seed}",
    }
    with progress_bars(args.quiet) as show, blas_threads(1):
        how = Learning(args.atoms, args.sparsity, seed=args.seed)
        return learn(np.concatenate(poses), how, metadata, lambda done: show("learning", done))
