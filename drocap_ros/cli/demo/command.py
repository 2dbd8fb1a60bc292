"""``drocap demo``: a simulated capture flight with images through the real nodes, compared with the truth."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option, add_seed_option
from drocap_ros.cli.running import interruptible, progress_bars

if TYPE_CHECKING:
    from drocap_ros.cli.demo.operator import Operator
    from drocap_ros.cli.demo.verdict import FlightVerdict
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import Motion
    from drocap_ros.simulation.flight_simulator.truth import FlightTruth

#: The networks of this package, for simulated images only.
MODELS = "simulation"
MOUNTS = ("gimbal", "servo", "fixed")
#: Shortest orbit, s: of a shorter one nothing is left to judge.
_LEAST_S = 2.0
#: Longest orbit, s: with its waits it fits the two hours at 15 Hz that a file of the truth holds.
_MOST_S = 3600.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "demo",
        run,
        help="fly a capture in simulation, reconstruct it, compare with the truth",
        description="A simulated drone takes off and films a simulated person; the real nodes see the person in the"
        " images and fly the orbit by their keypoints. Record it, reconstruct it, and print the errors against the"
        " simulated truth. Exit status 1 when less than half of the orbit was flown.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("demo_out"), help="folder (default demo_out)")
    parser.add_argument("--seconds", metavar="S", type=float, default=30.0, help="length of the orbit (default 30)")
    add_seed_option(parser, "of person, wind and scenery", metavar="N")
    parser.add_argument(
        "--autopilot",
        metavar="NAME",
        default="ardupilot",
        help="which one is simulated, ardupilot or px4 (default ardupilot)",
    )
    parser.add_argument(
        "--mount",
        choices=MOUNTS,
        default="gimbal",
        help="of the simulated camera (default gimbal); a fixed one is tilted for the orbit",
    )
    parser.add_argument(
        "--models", metavar="DIR", default=MODELS, help="folder of ONNX models instead of those for simulation"
    )
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="fly as fast as the clock, each node in a process of its own: a busy machine is late",
    )
    add_quiet_option(parser, "print only the result")


def run(args: argparse.Namespace) -> int:
    """Fly, record, reconstruct, compare."""
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.cli.demo.flight import check_flown, fly_in_real_time, fly_in_simulated_time
    from drocap_ros.cli.demo.operator import Operator
    from drocap_ros.cli.demo.verdict import judge_flight
    from drocap_ros.cli.motion_output import summary
    from drocap_ros.cli.report import open_words
    from drocap_ros.errors import InputError
    from drocap_ros.evaluation.compare import compare
    from drocap_ros.flight.autopilot import autopilot_of
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.simulation.flight_simulator.truth import load_flight_truth

    if not (math.isfinite(args.seconds) and _LEAST_S <= args.seconds <= _MOST_S):
        raise InputError(f"--seconds: expected {_LEAST_S:g} to {_MOST_S:g}, got {args.seconds:g}; choose another")
    check_output_folder(args.out)
    operator = Operator(args.seconds, requests_control=not autopilot_of(args.autopilot).hints.by_hand)
    with interruptible() as interrupted, output_folder(args.out) as folder:
        config = demo_config(folder, args.seed, args.autopilot, args.models, args.mount)
        fly = fly_in_simulated_time
        if args.real_time:
            config, fly = with_link(config), fly_in_real_time
        # On a terminal only: the bars would take the remarks out of a pipe.
        with progress_bars(args.quiet or not sys.stdout.isatty()) as progress:
            how = fly(config, operator, (lambda *_: None) if args.quiet else _say, progress, interrupted)
        check_flown(operator)
        truth = load_flight_truth(folder / "truth.npz")
        with open_session(folder / "session") as session:
            verdict = judge_flight(session, truth, config.mavlink_bridge.radius_m)
        motion = _reconstruct(folder, config, args)
        errors = compare(motion, truth.joints3d, truth.stamp_ns * 1e-9, "world")
        if not args.quiet:
            print(summary(motion, "ba"))
            print(how)
    print(_flight_sentence(operator, verdict, config))
    print(_image_sentence(verdict, truth))
    world = "" if errors.world is None else f", W-MPJPE {errors.world.w_mm:.1f} mm"
    print(
        f"reconstruction error against the simulated truth: {errors.error_mm:.1f} mm (PA-MPJPE, 12 limb joints,"
        f" {errors.frames} frames){world}; scale error {100 * errors.scale_error:+.1f} % ({motion.scale_source}),"
        f" frame {motion.frame}"
    )
    print(f"files in {args.out}: motion.npz, truth.npz, report.html, session/")
    print(open_words(args.out / "report.html"))
    return 0


def _say(seconds: float, text: str) -> None:
    print(f"{seconds:6.1f} s  {text}", flush=True)


def demo_config(folder: Path, seed: int, autopilot: str, models: str, mount: str = "gimbal") -> DrocapConfig:
    """The demo's graph, with motion enabled for the simulated vehicle."""
    from drocap_ros.config import DrocapConfig

    config = DrocapConfig().replace(
        "flight_simulator",
        autopilot=autopilot,
        seed=seed,
        mount=mount,
        truth_file=str(folder / "truth.npz"),
    )
    if mount == "fixed":  # it leans into the wind: with the gimbal's lens the bridge refuses this orbit
        config = config.replace("flight_simulator", horizontal_fov_deg=75.0)
    config = config.replace(
        "mavlink_bridge",
        commands_enabled=True,
        mode_change_allowed=True,
        gimbal_control=mount != "fixed",
        body_height_m=config.flight_simulator.stature_m,
        attitude_hz=25.0,
        mount="auto" if mount == "gimbal" else mount,
        camera_pitch_deg=config.flight_simulator.camera_pitch_deg if mount == "fixed" else 0.0,
    )
    # The stature is known, as an operator would ask for it before a flight.
    config = config.replace("initializer", assumed_height_m=config.flight_simulator.stature_m)
    # Another processor than the CPU would give other last bits.
    config = config.replace("pose_estimator", models_dir=models, on_loss="next", provider="cpu")
    return config.replace("session_recorder", session_dir=str(folder / "session"))


def with_link(config: DrocapConfig) -> DrocapConfig:
    """The configuration with a MAVLink link over a free port of this machine."""
    from drocap_ros.simulation.vehicle.loopback import free_udp_port

    address = f"127.0.0.1:{free_udp_port()}"
    config = config.replace("flight_simulator", vehicle_url=f"udpout:{address}")
    return config.replace("mavlink_bridge", url=f"udpin:{address}")


def _reconstruct(folder: Path, config: DrocapConfig, args: argparse.Namespace) -> Motion:
    """Motion of the recorded session, saved with its images and report."""
    from drocap_ros.motion import save_motion
    from drocap_ros.pipeline import Selection, reconstruct_input
    from drocap_ros.report.motion_images import ImagesBeside
    from drocap_ros.report.page import save_report

    session = folder / "session"
    with progress_bars(args.quiet) as progress, ImagesBeside(session, progress) as images:
        selection = Selection(on_tracks=images.begin)
        motion, _ = reconstruct_input(session, method="ba", config=config, progress=progress, selection=selection)
        save_motion(folder / "motion.npz", motion)
        save_report(folder / "report.html", motion, images=images.of(motion), command=args.command_line)
    return motion


def _flight_sentence(operator: Operator, verdict: FlightVerdict, config: DrocapConfig) -> str:
    holds = f"held {len(operator.holds)} times ({'; '.join(operator.holds)})" if operator.holds else "never held"
    words = f"orbit: {operator.orbited_s:.1f} s flown, {holds}"
    if operator.failure:
        words += f"; ended early: {operator.failure}"
    if verdict.orbit is None:
        return f"{words}; too short to judge after its ramp"
    o = verdict.orbit
    return (
        f"{words}; against the truth after the ramp: mean radius error {o.radius_error_m:.2f} m of"
        f" {config.mavlink_bridge.radius_m:g} m, mean yaw error {o.yaw_error_deg:.1f} deg, person in the middle third"
        f" {100 * o.in_middle_third:.1f} %, {o.turned_deg:.0f} deg round, nearest {o.least_distance_m:.1f} m, at most"
        f" {o.top_speed_m_s:.1f} m/s"
    )


def _image_sentence(verdict: FlightVerdict, truth: FlightTruth) -> str:
    seconds = (truth.stamp_ns[-1] - truth.stamp_ns[0]) * 1e-9
    words = (
        f"pictures: {verdict.exposures} exposed in {seconds:.0f} s, {verdict.pictures} rendered and recorded,"
        f" {verdict.poses} estimated, {verdict.seen} with the subject"
    )
    if verdict.live is None:
        return f"{words}; no live 3D pose"
    live = verdict.live
    return (
        f"{words}; live: {live.count} poses, error {1000 * live.error_m:.1f} mm (PA-MPJPE), scale error"
        f" {100 * live.scale_error:+.1f} %, frame {live.frame}"
    )
