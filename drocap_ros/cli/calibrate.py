"""``drocap calibrate``: a camera's lens from a video of a chessboard."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option
from drocap_ros.errors import InputError

#: Error (px of a picture 1280 wide) and covered share of the picture beyond which the command says what to do better.
_POOR_PX, _POOR_COVERED = 1.0, 0.5


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "calibrate",
        run,
        help="a camera's lens from a video of a chessboard",
        description="Find focal lengths, centre and distortion of a camera from a video or a folder of pictures of a"
        " chessboard, and write them as a file for --calibration and calibration_file (docs/hardware.md).",
    )
    parser.add_argument("input", metavar="INPUT", type=Path, help="video, or folder of pictures, of the board")
    parser.add_argument(
        "--corners", metavar="CxR", default="9x6", help="inner corners, columns x rows (default: 9x6, of 10x7 squares)"
    )
    parser.add_argument("--out", metavar="FILE", type=Path, default=Path("camera.yaml"), help="default: camera.yaml")
    add_quiet_option(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate and write."""
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.perception.chessboard import calibrate
    from drocap_ros.perception.sources import open_source
    from drocap_ros.perception.sources.base import ImageIngestConfig

    words = args.corners.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and 3 <= int(word) <= 50 for word in words):
        raise InputError(f"--corners: expected columns x rows of inner corners, as 9x6, got {args.corners}; count them")
    with output_file(args.out, inputs=[args.input]) as file:
        source = open_source(str(args.input), ImageIngestConfig())
        try:
            # Time (s) between two pictures of a film that are looked at: the board has moved meanwhile.
            found = calibrate(source, (int(words[0]), int(words[1])), 0.0 if args.input.is_dir() else 0.3)
        except InputError as error:
            raise InputError(f"{args.input}: {error}") from None
        finally:
            source.close()
        file.write_text(found.camera.yaml(args.input.stem), encoding="utf-8")
    if not args.quiet:
        camera = found.camera
        print(
            f"written: {args.out} ({camera.width}x{camera.height}, focal length {camera.matrix[0, 0]:.1f} px +-"
            f" {found.focal_std:.2%}, {found.views} views of {found.seen}, {found.residual_px:.2f} px)"
        )
        if found.residual_px * 1280 > _POOR_PX * camera.width:
            print("corners err by more than a pixel: hold the board still, keep it flat, lock the focus, and repeat")
        if found.covered < _POOR_COVERED:
            print(f"corners cover {found.covered:.0%} of the picture: show the board near its edges too")
    return 0
