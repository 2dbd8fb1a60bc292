"""``drocap orbit``: start, adjust or stop the orbit of a running graph, or print its status."""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections import deque
from typing import TYPE_CHECKING

from drocap_ros.cli.graph.common import add_place_options, chosen_domain, import_bringup
from drocap_ros.cli.options import Subparsers, add_command
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.recording.session import Message

#: Parameter of the orbit behind each option: its range is checked here, its limits by the bridge.
_PARAMETERS = {"--radius": "radius_m", "--height": "height_m", "--speed": "angular_speed_deg_s"}


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
    from drocap_ros.flight.orbit.states import Command
    from drocap_ros.ros.conversions import orbit_request
    from drocap_ros.ros.topics import RESULT_QOS, SERVICES, TOPICS

    no_graph = InputError(
        f"orbit: expected a running graph with mavlink_bridge in {args.namespace}, domain {domain_id}, "
        f"found none within {args.timeout:g} s; start `drocap live` first"
    )
    end_s = time.monotonic() + args.timeout
    with bringup.watch(args.namespace, domain_id) as graph:
        statuses: deque[Message] = deque(maxlen=1)
        if args.action in ("status", "watch"):
            kind = TOPICS["orbit/status"].message
            graph.node.create_subscription(kind, "orbit/status", lambda heard: statuses.append(heard), RESULT_QOS)
            if not graph.wait(lambda: bool(statuses), end_s - time.monotonic()):
                raise no_graph
            print(_sentence(statuses[-1]), flush=True)
        if args.action == "status":
            return 0
        client = graph.node.create_client(SERVICES["orbit/command"], "orbit/command", qos_profile=RESULT_QOS)
        if not graph.wait(client.service_is_ready, end_s - time.monotonic()):
            raise no_graph
        told = statuses[-1] if statuses else None
        while told is not None:
            client.call_async(orbit_request(graph.node, int(Command.PRESENT)))
            graph.wait(lambda: False, OPERATOR_PERIOD_S)
            if (statuses[-1].state, statuses[-1].condition) != (told.state, told.condition):
                print(_sentence(told := statuses[-1]), flush=True)
        wanted = (args.radius, args.height, args.speed)
        radius, height, speed = (math.nan if value is None else value for value in wanted)
        command = int(Command[args.action.upper()])
        answer = client.call_async(orbit_request(graph.node, command, radius, height, speed))
        if not graph.wait(answer.done, end_s - time.monotonic()):
            raise InputError(
                f"orbit: expected an answer to {args.action} within {args.timeout:g} s, found none; "
                "check by `drocap orbit status` whether it was executed"
            )
        response = answer.result()
        print(response.words if response.accepted else f"refused: {response.words}")
        return 0 if response.accepted else 1


def _check_options(args: argparse.Namespace) -> None:
    if not 0 < args.timeout <= 600:
        raise InputError(f"--timeout: expected above 0 and at most 600 s, got {args.timeout:g}")
    values = {"--radius": args.radius, "--height": args.height, "--speed": args.speed}
    given = {name: value for name, value in values.items() if value is not None}
    if args.action == "adjust" and not given:
        raise InputError("adjust: expected --radius, --height or --speed, got none; state what to change")
    for name, value in given.items():
        # To the bridge NaN means the configured value: a failed computation must not start another orbit.
        if not math.isfinite(value):
            raise InputError(f"{name}: expected a finite number, got {value:g}; correct the value or leave it out")
        if args.action in ("stop", "status", "watch"):
            raise InputError(f"{name}: {args.action} takes no values; leave it out")
        _check_range(name, value)


def _check_range(name: str, value: float) -> None:
    from drocap_ros.flight.bridge_config import OrbitConfig

    meta = next(spec.metadata for spec in dataclasses.fields(OrbitConfig) if spec.name == _PARAMETERS[name])
    low, high = meta["minimum"], meta["maximum"]
    if value < low or value > high:
        raise InputError(
            f"{name}: expected {low:g} to {high:g} {meta['unit']}, got {value:g}; choose a value in the range"
        )


def _sentence(status: Message) -> str:
    from drocap_ros.flight.conditions import ConditionCode
    from drocap_ros.flight.orbit.states import State

    state = State(status.state)
    text = f"{state.name.lower().replace('_', ' ')}: {status.reason}"
    if not math.isnan(status.radius_m):
        text += f"; {status.radius_m:.1f} m from the subject, {status.height_m:.1f} m high"
    if state == State.HOLDING and status.condition != ConditionCode.SUBJECT_NEAR:
        text += "; it stays there, also where somebody walks up to it"
    if state == State.ORBITING:
        text += f", {status.angular_speed_deg_s:.0f} deg/s, yaw error {status.yaw_error_deg:+.1f} deg"
    return text
