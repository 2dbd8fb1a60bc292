"""``drocap app``: one page in a browser for clips, corrections and exports."""

from __future__ import annotations

import argparse
import importlib.util
import webbrowser
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command
from drocap_ros.cli.running import stop_signals
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
    if importlib.util.find_spec("nicegui") is None:
        raise InputError("app: expected nicegui, found none; run: pip install 'drocap_ros[app]'")
    if not 1 <= args.port <= 65535:
        raise InputError(f"--port: expected 1 to 65535, got {args.port}; choose another")
    from drocap_ros.app import page
    from drocap_ros.app.serving import listen
    from drocap_ros.view.motion_view import has_screen

    with listen("127.0.0.1", args.port) as sock, stop_signals() as stop:
        address = f"http://127.0.0.1:{args.port}/"
        print(f"open {address} in a browser; Ctrl-C stops", flush=True)
        if has_screen() and not args.no_browser:
            webbrowser.open(address)
        page.run(args.folder.resolve(), args.models, sock, stop)
    return 0
