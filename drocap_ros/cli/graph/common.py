"""What the commands around a running graph share: place of the graph, its start, and ROS, where it is installed."""

from __future__ import annotations

import argparse
import importlib
import importlib.machinery
import os
import sys
from pathlib import Path
from types import ModuleType

from drocap_ros.cli.options import ros_namespace
from drocap_ros.errors import InputError

_VARIABLE, _MIDDLEWARE = "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION"
#: The middleware that ROS's wheels are built for.
_OF_WHEELS = "rmw_fastrtps_cpp"
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
    """The module that imports ROS, or an InputError where ROS is missing or another one is in the way."""
    _check_middleware()
    try:
        return importlib.import_module("drocap_ros.bringup")
    except ImportError as error:
        spec = importlib.machinery.PathFinder.find_spec("rclpy")
        folder = str(Path(spec.origin).parent.parent) if spec is not None and spec.origin else ""
        if folder in map(os.path.abspath, filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))):
            raise InputError(
                f"PYTHONPATH: expected ROS 2 of this Python, found another one in {folder};"
                " unset PYTHONPATH, or use a shell in which no other ROS is sourced"
            ) from None
        raise InputError(
            f"expected ROS 2 with drocap_ros's messages, found none ({error}); run `make setup` in a checkout, which"
            " installs both, or see docs/install.md"
        ) from None


def _check_middleware() -> None:
    """Refuse a middleware that the environment names and this ROS lacks: its library would end the process."""
    wanted, own = os.environ.get(_MIDDLEWARE, ""), Path(sys.prefix) / "lib"
    if (own / f"lib{_OF_WHEELS}.so").is_file():  # ROS of wheels is built for one
        there, found = _OF_WHEELS, wanted == _OF_WHEELS
    else:
        folders = [Path(p) / "lib" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
        there = ", ".join(sorted(f.name[3:-3] for d in folders for f in d.glob("librmw_*_cpp.so"))) or "any"
        found = not folders or any((folder / f"lib{wanted}.so").is_file() for folder in folders)
    if wanted and not found:
        raise InputError(
            f"{_MIDDLEWARE}: expected a middleware of this ROS ({there}), got {wanted}; unset {_MIDDLEWARE}"
        )
