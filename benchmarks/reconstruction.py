"""Stage times of the reconstruction over length, threads and memory: `python benchmarks/reconstruction.py`.

Each length and number of threads runs in a process of its own, so that the linear algebra has that many threads
and the peak of memory is that run's.  Results go to a Markdown table and a JSON file with the machine's description.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FRAMES = (30, 100, 300, 1000, 3000, 10000)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES)
    parser.add_argument("--threads", type=int, nargs="+", default=(1, 2))
    parser.add_argument("--methods", nargs="+", default=("paper", "mf-nnm", "ba"))
    parser.add_argument("--repeat", type=int, default=3, help="runs per cell up to 1000 frames; the median counts")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
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
    args.out.mkdir(parents=True, exist_ok=True)
    result = {"machine": machine(), "rows": rows}
    (args.out / "reconstruction.json").write_text(json.dumps(result, indent=1) + "\n")
    (args.out / "reconstruction.md").write_text(markdown(result))
    print(markdown(result))
    return 0


def run_cell(**cell: Any) -> dict[str, Any]:
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(cell["threads"])), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, __file__, "--cell", json.dumps(cell)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(
        f"{cell['method']:8s} {cell['threads']} threads {cell['frames']:6d} frames: {row['total_s']:.3f} s",
        file=sys.stderr,
    )
    return row


def measure(frames: int, threads: int, method: str, repeat: int) -> dict[str, Any]:
    """Median seconds per stage of one cell, and the process's peak memory over that before it."""
    from drocap_ros.reconstruction.reconstruct import reconstruct

    tracks = synthetic_tracks(frames)
    reconstruct(synthetic_tracks(30), method=method)  # imports and warm-up
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    runs = []
    for _ in range(repeat):
        start, cpu = time.perf_counter(), time.process_time()
        motion = reconstruct(tracks, method=method)
        taken = {"total": time.perf_counter() - start, "cpu": time.process_time() - cpu}
        runs.append({**motion.meta["seconds"], **taken})
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    stage = {name: statistics.median(run.get(name, 0.0) for run in runs) for name in ("initial", "ba", "total", "cpu")}
    return {
        "method": method,
        "threads": threads,
        "frames": frames,
        "initial_s": stage["initial"],
        "initial_ms_per_frame": 1000.0 * stage["initial"] / frames,
        "ba_s": stage["ba"],
        "total_s": stage["total"],
        "cpu_s": stage["cpu"],
        "extra_memory_mb": max(peak - before, 0) / 1024.0,
        "iterations": motion.meta["iterations"],
    }


def synthetic_tracks(frames: int) -> Any:
    """A walking person under an orbiting camera with 3 px of noise; needs no data."""
    import numpy as np

    from drocap_ros.simulation.orbit_camera import orbit_camera
    from drocap_ros.simulation.simulated_person import simulate_person
    from drocap_ros.skeleton import BODY_15
    from drocap_ros.tracks import Tracks

    t = np.arange(frames) / 24.0
    person = simulate_person(t, action="walk", seed=0)
    rotation, _ = orbit_camera(t, person[:, 0], radius_m=6.0, height_m=2.0, speed_deg_s=25.0)
    camera = (person - person[:, :1]) @ np.swapaxes(rotation, 1, 2)
    noise = np.random.default_rng(0).normal(0.0, 3.0, (frames, 15, 2))
    stamp_ns = np.round(t * 1e9).astype(np.int64)
    return Tracks(400.0 * camera[..., :2] + 600.0 + noise, BODY_15.joints, stamp_ns, (1280, 1024))


def machine() -> dict[str, Any]:
    import numpy as np

    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "load_average": os.getloadavg()[0],
        "memory_gb": round(memory, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def markdown(result: dict[str, Any]) -> str:
    m = result["machine"]
    lines = [
        "# Reconstruction: times over length",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_gb']} GB, {m['system']}, Python {m['python']}, numpy {m['numpy']};"
        f" load average at the end {m['load_average']:.1f} (where it is above 1, trust the processor time).",
        "",
        "| method | threads | frames | start, ms/frame | adjustment, s | total, s | cpu, s | memory above start, MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['method']} | {r['threads']} | {r['frames']} | {r['initial_ms_per_frame']:.2f} | {r['ba_s']:.3f} |"
        f" {r['total_s']:.3f} | {r['cpu_s']:.3f} | {r['extra_memory_mb']:.0f} |"
        for r in result["rows"]
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
