"""Stage times of the reconstruction over length, threads and memory: `python benchmarks/reconstruction.py`.

Each length and number of threads runs in its own process: the linear algebra has that many threads from the start, and
the peak of memory is that of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from typing import Any

from figures import ROOT, table, write_figures

FRAMES = (30, 100, 300, 1000, 3000, 10000)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: The default method with the telemetry of a drone: body and cameras are adjusted in the world.
WORLD = "ba, telemetry"
HEAD = (
    "method", "threads", "frames", "initial, ms/frame", "adjustment, s", "total, s", "processor, s",
    "memory above the first, MB",
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES)
    parser.add_argument("--threads", type=int, nargs="+", default=(1, 2))
    parser.add_argument("--methods", nargs="+", default=("paper", "mf-nnm", "ba", WORLD))
    parser.add_argument("--repeat", type=int, default=3, help="runs per cell up to 1000 frames; the median counts")
    parser.add_argument("--cell", type=json.loads, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.cell:
        print(json.dumps(measure(**args.cell)))
        return 0
    rows = [
        run_cell(frames=frames, threads=threads, method=method, repeat=args.repeat if frames <= 1000 else 1)
        for method in args.methods
        for threads in args.threads
        for frames in args.frames
    ]
    load = f"Load average at the end {os.getloadavg()[0]:.1f}: where it is above 1, trust the processor time.\n\n"
    write_figures("reconstruction", "Reconstruction: seconds over length", load + table(HEAD, rows))
    return 0


def run_cell(**cell: Any) -> list[str]:
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(cell["threads"])), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, __file__, "--cell", json.dumps(cell)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    row: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    method, threads, frames = cell["method"], cell["threads"], cell["frames"]
    print(f"{method:13s} {threads} threads {frames:6d} frames: {row['total']:.3f} s", file=sys.stderr)
    return [
        method, str(threads), str(frames), f"{1000.0 * row['initial'] / frames:.2f}", f"{row['ba']:.3f}",
        f"{row['total']:.3f}", f"{row['cpu']:.3f}", f"{row['memory_mb']:.0f}",
    ]  # fmt: skip


def measure(frames: int, threads: int, method: str, repeat: int) -> dict[str, float]:
    """Median seconds per stage of one cell, and the growth of the process's peak memory in MB."""
    from drocap_ros.reconstruction.reconstruct import reconstruct

    draw, method = (world_tracks, "ba") if method == WORLD else (synthetic_tracks, method)
    tracks = draw(frames)
    reconstruct(draw(30), method=method)  # imports and warm-up
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    runs = []
    for _ in range(repeat):
        begin, cpu = time.perf_counter(), time.process_time()
        motion = reconstruct(tracks, method=method)
        taken = {"total": time.perf_counter() - begin, "cpu": time.process_time() - cpu}
        runs.append({**motion.meta["seconds"], **taken})
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    stages = {name: statistics.median(run[name] for run in runs) for name in ("initial", "ba", "total", "cpu")}
    return {**stages, "memory_mb": max(peak - before, 0) / 1024.0}


def synthetic_tracks(frames: int) -> Any:
    """A walking person under an orbiting camera with 3 px of noise; needs no data."""
    import numpy as np

    from drocap_ros.simulation.simulated_person import simulate_person
    from drocap_ros.skeleton import BODY_15
    from drocap_ros.tracks import Tracks
    from lab.simulation.orbit import orbit_camera

    t = np.arange(frames) / 24.0
    person = simulate_person(t, action="walk", seed=0)
    rotation, _ = orbit_camera(t, person[:, 0], radius_m=6.0, height_m=2.0, speed_deg_s=25.0)
    camera = (person - person[:, :1]) @ np.swapaxes(rotation, 1, 2)
    noise = np.random.default_rng(0).normal(0.0, 3.0, (frames, 15, 2))
    stamp_ns = np.round(t * 1e9).astype(np.int64)
    return Tracks(400.0 * camera[..., :2] + 600.0 + noise, BODY_15.joints, stamp_ns, (1280, 1024))


def world_tracks(frames: int) -> Any:
    """A walking person, seen and measured by a drone with the errors of GPS (`python -m lab world`)."""
    import numpy as np

    from drocap_ros.simulation.simulated_person import simulate_person
    from lab.studies.protocol import Sequence
    from lab.studies.world_protocol import FPS, WorldCase, world_view

    person = simulate_person(np.arange(frames) / FPS, action="walk", seed=0)
    return world_view(Sequence("walk", 1000.0 * person), WorldCase("gps")).tracks


if __name__ == "__main__":
    raise SystemExit(main())
