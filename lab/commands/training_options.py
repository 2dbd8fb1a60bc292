"""Options and output that the training commands share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

from drocap_ros.cli.options import add_seed_option
from drocap_ros.errors import InputError, ParameterError
from drocap_ros.parameters import Parameters

P = TypeVar("P", bound=Parameters)


def add_training_options(parser: argparse.ArgumentParser, minutes: float) -> None:
    """Add ``--minutes``, ``--threads``, ``--seed`` and ``--quiet``."""
    parser.add_argument("--minutes", type=float, default=minutes, help=f"training time (default {minutes:g})")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default 1)")
    add_seed_option(parser, "seed of samples and initial weights")
    parser.add_argument("--quiet", action="store_true", help="no progress, only errors")


def training_parameters(kind: type[P], args: argparse.Namespace) -> P:
    """Parameters by the options of the same names.

    Raises
    ------
    InputError
        When an option is out of range.
    """
    try:
        return kind(**{field.name: getattr(args, field.name) for field in fields(kind) if hasattr(args, field.name)})
    except ParameterError as error:
        name, _, reason = str(error).removeprefix(f"{kind.__name__}.").partition(":")
        raise InputError(f"--{name.replace('_', '-')}:{reason}") from None


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
    from lab.training.torch_extra import set_threads

    set_threads(count)


def progress_lines(quiet: bool) -> Callable[[str], None]:
    """A function that prints a line to stderr, unless ``quiet``."""
    return lambda line: None if quiet else print(line, file=sys.stderr, flush=True)
