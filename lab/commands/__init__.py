"""Commands of the laboratory: one module each, with ``add_parser`` and ``run``."""

from __future__ import annotations

from drocap_ros.cli.options import LineParser
from lab.commands import train_lifter, train_simulation_models


def build_parser() -> LineParser:
    """Parser of ``python -m lab``."""
    parser = LineParser(prog="python -m lab", description="Train the networks that drocap_ros ships.")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in (train_lifter, train_simulation_models):
        command.add_parser(subparsers)
    return parser
