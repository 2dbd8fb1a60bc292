"""The DDS domain of a command: ``--domain-id``, else ``ROS_DOMAIN_ID`` of the environment, else 0."""

from __future__ import annotations

import argparse
import os

from drocap_ros.errors import InputError

_VARIABLE = "ROS_DOMAIN_ID"
_LARGEST = 101


def add_domain_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--domain-id``; :func:`chosen_domain` evaluates it."""
    parser.add_argument("--domain-id", metavar="N", help=f"DDS domain, 0 to {_LARGEST} (default: ${_VARIABLE}, else 0)")


def chosen_domain(args: argparse.Namespace) -> int:
    """The domain that the option or the environment names.

    Raises
    ------
    InputError
        When it is no number from 0 to 101: the ports of a larger one belong to Linux.
    """
    name, value = "--domain-id", args.domain_id
    if value is None:  # an empty variable counts as none, as in ROS
        name, value = _VARIABLE, os.environ.get(_VARIABLE, "").strip() or "0"
    if not (value.isascii() and value.isdigit() and int(value) <= _LARGEST):
        raise InputError(f"{name}: expected 0 to {_LARGEST}, got {value}; choose another domain")
    return int(value)
