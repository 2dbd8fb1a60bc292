"""What the commands around a running graph share: place of the graph, its start, and ROS, where it is installed."""

from __future__ import annotations

import argparse
import importlib
import os
from types import ModuleType

from drocap_ros.cli.options import ros_namespace
from drocap_ros.errors import InputError

_VARIABLE = "ROS_DOMAIN_ID"
#: Of the DDS domains: the ports of a larger one belong to Linux.
_LARGEST_DOMAIN = 101
#: Columns of a table in a pipe, which has no width: enough that no name is cut.
PIPE_WIDTH = 180


def add_place_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--namespace`` and ``--domain-id``."""
    parser.add_argument("--namespace", type=ros_namespace, default="/drocap", help="of all topics (default /drocap)")
    parser.add_argument(
        "--domain-id", metavar="N", help=f"DDS domain, 0 to {_LARGEST_DOMAIN} (default: ${_VARIABLE}, else 0)"
    )


def add_start_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that starts nodes."""
    add_place_options(parser)
    parser.add_argument(
        "--one-process", action="store_true", help="all nodes in this process, a thread each: less memory"
    )
    parser.add_argument("--quiet", action="store_true", help="no status line, only errors")


def chosen_domain(args: argparse.Namespace) -> int:
    """The domain that the option or the environment names, else 0."""
    name, value = "--domain-id", args.domain_id
    if value is None:  # an empty variable counts as none, as in ROS
        name, value = _VARIABLE, os.environ.get(_VARIABLE, "").strip() or "0"
    if not (value.isascii() and value.isdigit() and int(value) <= _LARGEST_DOMAIN):
        raise InputError(f"{name}: expected 0 to {_LARGEST_DOMAIN}, got {value}; choose another domain")
    return int(value)


def import_bringup() -> ModuleType:
    """The module that imports ROS, or an InputError where ROS is missing."""
    try:
        return importlib.import_module("drocap_ros.bringup")
    except ImportError as error:
        raise InputError(
            f"expected ROS 2 with drocap_ros's messages, found none ({error}); run `make setup` in a checkout, which"
            " installs both, or see docs/install.md"
        ) from None
