"""Figures of batches: `python benchmarks/batch.py [PART ...]`.

kills    `--recordings 200` (default 20) tracks and short videos, a twentieth of them broken; SIGKILL three times
cluster  the same on a local Dask cluster; also a killed worker, and a recording that exceeds a worker's memory
equal    the arrays of `reconstruct`, of one process, of four, and of a cluster

Each part writes the page batch_PART of docs/figures.  cluster and equal need dask.distributed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from batch_season import make_season
from figures import ROOT, table, write_figures

PARTS = ("kills", "cluster", "equal")
WORKER_MEMORY = "700MiB"
Fault = Callable[[], None]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []])
    parser.add_argument("--recordings", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the tracks")
    args = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    for part in args.parts or PARTS:
        with tempfile.TemporaryDirectory(prefix="drocap_bench_") as folder:
            globals()[f"part_{part}"](args, Path(folder))
    return 0


def batch(folder: Path | str, out: Path, *words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "drocap_ros.cli", "batch", str(folder), "--out", str(out)]
    command += ["--models", "simulation", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> str:
    printed, errors = process.communicate()
    if process.returncode not in (0, 1):
        raise SystemExit(errors)
    return printed.splitlines()[0]


def log_lines(out: Path) -> list[dict[str, Any]]:
    log = out / "batch.jsonl"
    lines = log.read_text().splitlines() if log.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def wait_for_lines(process: subprocess.Popen[str], out: Path, count: int) -> None:
    while len(log_lines(out)) < count and process.poll() is None:
        time.sleep(0.05)


def write_times(out: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("[!.]*/record.json")}


def load() -> str:
    return f"{os.getloadavg()[0]:.1f}"


def failures_table(out: Path) -> str:
    records = [record for record in log_lines(out) if record["status"] != "done"]
    rows = [(Path(r["input"]).name, r["error"].replace(str(Path(r["input"]).parent) + "/", "")[:150]) for r in records]
    return table(("recording", "error"), sorted(rows))


def count_status(out: Path) -> Counter[str]:
    return Counter(record["status"] for record in log_lines(out))


# -- kills -------------------------------------------------------------------------------------------------


def part_kills(args: argparse.Namespace, folder: Path) -> None:
    good, broken = make_season(folder / "season", args.recordings, args.seconds)
    text = killed_batch(folder / "season", folder / "out", args.recordings, "--jobs", 2)
    write_figures(
        "batch_kills",
        "A batch that is killed three times",
        f"{args.recordings} recordings, {broken} of them broken; `--jobs 2`.\n\n"
        + text
        + outcome(folder / "out", good, broken),
    )


def killed_batch(season: Path, out: Path, recordings: int, *words: object, at_fault: Fault | None = None) -> str:
    """Start the batch four times; SIGKILL ends three of them.  A table; raises when a recording was repeated.

    at_fault : called once, in the middle of the last start
    """
    rows, known = [], {}
    for start in range(4):
        begin = time.monotonic()
        process = batch(season, out, *words)
        # The log begins with what is done, so all lines count.
        wait_for_lines(process, out, round(recordings * (start + (1 if start < 3 else 0.5)) / 4))
        if start < 3:
            time.sleep(random.Random(start).random())
            process.send_signal(signal.SIGKILL)
            process.wait()
            time.sleep(2.0)
        else:
            if at_fault:
                at_fault()
            finish(process)
        times = write_times(out)
        repeated = sum(times[name] != at for name, at in known.items())
        incomplete = sum(not (out / name / "motion.npz").exists() for name in times)
        known = times
        end = "SIGKILL" if start < 3 else f"by itself, status {process.returncode}"
        rows.append((start + 1, end, f"{time.monotonic() - begin:.0f} s", len(times), repeated, incomplete))
    head = ("start", "ended", "after", "recordings done so far", "written again", "incomplete folders")
    return table(head, rows)


def outcome(out: Path, good: int, broken: int) -> str:
    status, lines = count_status(out), log_lines(out)
    inputs, folders = {line["input"] for line in lines}, len(write_times(out))
    return (
        f"\nDone: {status['done']} of {good}; failed: {status['failed']} of {broken}; output folders: {folders};"
        f" lines in the log: {len(lines)}, of {len(inputs)} recordings.\n\n" + failures_table(out)
    )


# -- cluster -----------------------------------------------------------------------------------------------


def part_cluster(args: argparse.Namespace, folder: Path) -> None:
    from distributed import LocalCluster

    good, broken = make_season(folder / "season", args.recordings, args.seconds)
    frames = make_long(folder / "season")
    out = folder / "out"
    killed: list[int] = []
    with LocalCluster(2, threads_per_worker=1, memory_limit=WORKER_MEMORY, dashboard_address=None) as cluster:

        def kill_worker() -> None:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

        words = ("--cluster", cluster.scheduler_address)
        text = killed_batch(folder / "season", out, args.recordings, *words, at_fault=kill_worker)
        restarted = cluster.workers[0].pid not in (None, killed[0])
    write_figures(
        "batch_cluster",
        "A batch on a local Dask cluster",
        f"{args.recordings} recordings, {broken} of them broken, and one of {frames} frames that exceeds a worker's"
        f" memory; two workers of {WORKER_MEMORY}. SIGKILL ends the batch three times and one worker during the fourth"
        f" start; the killed worker was {'' if restarted else 'not '}restarted.\n\n"
        + text
        + outcome(out, good, broken + 1),
    )


def make_long(season: Path) -> int:
    """`walk_long.npz`: the frames of `walk_000.npz` over and over; their number."""
    with np.load(season / "walk_000.npz") as archive:
        arrays = {name: archive[name] for name in ("keypoints", "joints", "image_size")}
    arrays["keypoints"] = np.concatenate([arrays["keypoints"]] * (600_000 // len(arrays["keypoints"])))
    frames = len(arrays["keypoints"])
    np.savez(season / "walk_long.npz", **arrays, stamp_ns=np.arange(frames, dtype=np.int64) * 40_000_000)
    return frames


# -- equal -------------------------------------------------------------------------------------------------


def part_equal(args: argparse.Namespace, folder: Path) -> None:
    from distributed import LocalCluster

    make_season(folder / "season", args.recordings, args.seconds)
    recordings = sorted(path for path in (folder / "season").iterdir() if not path.name.startswith("broken"))
    for path in recordings:
        words = ["reconstruct", path, "--models", "simulation", "--out", folder / "one" / path.stem, "--quiet"]
        subprocess.run([sys.executable, "-m", "drocap_ros.cli", *map(str, words)], check=True)
    outs = {"--jobs 1": folder / "out1", "--jobs 4": folder / "out4", "--cluster": folder / "cluster"}
    finish(batch(folder / "season", outs["--jobs 1"]))
    finish(batch(folder / "season", outs["--jobs 4"], "--jobs", 4))
    with LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        finish(batch(folder / "season", outs["--cluster"], "--cluster", cluster.scheduler_address))
    rows = []
    for name, out in outs.items():
        equal = 0
        for path in recordings:
            (ours,) = out.glob(f"{path.stem}-*")
            equal += arrays_of(ours / "motion.npz") == arrays_of(folder / "one" / path.stem / "motion.npz")
        rows.append((f"`{name}`", f"{equal} of {len(recordings)}"))
    names = sorted(arrays_of(folder / "one" / recordings[-1].stem / "motion.npz"))
    text = f"Recordings whose arrays ({', '.join(names)}) are those of `drocap reconstruct`, byte for byte.\n\n"
    write_figures("batch_equal", "The same arrays everywhere", text + table(("batch", "equal"), rows))


def arrays_of(path: Path) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """Type, shape and bytes of each array; `meta` holds wall-clock times and is left out."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files if name != "meta"}
    return {name: (str(array.dtype), array.shape, array.tobytes()) for name, array in arrays.items()}


if __name__ == "__main__":
    raise SystemExit(main())
