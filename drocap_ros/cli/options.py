"""The parser of commands and of batch lists, and the types of options that several commands have."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from drocap_ros.errors import InputError

#: Names of ROS: letters, digits and underscores, none begins with a digit.
_NAMESPACE = re.compile(r"/|/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
#: Every random generator takes it.
_LARGEST_SEED = 2**32 - 1


class LineParser(argparse.ArgumentParser):
    """A parser whose errors are InputErrors; its subcommands' parsers are of this class too."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As of argparse; refuses unknown words, and empty ones: a path of an unset variable is the working directory.

        Raises
        ------
        InputError
            When the words cannot be used.
        """
        words = sys.argv[1:] if args is None else list(args)
        found, unknown = super().parse_known_args(words, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        for before, word in zip([self.prog, *words], words, strict=False):
            if not word or re.fullmatch(r"--[\w-]+=", word):
                self.error(f"expected a value after {word or before}, got an empty one, as of an unset shell variable")
        return found, []

    def error(self, message: str) -> NoReturn:
        """Raise the InputError of a message."""
        raise InputError(f"{message}; see {self.prog} --help")


def add_seed_option(parser: argparse.ArgumentParser, help: str, **options: Any) -> None:
    """Add ``--seed``."""
    parser.add_argument("--seed", type=_seed, default=0, help=f"{help} (default 0)", **options)


def ros_namespace(text: str) -> str:
    """Type of ``--namespace``; the leading slash may be left out."""
    if not _NAMESPACE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected names of letters, digits and _, as /drocap or /a/b, got {text!r}")
    return text if text.startswith("/") else f"/{text}"


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) > _LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"expected an integer from 0 to {_LARGEST_SEED}, got {text}")
    return int(text)
