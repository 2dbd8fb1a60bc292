"""``drocap app``: one page in a browser for clips, corrections and exports."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command
from drocap_ros.errors import InputError


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "app",
        run,
        help="a page in the browser: clips in, corrections by hand, motions out",
        description="Open a page in the browser for the videos and motions of FOLDER: choose or drop clips, click the"
        " person, correct joints and feet by hand, export. Only this machine reaches it.",
    )
    parser.add_argument("folder", metavar="FOLDER", nargs="?", type=Path, default=Path(), help="default: this one")
    parser.add_argument("--port", type=int, default=8440, help="of the page (default: 8440)")
    parser.add_argument("--no-browser", action="store_true", help="open no browser; the page is at the printed address")
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder of networks (default: $DROCAP_MODELS)")


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    if not args.folder.is_dir():
        raise InputError(
            f"{args.folder}: expected a folder for clips and motions, found none; make it, or name another"
        )
    try:
        from drocap_ros.app import page
    except ModuleNotFoundError as error:
        if str(error.name).startswith("drocap_ros"):
            raise
        raise InputError(f"app: expected {error.name}, found none; run: pip install 'drocap_ros[app]'") from None
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", args.port))
        except (OSError, OverflowError):
            raise InputError(
                f"--port {args.port}: expected a free port, found it in use or none; choose another"
            ) from None
    print(f"http://127.0.0.1:{args.port}/ (Ctrl-C ends it)", flush=True)
    page.run(args.folder.resolve(), args.models, args.port, not args.no_browser)
    return 0
