"""``python -m lab``: the laboratory's commands, with the exit status and the one-line errors of ``drocap``."""

from __future__ import annotations

from drocap_ros.cli import main
from lab.commands import build_parser

raise SystemExit(main(parser=build_parser()))
