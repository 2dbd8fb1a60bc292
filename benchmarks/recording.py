"""Figures of the recording: `python benchmarks/recording.py [PART ...]`.

load       recorder node under 1280x720 JPEG 30 Hz + poses 30 Hz + telemetry 50 Hz (`--seconds 300` for the full time)
kills      SIGKILL at random moments, recover, read by three libraries (`--kills 200`)
mutations  mutated copies of a session, tracks and every telemetry format (`--mutations 1000`, `--kinds mp4 csv`)
live       a simulated flight of `--flight 60` s, repeated offline bit for bit

Each part runs in its own processes, so that memory and processor time are those of the part.  Each part writes the page
recording_PART of docs/figures.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from figures import ROOT, table, write_figures
from mutated_files import KINDS, mutations
from recorder_load import make_sources, process_usage, publish_all, watch_process

sys.path[:0] = [str(ROOT), str(ROOT / "test" / "helpers")]
PARTS = ("load", "kills", "mutations", "live")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--mutations", type=int, default=100)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="only these are printed, not written")
    parser.add_argument("--flight", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cell", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.cell:
        print(json.dumps(CELLS[args.cell[0]](*args.cell[1:])))
        return 0
    for part in args.parts or PARTS:
        with tempfile.TemporaryDirectory(prefix="drocap_bench_") as folder:
            globals()[f"part_{part}"](args, Path(folder))
    return 0


def part_mutations(args: argparse.Namespace, folder: Path) -> None:
    results = {kind: cell("mutations", kind, args.mutations, args.seed, folder) for kind in args.kinds}
    head = ("format", "copies", "used", "refused", "faults", "longest, s", "memory, MiB", "memory at the start, MiB")
    rows = [(kind, *list(result.values())[:4], *list(result.values())[5:]) for kind, result in results.items()]
    faults = [f"- {kind} {fault}" for kind, result in results.items() for fault in result["examples"]]
    text = table(head, rows) + "\n" + "\n".join(faults)
    if tuple(args.kinds) == tuple(KINDS):
        write_figures("recording_mutations", "Mutated files", text)
    else:
        print(text)


def cell(*words: object) -> dict[str, Any]:
    """Run a function of CELLS in its own process."""
    done = subprocess.run(
        [sys.executable, __file__, "--cell", *map(str, words)], stdout=subprocess.PIPE, text=True, check=True
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# -- load --------------------------------------------------------------------------------------------------


def part_load(args: argparse.Namespace, folder: Path) -> None:
    """Publishers in this process, the recorder in its own, DDS between them."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from drocap_ros.bringup import bringup
    from drocap_ros.config import DrocapConfig
    from drocap_ros.recording.open_session import session_info

    config = DrocapConfig().replace("session_recorder", session_dir=str(folder / "session"))
    with bringup(config, ["session_recorder"], processes=True) as graph:
        pid = graph.pid("session_recorder")
        node = rclpy.create_node("load", namespace=graph.namespace, context=graph.node.context)
        executor = SingleThreadedExecutor(context=graph.node.context)
        executor.add_node(node)
        sources = make_sources(node)
        graph.wait_until(lambda: all(p.get_subscription_count() for p, *_ in sources), 20, "the recorder to listen")
        usage = [process_usage(pid)]
        begin = time.monotonic()
        thread = threading.Thread(target=watch_process, args=(pid, begin, args.seconds, usage), daemon=True)
        thread.start()
        sent = publish_all(sources, begin, args.seconds)
        thread.join()
        time.sleep(1.0)
        executor.shutdown()
    info = session_info(folder / "session")
    counts = {topic.name.removeprefix("/drocap/"): topic.count for topic in info.topics}
    lost = losses(folder / "session")
    rows = [
        (topic, number, counts.get(topic, 0), ", ".join(f"{key} {lost[key]}" for key in lost if key.endswith(topic)))
        for topic, number in sent.items()
    ]
    cores = (usage[-1][0] - usage[0][0]) / (len(usage) - 1 or 1)
    third = max(1, len(usage) // 3)
    first_mib, last_mib = (max(mib for _, mib in part) for part in (usage[:third], usage[-third:]))
    size_mib = sum(p.stat().st_size for p in (folder / "session").iterdir()) / 2**20
    write_figures(
        "recording_load",
        "Recorder under load",
        f"1280x720 JPEG and poses at 30 Hz, telemetry at 50 Hz, {args.seconds:g} s; load {os.getloadavg()[0]:.1f};"
        f" {cores:.2f} cores used; memory {first_mib:.0f} MiB in the first third, {last_mib:.0f} MiB in the last;"
        f" {size_mib:.0f} MiB written{''.join('; ' + warning for warning in info.warnings)}.\n\n"
        + table(("topic", "sent", "recorded", "losses counted by the recorder"), rows),
    )


def losses(session_dir: Path) -> dict[str, str]:
    """Last loss counters of the recorder on /diagnostics, by key."""
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.ros.diagnostics import Key

    kinds = (Key.LOST, Key.MISSED, Key.NOT_WRITTEN)
    with open_session(session_dir) as session:
        values = (v for _, m in session.messages(("/diagnostics",)) for status in m.status for v in status.values)
        return {v.key: v.value for v in values if v.key.split("/", 1)[0] in kinds}


# -- kills -------------------------------------------------------------------------------------------------


def part_kills(args: argparse.Namespace, folder: Path) -> None:
    from killed_recording import check_recovered, killed_session

    rng = random.Random(args.seed)
    messages, gaps = 0, []
    for i in range(args.kills):
        begun_ns, killed_ns = killed_session(folder / f"s{i}", rng.uniform(0.02, 2.2))
        count, gap_s = check_recovered(folder / f"s{i}", begun_ns, killed_ns)
        messages += count
        gaps.append(gap_s)
        shutil.rmtree(folder / f"s{i}")
    write_figures(
        "recording_kills",
        "Sessions of a killed recorder",
        f"{args.kills} SIGKILLs: {messages} messages recovered, every one in sequence; the last one"
        f" {sorted(gaps)[len(gaps) // 2]:.2f} s before the kill in the median, {max(gaps):.2f} s at worst; three"
        " libraries read all files.",
    )


# -- live against offline ----------------------------------------------------------------------------------


def part_live(args: argparse.Namespace, folder: Path) -> None:
    from captured_flight import captured_config

    from drocap_ros.bringup import bringup
    from drocap_ros.live_replay import reconstruct_live, recorded_config
    from drocap_ros.recording.open_session import open_session

    config = captured_config(folder, args.flight, rate_hz=30.0)
    config = config.replace("session_recorder", session_dir=str(folder / "session"))
    nodes = ["session_player", "initializer", "bundle_adjuster", "session_recorder"]
    with bringup(config, nodes, processes=True) as graph:
        graph.wait_finished("session_player", timeout_s=5 * args.flight + 60)
    with open_session(folder / "session") as session:
        motion, _, agreement = reconstruct_live(session, recorded_config(session) or config)
    initial, windows = agreement.initial, agreement.windows
    write_figures(
        "recording_live",
        "Live graph against its offline repetition",
        f"{args.flight:g} s, {len(motion.joints3d)} frames: {initial[1]} of {initial[0]} published initial poses and"
        f" {windows[1]} of {windows[0]} windows equal, bit for bit.",
    )


CELLS = {"mutations": mutations}

if __name__ == "__main__":
    raise SystemExit(main())
