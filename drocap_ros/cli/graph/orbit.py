"""``drocap orbit``: start, adjust or stop the orbit of a running graph, or print its status."""

from __future__ import annotations

import argparse
import time

from drocap_ros.cli.graph.common import add_place_options, chosen_domain, import_bringup
from drocap_ros.cli.options import Subparsers, add_command
from drocap_ros.errors import InputError


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "orbit",
        run,
        help="start, adjust or stop the orbit of a running graph, or print its status",
        description="Send a command to the mavlink_bridge of a running graph and print the answer. Exit status 1 when "
        "the command is refused. `start` needs the vehicle in GUIDED or OFFBOARD already; `engage` requests that mode "
        "from the autopilot first. Values that are not given stay with `adjust`; `start` and `engage` take the "
        "configured ones, also after a hold. `watch` prints every change until Ctrl-C, and tells the bridge that this "
        "console lives (operator_timeout_s).",
    )
    actions = ("start", "engage", "adjust", "stop", "status", "watch")
    parser.add_argument("action", choices=actions, help="command to send")
    parser.add_argument("--radius", metavar="M", type=float, help="m, from the subject")
    parser.add_argument("--height", metavar="M", type=float, help="m, above the subject's ground")
    parser.add_argument("--speed", metavar="DEG_S", type=float, help="deg/s, positive = counter-clockwise from above")
    parser.add_argument("--timeout", metavar="S", type=float, default=10.0, help="to wait for an answer (default 10)")
    add_place_options(parser)


def run(args: argparse.Namespace) -> int:
    """Send the command and print the answer."""
    domain_id = chosen_domain(args)
    _check_options(args)
    bringup = import_bringup()
    from drocap_ros.flight.bridge_config import OPERATOR_PERIOD_S
    from drocap_ros.station.desk import Desk, sentence

    no_graph = InputError(
        f"orbit: expected a running graph with mavlink_bridge in {args.namespace}, domain {domain_id}, "
        f"found none within {args.timeout:g} s; start `drocap live` first"
    )
    end_s = time.monotonic() + args.timeout
    with bringup.watch(args.namespace, domain_id) as graph:
        desk = Desk(graph)
        told = None
        if args.action in ("status", "watch"):
            if not graph.wait(lambda: bool(desk.statuses), end_s - time.monotonic()):
                raise no_graph
            told = desk.statuses[-1]
            print(sentence(told), flush=True)
        if args.action == "status":
            return 0
        if not graph.wait(desk.is_reachable, end_s - time.monotonic()):
            raise no_graph
        while told is not None:
            desk.present()
            graph.wait(lambda: False, OPERATOR_PERIOD_S)
            now = desk.statuses[-1]
            if (now.state, now.condition) != (told.state, told.condition):
                print(sentence(told := now), flush=True)
        answer = desk.order(args.action, _values(args))
        if not graph.wait(answer.done, end_s - time.monotonic()):
            raise InputError(
                f"orbit: expected an answer to {args.action} within {args.timeout:g} s, found none; "
                "check by `drocap orbit status` whether it was executed"
            )
        response = answer.result()
        print(response.words if response.accepted else f"refused: {response.words}")
        return 0 if response.accepted else 1


def _values(args: argparse.Namespace) -> dict[str, float | None]:
    return {"radius": args.radius, "height": args.height, "speed": args.speed}


def _check_options(args: argparse.Namespace) -> None:
    from drocap_ros.station.desk import check_values

    if not 0 < args.timeout <= 600:
        raise InputError(f"--timeout: expected above 0 and at most 600 s, got {args.timeout:g}")
    check_values(args.action, _values(args), "--")
