"""The parser of commands and of batch lists, and what several commands share: options, MOTION, tables."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from drocap_ros.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from drocap_ros.clip import Clip
    from drocap_ros.motion import Motion

#: Names of ROS: letters, digits and underscores, none begins with a digit.
_NAMESPACE = re.compile(r"/|/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
#: Every random generator takes it.
_LARGEST_SEED = 2**32 - 1
_MOST_THREADS = 256  # as of the networks' own parameter

#: Where a command adds its parser.
Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


class LineParser(argparse.ArgumentParser):
    """A parser whose errors are InputErrors; its subcommands' parsers are of this class too."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As of argparse; refuses unknown words and empty ones: the path of an unset variable is this directory."""
        words = sys.argv[1:] if args is None else list(args)
        try:
            found, unknown = super().parse_known_args(words, namespace)
        except InputError as error:
            dashed = next((word for word in words if word[:1] == "-" and Path(word).exists()), None)
            if dashed and f"./{dashed}" not in str(error):
                raise InputError(f"{error}; the file {dashed} is named ./{dashed}") from None
            raise
        if unknown:
            alike = did_you_mean(unknown[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{alike}")
        for before, word in zip([self.prog, *words], words, strict=False):
            if not word or re.fullmatch(r"--[\w-]+=", word):
                self.error(f"expected a value after {word or before}, got an empty one, as of an unset shell variable")
        return found, []

    def _check_value(self, action: argparse.Action, value: str) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(str(value), map(str, action.choices or ()))
            raise

    def error(self, message: str) -> NoReturn:
        """Raise the InputError of a message."""
        raise InputError(f"{message}; see {self.prog} --help")


def add_command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int], *, help: str, description: str
) -> argparse.ArgumentParser:
    """Parser of a command with its action."""
    parser = subparsers.add_parser(name, help=help, description=description)
    parser.set_defaults(run=run)
    return parser


def add_quiet_option(parser: argparse.ArgumentParser, help: str = "no progress, only errors") -> None:
    """Add ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help=help)


def add_config_option(parser: argparse.ArgumentParser, *, required: bool = False) -> None:
    """Add ``--config``."""
    words = "parameters of the components (YAML)"
    parser.add_argument("--config", metavar="FILE", type=Path, required=required, help=words)


def add_models_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--models``."""
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder of networks (default: $DROCAP_MODELS)")


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--models``, ``--feet`` and ``--fetch``."""
    add_models_option(parser)
    parser.add_argument(
        "--feet",
        metavar="NAME",
        help="second network of that folder for toes, heels and depth, as blazepose-full (default: as configured)",
    )
    parser.add_argument(
        "--fetch", action="store_true", help="download the default networks first where the folder of models has none"
    )


def add_threads_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--threads``."""
    words = "threads that share the work on the images; the results are the same (default: 2, or 1 on one processor)"
    parser.add_argument("--threads", metavar="N", type=threads, default=min(2, os.cpu_count() or 1), help=words)


def threads(text: str) -> int:
    """Type of ``--threads``."""
    if not text.isdecimal() or not 1 <= int(text) <= _MOST_THREADS:
        raise argparse.ArgumentTypeError(f"expected 1 to {_MOST_THREADS} threads, got {text}")
    return int(text)


def add_seed_option(parser: argparse.ArgumentParser, help: str, metavar: str | None = None) -> None:
    """Add ``--seed``."""
    parser.add_argument("--seed", type=_seed, default=0, help=f"{help} (default 0)", metavar=metavar)


def ros_namespace(text: str) -> str:
    """Type of ``--namespace``; the leading slash may be left out."""
    if not _NAMESPACE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected names of letters, digits and _, as /drocap or /a/b, got {text!r}")
    return text if text.startswith("/") else f"/{text}"


def rate(text: str) -> float:
    """Type of ``--rate``: images per second."""
    try:
        if 0.1 <= (value := float(text)) <= 10_000.0:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"expected images per second from 0.1 to 10000, got {text}")


def image_size(text: str) -> tuple[int, int]:
    """Type of ``--image-size``: width and height px."""
    if not (found := re.fullmatch(r"([1-9]\d{1,4})[x,]([1-9]\d{1,4})", text)):
        raise argparse.ArgumentTypeError(f"expected width and height in px, as 1920x1080, got {text}")
    return int(found[1]), int(found[2])


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) > _LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"expected an integer from 0 to {_LARGEST_SEED}, got {text}")
    return int(text)


def add_clip_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--start``, ``--end``, ``--subject`` and ``--topic``."""
    first = "seconds from the first image (default 0)"
    parser.add_argument("--start", metavar="S", type=float, default=0.0, help=first)
    parser.add_argument("--end", metavar="S", type=float, default=math.inf, help="likewise (default: the last image)")
    parser.add_argument(
        "--subject",
        metavar="N|RULE",
        default="",
        help="number of a person in the picture of `drocap track --list`, or in a file of keypoints by the frames that"
        " show him, or several, as 1,3; or largest (default),"
        " centre, or a box x_min,y_min,x_max,y_max px in the first image",
    )
    parser.add_argument(
        "--topic",
        metavar="NAME",
        default="",
        help="topic of the images of a recording (default: colour before grey), or number of a video's track (default:"
        " the largest)",
    )


def clip_of(args: argparse.Namespace) -> Clip:
    """Clip of ``--start`` and ``--end``."""
    from drocap_ros.clip import Clip

    return Clip(args.start, args.end)


def add_motion_argument(parser: argparse.ArgumentParser) -> None:
    """Add MOTION: a motion file, or its folder."""
    parser.add_argument("motion", metavar="MOTION", type=Path, help="motion.npz, or its folder")


def read_motion(argument: Path) -> tuple[Path, Motion]:
    """Path and content of the motion file of MOTION."""
    from drocap_ros.motion import load_motion, motion_file

    path = motion_file(argument)
    return path, load_motion(path)


def table_lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of a table whose first row is its head, columns aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
