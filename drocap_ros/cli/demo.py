"""``drocap demo``: a whole simulated capture flight through the real nodes, reconstructed and judged."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import Motion
    from drocap_ros.simulation.capture import SimulatedCapture

NODES = ("capture_simulator", "initializer", "bundle_adjuster", "mavlink_bridge", "visualizer", "session_recorder")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "demo",
        help="simulate a capture flight, reconstruct it, compare with the truth",
        description="Simulate a person and an orbiting drone, run the real nodes over DDS, record a session,"
        " reconstruct it and print the error against the simulated truth.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("demo_out"), help="folder (default demo_out)")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the flight (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="of the person, the take and the noise (default 0)")
    parser.add_argument("--quiet", action="store_true", help="print only the result")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Fly, record, reconstruct, compare."""
    from drocap_ros.cli.output import check_output_folder, output_folder
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.cli.reconstruct import summary
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import save_motion
    from drocap_ros.pipeline import reconstruct_input
    from drocap_ros.report.page import save_report
    from drocap_ros.report.preview import save_preview
    from drocap_ros.simulation.capture import simulate_capture
    from drocap_ros.simulation.ports import free_udp_port

    check_output_folder(args.out)
    url = f"127.0.0.1:{free_udp_port()}"
    config = DrocapConfig().replace(
        "capture_simulator", seconds=args.seconds, seed=args.seed, vehicle_url=f"udpout:{url}"
    )
    config = config.replace("mavlink_bridge", url=f"udpin:{url}")
    truth = simulate_capture(args.seconds, config.capture_simulator.rate_hz, args.seed, config.capture_simulator)
    with output_folder(args.out) as folder:
        _say(args, f"flying for {args.seconds:g} s: {', '.join(NODES)}, a process each")
        _fly(config.replace("session_recorder", session_dir=str(folder / "session")), args)
        with progress_bars(args.quiet) as progress:
            motion, _ = reconstruct_input(folder / "session", method="ba", config=config, progress=progress)
        save_motion(folder / "motion.npz", motion)
        _save_truth(folder / "truth.npz", truth, motion)
        save_preview(folder / "preview.png", motion)
        save_report(folder / "report.html", motion, command=args.command_line)
    _say(args, summary(motion, "ba"))
    print(_verdict(motion, truth))
    print(f"files: {args.out}/motion.npz, truth.npz, preview.png, report.html; session: {args.out}/session")
    return 0


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text, flush=True)


def _fly(config: DrocapConfig, args: argparse.Namespace) -> None:
    from drocap_ros.cli.live import import_bringup
    from drocap_ros.cli.progress import progress_bars

    with import_bringup().bringup(config, NODES, processes=True) as graph, progress_bars(args.quiet) as progress:
        begin = graph.node.get_clock().now().nanoseconds
        length = args.seconds + 3.5

        def over() -> bool:
            elapsed = (graph.node.get_clock().now().nanoseconds - begin) * 1e-9
            progress("flight", min(1.0, elapsed / length))
            return "capture_simulator" in graph.finished

        graph.wait_until(over, 3 * length + 30, "the end of the flight")


def _true_joints(motion: Motion, truth: SimulatedCapture) -> Any:
    """Truth at the motion's stamps: the flight's clock starts with its first picture."""
    import numpy as np

    stamps = truth.tracks.stamp_ns
    offset = motion.stamp_ns[0] - stamps[0]
    place = np.searchsorted(stamps, motion.stamp_ns - offset).clip(0, len(stamps) - 1)
    return truth.joints3d_world[place]


def _save_truth(path: Path, truth: SimulatedCapture, motion: Motion) -> None:
    import numpy as np

    from drocap_ros.skeleton import BODY_15

    np.savez_compressed(
        path, joints3d=_true_joints(motion, truth), joints=np.array(BODY_15.joints), stamp_ns=motion.stamp_ns
    )


def _verdict(motion: Motion, truth: SimulatedCapture) -> str:
    import numpy as np

    from drocap_ros.reconstruction.metrics import pa_mpjpe, scale_error

    true = _true_joints(motion, truth)
    known = np.isfinite(motion.joints3d).all(axis=(1, 2))
    error = pa_mpjpe(motion.joints3d[known], true[known], motion.joints).mean()
    scale = scale_error(motion.joints3d[known], true[known], motion.joints)
    return (
        f"reconstruction error against the simulated truth: {1000 * error:.1f} mm (PA-MPJPE, 12 limb joints);"
        f" scale error {100 * scale:+.1f} % ({motion.scale_source})"
    )
