"""Options that choose a part of a recording: seconds, the person, recorded or new 2D poses."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.clip import Clip


def add_clip_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--start``, ``--end`` and ``--subject``."""
    parser.add_argument(
        "--start", metavar="S", type=float, default=0.0, help="seconds from the first image (default 0)"
    )
    parser.add_argument("--end", metavar="S", type=float, default=math.inf, help="likewise (default: the last image)")
    parser.add_argument(
        "--subject",
        metavar="N|RULE",
        default="",
        help="number of a person in the picture of `drocap track --list`; or largest (default), centre, or a box"
        " x_min,y_min,x_max,y_max px in the first image",
    )


def clip_of(args: argparse.Namespace) -> Clip:
    """Clip of the options."""
    from drocap_ros.clip import Clip

    return Clip(args.start, args.end)
