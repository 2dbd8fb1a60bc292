"""``drocap station``: one page in a browser that shows a running flight and commands it."""

from __future__ import annotations

import argparse
import importlib.util
import secrets
import socket
import sys
import webbrowser

from drocap_ros.cli.graph.common import add_place_options, chosen_domain, import_bringup
from drocap_ros.cli.options import Subparsers, add_command, add_config_option, add_models_option
from drocap_ros.cli.running import stop_signals
from drocap_ros.errors import InputError

PORT = 8090
#: The preflight's table tells of the last seconds, as many as `drocap preflight` listens.
_KEEP_S = 8.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "station",
        run,
        help="one page in a browser for a flight",
        description="Serve a page that shows a running graph, on this machine or another one of the ROS domain, and "
        "commands its orbit as `drocap orbit` does. While the page that commands answers, the bridge hears that its "
        "operator is present (operator_timeout_s). The space bar stops. Until Ctrl-C.",
    )
    add_config_option(parser, required=True)
    add_models_option(parser)
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address of the page; another one than this computer's own asks for a token (default 127.0.0.1)",
    )
    parser.add_argument("--port", type=int, default=PORT, help=f"of the page (default {PORT})")
    parser.add_argument("--no-browser", action="store_true", help="print the address, open no browser")
    add_place_options(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until a signal."""
    from drocap_ros.config import load_config

    if not 1 <= args.port <= 65535:
        raise InputError(f"--port: expected 1 to 65535, got {args.port}; choose another")
    if importlib.util.find_spec("nicegui") is None:
        raise InputError("station: expected nicegui, found none; run: pip install 'drocap_ros[app]'")
    config, domain_id = load_config(args.config), chosen_domain(args)
    bringup = import_bringup()
    from drocap_ros.app.serving import listen
    from drocap_ros.cli.graph.preflight import setup_of
    from drocap_ros.cli.graph.running_bridge import BridgeListener
    from drocap_ros.cli.graph.top import dashboard_of
    from drocap_ros.export.stream_out_config import is_loopback
    from drocap_ros.flight.preflight.measure import all_findings
    from drocap_ros.station.server import serve
    from drocap_ros.station.station import Station, Views
    from drocap_ros.view.motion_view import has_screen

    setup, bridge = setup_of(config, args.models), config.mavlink_bridge
    token = "" if is_loopback(args.host) else secrets.token_urlsafe(16)
    with (
        listen(args.host, args.port) as sock,
        stop_signals() as stop,
        bringup.watch(args.namespace, domain_id, lean=True) as graph,
        dashboard_of(graph, show=False) as (dashboard, _),
    ):
        listener = BridgeListener(graph, keep_s=_KEEP_S)
        views = Views(
            lambda: all_findings(bridge, setup, listener.measured(bridge, args.namespace)),
            lambda: dashboard.rows(args.namespace),
            lambda: dashboard.is_active(f"{args.namespace.strip('/')}/session_recorder"),
        )
        station = Station(graph, bridge, views)
        try:
            any_address = args.host in ("0.0.0.0", "::")
            host = socket.gethostname() if any_address else f"[{args.host}]" if ":" in args.host else args.host
            address = f"http://{host}:{args.port}/" + (f"?token={token}" if token else "")
            print(f"open {address} in a browser; Ctrl-C stops", flush=True)
            if token:
                print("drocap: warning: not encrypted; whoever reads the network may command", file=sys.stderr)
            if has_screen() and not args.no_browser:
                webbrowser.open(address)
            serve(station, sock, token, stop)
        finally:
            station.close()
        if station.failure is not None:
            raise station.failure
    return 0
