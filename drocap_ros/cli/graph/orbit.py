"""``drocap orbit``: tell a running graph to orbit, to change the orbit, to stop, and ask how it does."""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from typing import Any

#: Parameter of the orbit behind each option: its range holds here, its limits against each other in the bridge.
_PARAMETERS = {"--radius": "radius_m", "--height": "height_m", "--speed": "angular_speed_deg_s"}
ACTIONS = {"stop": 0, "start": 1, "adjust": 2, "engage": 3}
_STATES = ("idle", "ready", "orbiting", "holding", "taken over", "fault")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "orbit",
        help="start, adjust or stop the orbit of a running graph, or ask for its status",
        description="Talk to the mavlink_bridge of a running graph. Exit status 1 when it refuses. "
        "`start` needs the vehicle in GUIDED or OFFBOARD already; `engage` asks the autopilot for it first.",
    )
    parser.add_argument("action", choices=("start", "engage", "adjust", "stop", "status"), help="what to do")
    parser.add_argument("--radius", metavar="M", type=float, default=math.nan, help="m, from the subject")
    parser.add_argument("--height", metavar="M", type=float, default=math.nan, help="m, above the subject's ground")
    parser.add_argument(
        "--speed", metavar="DEG_S", type=float, default=math.nan, help="deg/s, positive = counter-clockwise from above"
    )
    parser.add_argument("--timeout", metavar="S", type=float, default=10.0, help="to wait for an answer (default 10)")
    parser.add_argument("--namespace", default="/drocap", help="of all topics (default /drocap)")
    parser.add_argument("--domain-id", type=int, default=0, metavar="N", help="DDS domain, 0 to 101 (default 0)")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Send the command and print the answer."""
    from drocap_ros.errors import InputError

    if not 0 <= args.domain_id <= 101:
        raise InputError(f"--domain-id: expected 0 to 101, got {args.domain_id}")
    if not 0 < args.timeout <= 600:
        raise InputError(f"--timeout: expected above 0 and at most 600 s, got {args.timeout:g}")
    values = {"--radius": args.radius, "--height": args.height, "--speed": args.speed}
    for name, value in values.items():
        if math.isinf(value):
            raise InputError(f"{name}: expected a finite number, got {value:g}")
        if args.action in ("stop", "status") and not math.isnan(value):
            raise InputError(f"{name}: {args.action} takes no values; leave it out")
        _check_range(name, value)
    try:
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor

        from drocap_ros.msg import OrbitCommand, OrbitStatus
        from drocap_ros.ros.conversions import stamp_to_ros
        from drocap_ros.ros.topics import RESULT_QOS
    except ImportError as error:
        raise InputError(f"expected ROS 2 with drocap_ros's messages, found none ({error}); run `make setup`") from None
    context = Context()
    rclpy.init(args=[], context=context, domain_id=args.domain_id)
    node = rclpy.create_node("orbit_operator", context=context, namespace=args.namespace)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    heard: list[Any] = []
    node.create_subscription(OrbitStatus, "orbit/status", heard.append, RESULT_QOS)
    publisher = node.create_publisher(OrbitCommand, "orbit/command", RESULT_QOS)
    end = time.monotonic() + args.timeout

    def wait(done: Any) -> bool:
        while not done() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        return bool(done())

    try:
        if not wait(lambda: heard and publisher.get_subscription_count()):
            raise InputError(
                f"orbit: expected a running graph with mavlink_bridge in {args.namespace}, domain {args.domain_id}, "
                f"heard nothing for {args.timeout:g} s; start `drocap live` first"
            )
        if args.action == "status":
            print(_sentence(heard[-1]))
            return 0
        before = len(heard)
        publisher.publish(
            OrbitCommand(
                header=_header(stamp_to_ros(node.get_clock().now().nanoseconds)), command=ACTIONS[args.action],
                radius_m=args.radius, height_m=args.height, angular_speed_deg_s=args.speed,
            )
        )  # fmt: skip
        if not wait(lambda: any(_is_answer(m.reason) for m in heard[before:])):
            raise InputError(
                f"orbit: the bridge did not answer {args.action} within {args.timeout:g} s; ask for status"
            )
        answer = next(m for m in heard[before:] if _is_answer(m.reason))
        print(answer.reason)
        return 1 if answer.reason.startswith("refused") else 0
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def _check_range(name: str, value: float) -> None:
    from drocap_ros.errors import InputError
    from drocap_ros.flight.orbit_config import OrbitConfig

    meta = next(spec.metadata for spec in dataclasses.fields(OrbitConfig) if spec.name == _PARAMETERS[name])
    low, high = meta["minimum"], meta["maximum"]
    if value < low or value > high:
        raise InputError(
            f"{name}: expected {low:g} to {high:g} {meta['unit']}, got {value:g}; choose a value in the range"
        )


#: How the answers of the controller begin; a reason that the status repeats begins otherwise.
_ANSWERS = (
    "refused", "already", "orbiting", "holding", "asking", "adjusted", "acknowledged", "not orbiting", "no longer",
)  # fmt: skip


def _is_answer(reason: str) -> bool:
    return reason.startswith(_ANSWERS) and reason != "orbiting the subject"


def _header(stamp: Any) -> Any:
    from std_msgs.msg import Header

    return Header(stamp=stamp)


def _sentence(status: Any) -> str:
    text = f"{_STATES[status.state]}: {status.reason}"
    if not math.isnan(status.radius_m):
        text += f"; {status.radius_m:.1f} m from the subject, {status.height_m:.1f} m high"
    if status.state == 2:
        text += f", {status.angular_speed_deg_s:.0f} deg/s, nose {status.yaw_error_deg:+.1f} deg off"
    return text
