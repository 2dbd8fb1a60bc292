"""``drocap recover``: repair a session after a crash or power cut."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "recover",
        run,
        help="repair a session after a crash or power cut",
        description="Repair a session in place for every reader of MCAP and rosbag2. A damaged file is replaced only"
        " after all of its readable messages were read back from the repaired copy.",
    )
    parser.add_argument("session", metavar="SESSION", type=Path, help="session folder or .mcap")
    add_quiet_option(parser, "print only warnings")


def run(args: argparse.Namespace) -> int:
    """Repair and print the result of each file."""
    import sys

    from drocap_ros.cli.running import progress_bars
    from drocap_ros.recording.mcap.recover import recover_session

    with progress_bars(args.quiet) as progress:
        files = recover_session(args.session, progress)
    for file in files:
        if not args.quiet:
            what = "repaired" if file.repaired else "was whole, unchanged"
            print(f"{file.path.name}: {what}; {file.messages} messages, each read back")
        for damage in file.damage:
            print(f"drocap: warning: {file.path.name}: {damage}", file=sys.stderr)
        if file.kept is not None:
            print(f"drocap: warning: {file.path.name}: the damaged file is kept as {file.kept.name}", file=sys.stderr)
    return 0
