"""Options and output that the training commands share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from drocap_ros.cli.options import add_seed_option
from drocap_ros.errors import InputError


def add_training_options(parser: argparse.ArgumentParser, minutes: float) -> None:
    """Add ``--minutes``, ``--threads``, ``--seed`` and ``--quiet``."""
    parser.add_argument("--minutes", type=float, default=minutes, help=f"training time (default {minutes:g})")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default 1)")
    add_seed_option(parser, "seed of samples and initial weights")
    parser.add_argument("--quiet", action="store_true", help="no progress, only errors")


def use_threads(count: int) -> None:
    """Set the threads of the libraries.

    Raises
    ------
    InputError
        When the count is out of range.
    DrocapError
        When PyTorch is not installed.
    """
    if not 1 <= count <= 64:
        raise InputError(f"--threads: expected 1 to 64, got {count}")
    from drocap_ros.training.torch_extra import set_threads

    set_threads(count)


def progress_lines(quiet: bool) -> Callable[[str], None]:
    """A function that prints a line to stderr, unless ``quiet``."""
    return lambda line: None if quiet else print(line, file=sys.stderr, flush=True)
