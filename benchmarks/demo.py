"""`drocap demo` on a quiet machine and beside busy processes: `python benchmarks/demo.py [--seeds 0 1 2]`.

Equal rows of one seed have the same digits and the same session, whose messages the last column sums up.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from figures import ROOT, table, write_figures

from drocap_ros.cli.demo.verdict import judge_flight
from drocap_ros.config import DrocapConfig
from drocap_ros.evaluation.compare import compare
from drocap_ros.motion import load_motion
from drocap_ros.recording.open_session import open_session
from drocap_ros.simulation.flight_simulator.truth import load_flight_truth

sys.path[:0] = [str(ROOT / "test" / "helpers")]
from busy_processes import busy_processes  # noqa: E402
from session_contents import session_contents  # noqa: E402

HEAD = [
    "autopilot", "seed", "busy processes", "time, s", "holds", "radius error, m of 6 m", "yaw error, deg",
    "images with the subject, %", "live error, mm", "reconstruction error, mm", "session",
]  # fmt: skip


def flown(out: Path, seed: int, busy: int, args: argparse.Namespace) -> list[str]:
    """A row of the table: one demo, read back from its files."""
    command = [
        sys.executable, "-m", "drocap_ros.cli", "demo", "--quiet", "--out", str(out), "--seed", str(seed),
        "--seconds", f"{args.seconds:g}", "--autopilot", args.autopilot, *(["--real-time"] if args.real_time else []),
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with busy_processes(busy):
        begin = time.monotonic()
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    head = [args.autopilot, str(seed), str(busy), f"{time.monotonic() - begin:.0f}"]
    if done.returncode:
        print(done.stderr.strip(), flush=True)
        return [*head, f"exit status {done.returncode}", *["-"] * 6]
    held = re.search(r"held (\d+) times", done.stdout)
    truth, motion = load_flight_truth(out / "truth.npz"), load_motion(out / "motion.npz")
    with open_session(out / "session") as session:
        verdict = judge_flight(session, truth, DrocapConfig().mavlink_bridge.radius_m)
    error = compare(motion, truth.joints3d, truth.stamp_ns * 1e-9, "world").error_mm
    orbit, live = verdict.orbit, verdict.live
    content = hashlib.sha256(str(sorted(session_contents(out / "session").items())).encode()).hexdigest()
    return [
        *head,
        held[1] if held else "0",
        f"{orbit.radius_error_m:.6f}" if orbit else "-",
        f"{orbit.yaw_error_deg:.5f}" if orbit else "-",
        f"{100 * verdict.seen / max(verdict.pictures, 1):.1f}",
        f"{1000 * live.error_m:.5f}" if live else "-",
        f"{error:.5f}",
        content[:8],
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of person, wind and scenery")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 4], help="numbers of busy processes beside it")
    parser.add_argument("--seconds", type=float, default=30.0, help="of orbit")
    parser.add_argument("--autopilot", default="ardupilot", choices=["ardupilot", "px4"])
    parser.add_argument("--real-time", action="store_true", help="fly in real time; writes no page")
    args = parser.parse_args()
    rows = []
    for seed in args.seeds:
        for busy in args.busy:
            with tempfile.TemporaryDirectory(prefix="drocap_bench_") as folder:
                rows.append(flown(Path(folder) / "demo", seed, busy, args))
            print(" ".join(rows[-1]), flush=True)
    text = (
        "Errors against the simulated truth; radius and yaw after the orbit's ramp, PA-MPJPE over 12 joints. The last"
        " column sums up every message of the session and its log time.\n\n"
    )
    if not args.real_time:
        write_figures("demo", "The demo", text + table(HEAD, rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
