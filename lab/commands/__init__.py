"""Commands of the laboratory: one module each, with ``add_parser`` and ``run``."""

from __future__ import annotations

from drocap_ros.cli.options import LineParser
from lab.commands import learn_dictionary, mutants, studies, train_lifter, train_simulation_models


def build_parser() -> LineParser:
    """Parser of ``python -m lab``."""
    parser = LineParser(prog="python -m lab", description="Studies over MoCap; learning of what drocap_ros ships.")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in (studies, mutants, learn_dictionary, train_lifter, train_simulation_models):
        command.add_parser(subparsers)
    return parser
