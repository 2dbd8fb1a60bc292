"""`drocap demo` several times, judged by the simulated truth: `python benchmarks/demo.py [--runs 3]`.

A run takes about 100 s.  Run it on a machine that does nothing else: late images make the bridge hold.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import ROOT, table, write_figures

from drocap_ros.cli.demo.verdict import judge_flight
from drocap_ros.config import DrocapConfig
from drocap_ros.evaluation.compare import compare
from drocap_ros.motion import load_motion
from drocap_ros.recording.open_session import open_session
from drocap_ros.simulation.flight_simulator.truth import load_flight_truth


def flown(out: Path, seed: int, seconds: float, autopilot: str) -> list[str]:
    """A row of the table: one demo, read back from its files."""
    command = [
        sys.executable, "-m", "drocap_ros.cli", "demo", "--quiet", "--out", str(out), "--seed", str(seed),
        "--seconds", f"{seconds:g}", "--autopilot", autopilot,
    ]  # fmt: skip
    load = os.getloadavg()[0]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, check=False
    )
    head = [autopilot, str(seed), f"{load:.1f}"]
    if done.returncode:
        return [*head, f"exit status {done.returncode}", *["-"] * 4]
    truth, motion = load_flight_truth(out / "truth.npz"), load_motion(out / "motion.npz")
    with open_session(out / "session") as session:
        verdict = judge_flight(session, truth, DrocapConfig().mavlink_bridge.radius_m)
    error = compare(motion, truth.joints3d, truth.stamp_ns * 1e-9, "world").error_mm
    orbit, live = verdict.orbit, verdict.live
    return [
        *head,
        f"{orbit.radius_error_m:.2f}" if orbit else "-",
        f"{orbit.yaw_error_deg:.1f}" if orbit else "-",
        f"{100 * verdict.seen / max(verdict.pictures, 1):.0f}",
        f"{1000 * live.error_m:.0f}" if live else "-",
        f"{error:.0f}",
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="of each autopilot")
    parser.add_argument("--seed", type=int, default=0, help="of person, wind and scenery")
    parser.add_argument("--seconds", type=float, default=30.0, help="of orbit")
    parser.add_argument("--autopilots", nargs="+", default=["ardupilot"], choices=["ardupilot", "px4"])
    args = parser.parse_args()
    rows = []
    for autopilot in args.autopilots:
        for run in range(args.runs):
            with tempfile.TemporaryDirectory(prefix="drocap_bench_") as folder:
                rows.append(flown(Path(folder) / f"demo{run}", args.seed, args.seconds, autopilot))
            print(" ".join(rows[-1]), flush=True)
    head = [
        "autopilot", "seed", "load before", "radius error, m of 6 m", "yaw error, deg", "images with the subject, %",
        "live error, mm", "reconstruction error, mm",
    ]  # fmt: skip
    text = "Errors against the simulated truth; radius and yaw after the orbit's ramp, PA-MPJPE over 12 joints.\n\n"
    write_figures("demo", "The demo", text + table(head, rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
