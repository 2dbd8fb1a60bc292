"""``drocap recover``: mend what a power cut left of a session."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "recover",
        help="mend a session that a crash or power cut left unfinished",
        description="Mend a session in place: every message that can be read stands in it afterwards, and every reader"
        " of MCAP and rosbag2 opens it. The old file is replaced only after the mended one was read back.",
    )
    parser.add_argument("session", metavar="SESSION", type=Path, help="session folder or .mcap")
    parser.add_argument("--quiet", action="store_true", help="print only warnings")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Mend and say what was done."""
    import sys

    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.recording.mcap.recover import recover_session

    with progress_bars(args.quiet) as progress:
        files = recover_session(args.session, progress)
    for file in files:
        if not args.quiet:
            what = "mended" if file.mended else "was whole, left as it is"
            print(f"{file.path.name}: {what}; {file.messages} messages, each read back")
        for damage in file.damage:
            print(f"drocap: warning: {file.path.name}: {damage}", file=sys.stderr)
        if file.kept is not None:
            print(f"drocap: warning: {file.path.name}: kept as it was in {file.kept.name}", file=sys.stderr)
    return 0
