"""``drocap sample``: a real clip and networks from the package registry, reconstructed."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from drocap_ros.cli import reconstruct
from drocap_ros.cli.models import fetch_models
from drocap_ros.cli.options import LineParser, Subparsers, add_command, add_quiet_option
from drocap_ros.errors import DrocapError
from drocap_ros.perception.models.fetch import Package, fetch_member, known_model

#: The demo video of Sports2D (David Pagnon and others).
CLIP = Package("sports2d==0.8.34", "733b6db70742636ae9c35d870c22bd416582f579abd5881bee93a14bb0e2655d")
_NETWORKS = ("blazepose-detector", "blazepose-full")
_VIDEO, _LICENCE = "Sports2D/Demo/demo.mp4", "demo video of Sports2D, BSD-3-Clause"
#: A woman who walks through the picture: her seconds, and her box in the first image of them, px.
_WALK = ("--start", "2.8", "--end", "6.5", "--subject", "1100,520,1290,940")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "sample",
        run,
        help="a real clip and networks from PyPI, reconstructed",
        description="Fetch a clip of a walking person and the networks BlazePose from packages of PyPI (45 MB, sums"
        " checked), reconstruct the clip and write its report. The networks serve your own videos too.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("sample"), help="folder (default: sample)")
    add_quiet_option(parser)


def run(args: argparse.Namespace) -> int:
    """Fetch and reconstruct."""
    from drocap_ros.cli.atomic_output import check_output_folder

    check_output_folder(args.out)
    video, models = args.out / "sample.mp4", args.out / "models"
    networks = [model for name in _NETWORKS if (model := known_model(name))]
    if errors := fetch_models(networks, models, quiet=args.quiet):
        raise DrocapError("; ".join(errors))
    if not video.is_file():
        fetch_member(CLIP, _VIDEO, video)
    parser: argparse.ArgumentParser = LineParser(prog="drocap")
    reconstruct.add_parser(parser.add_subparsers())
    words = ["reconstruct", str(video), *_WALK, "--models", str(models), "--out", str(args.out)]
    chosen = parser.parse_args([*words, *(["--quiet"] if args.quiet else [])])
    chosen.command_line = shlex.join(["drocap", *words])
    if not args.quiet:
        print(f"{video}: {_LICENCE}; from {CLIP.pin}")
        print(f"{chosen.command_line}  # with --models {models}, any video of yours", flush=True)
    return reconstruct.run(chosen)
