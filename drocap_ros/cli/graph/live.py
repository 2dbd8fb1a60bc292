"""``drocap live``: bring the graph up on real hardware."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.graph.common import add_start_options, chosen_domain, import_bringup
from drocap_ros.cli.graph.top import dashboard_of
from drocap_ros.cli.options import Subparsers, add_command, add_config_option, add_models_option
from drocap_ros.cli.running import stop_signals
from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import METADATA_FILE
from drocap_ros.recording.provenance import dated_name

if TYPE_CHECKING:
    from drocap_ros.bringup import Graph
    from drocap_ros.config import DrocapConfig


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "live",
        run,
        help="bring the graph up on real hardware",
        description="Start the nodes and run until the source ends or Ctrl-C. Each in a process of its own.",
    )
    add_config_option(parser)
    add_models_option(parser)
    parser.add_argument(
        "--source",
        metavar="URI",
        help="replaces the configuration's image_ingest.source; 0 = the first camera of this computer. Without --config"
        " neither an autopilot is asked nor, without --session, a recording made",
    )
    parser.add_argument("--session", metavar="DIR", type=Path, help="record to this new folder")
    parser.add_argument(
        "--nodes", nargs="+", metavar="NODE", help="names of nodes (default: image_ingest to session_recorder)"
    )
    parser.add_argument(
        "--vmc", metavar="HOST:PORT", help="send the newest pose there by VMC (VSeeFace, Unity, Unreal, Blender)"
    )
    parser.add_argument("--websocket", metavar="HOST:PORT", help="serve the newest pose there as JSON by a WebSocket")
    add_run_options(parser)


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Options of :func:`run_graph`."""
    add_start_options(parser)
    parser.add_argument("--no-respawn", action="store_true", help="end when a node dies instead of restarting it")


def run(args: argparse.Namespace) -> int:
    """Run the graph until its source has ended or the user interrupts."""
    from drocap_ros.config import load_config
    from drocap_ros.perception.load_models import models_folder

    if not (args.config or args.source):
        raise InputError("live: expected --config or --source, got neither; name a file of parameters or a camera")
    config = load_config(args.config)
    if args.source:
        camera = f"/dev/video{args.source}" if args.source.isdecimal() else args.source
        config = config.replace("image_ingest", source=camera)
    if args.models:
        config = config.replace("pose_estimator", models_dir=str(models_folder(args.models).absolute()))
    if args.session:
        config = config.replace("session_recorder", session_dir=str(args.session.absolute()))
    nodes = args.nodes or live_nodes()
    if not (args.config or args.nodes):
        left_out = {"mavlink_bridge"} if args.session else {"mavlink_bridge", "session_recorder"}
        nodes = [name for name in nodes if name not in left_out]
    config = _with_receivers(config, args)
    if config.stream_out.vmc or config.stream_out.websocket:
        nodes = [*nodes, "stream_out"]
    return run_graph(config, nodes, args)


def _with_receivers(config: DrocapConfig, args: argparse.Namespace) -> DrocapConfig:
    """The configuration with what the options say; a WebSocket that the network reaches is named on stderr."""
    from drocap_ros.export.stream_out_config import address_of, is_loopback

    given = {name: getattr(args, name) for name in ("vmc", "websocket") if getattr(args, name)}
    config = config.replace("stream_out", **given)
    socket = config.stream_out.websocket
    if socket and not is_loopback(address_of(socket, "websocket")[0]):
        print(f"drocap: warning: whoever reaches {socket} may read the pose of the person", file=sys.stderr)
    return config


def live_nodes() -> list[str]:
    """Names of the nodes that run on real hardware."""
    import_bringup()
    from drocap_ros.ros.topics import NODES

    return [name for name, entry in NODES.items() if entry.live]


def run_graph(config: DrocapConfig, nodes: list[str], args: argparse.Namespace) -> int:
    """Start nodes, show their diagnostics, stop on Ctrl-C or when the source has ended."""
    domain_id = chosen_domain(args)
    bringup = import_bringup().bringup
    if "session_recorder" in nodes and not config.session_recorder.session_dir:
        name = dated_name(time.time_ns(), args.namespace)
        config = config.replace("session_recorder", session_dir=str(Path(name).absolute()))
    recorded = Path(config.session_recorder.session_dir)
    before = _session_folders(recorded)
    with bringup(
        config,
        nodes,
        processes=not args.one_process,
        namespace=args.namespace,
        domain_id=domain_id,
        respawn=not args.no_respawn,
    ) as graph:
        _show(graph, args.quiet)
    if "session_recorder" in nodes and not args.quiet:
        folders = sorted(_session_folders(recorded) - before)
        print("\n".join(f"session: {folder}" for folder in folders) or "no session: nothing was recorded")
    return 0


def _show(graph: Graph, quiet: bool) -> None:
    """Draw the dashboard and print the events until Ctrl-C or the end of the source."""
    if not quiet:
        print(f"running {', '.join(graph.names)} in {graph.namespace}, domain {graph.domain_id}; Ctrl-C stops")
        sys.stdout.flush()
    with dashboard_of(graph, show=not quiet) as (_, draw), stop_signals() as stop:
        while not stop.is_set() and not graph.finished:
            graph.spin_for(0.5, stop)
            draw()
            while graph.events:
                print(f"drocap: {graph.events.popleft()}", file=sys.stderr, flush=True)


def _session_folders(first: Path) -> set[Path]:
    """Finished sessions of a recorder: a restarted one takes the next free name."""
    folders = [first, *first.parent.glob(f"{first.name}_[0-9]*")]
    return {folder for folder in folders if (folder / METADATA_FILE).is_file()}
