"""Figures of the live graph: `python benchmarks/live.py`, or some of its parts by name.

load    a 1280x720 video at 30 fps in a loop through all nodes, with adjustment and recording: rate, drops, latency
        from the image's stamp to pose3d/initial, the adjustment's duration, processor time, with the adjuster and
        without (`--seconds 300`; `--processes` or `--one-process`, `--no-adjuster` for one case; `--seamless`: no
        cuts, so that a subject is tracked all the time; `--slow 1 2 3`: also on a machine that is so many times slower,
        by stopping all nodes for that share of every 12 ms: their priorities count as before)
kills   SIGKILL of each node in turn, a person in view all the time: time until it works again, gaps in the recording
        (`--rounds 5`)

Needs ../shared (video, weights).  Writes docs/figures/live_load.md and live_kills.md.  Run it on an
idle machine; the load average before each part is among its figures.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from figures import ROOT, table, write_figures

sys.path[:0] = [str(ROOT)]
SHARED = ROOT.parent / "shared"
TITLES = {
    "load": "Live graph under load",
    "kills": "Restart of killed nodes",
}
PARTS = tuple(TITLES)
NODES = ["image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "session_recorder"]
#: Of a slower machine: stop and go.
TURN_S = 0.012
#: Networks, discovery and the first window take their time: not part of the figures.
WARM_S = 15.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1, help="of the networks: 1 is the best on two cores")
    parser.add_argument("--pose-model", default="auto", help="file in the models folder; auto = the most accurate")
    parser.add_argument("--one-process", action="store_true")
    parser.add_argument("--processes", action="store_true")
    parser.add_argument("--no-adjuster", action="store_true")
    parser.add_argument("--slow", type=float, nargs="+", default=[1.0], metavar="N", help="times slower")
    parser.add_argument("--seamless", action="store_true", help="the video there and back again, without cuts")
    args = parser.parse_args()
    for part in args.parts or PARTS:
        with tempfile.TemporaryDirectory(prefix="drocap_bench_") as folder:
            results = globals()[f"part_{part}"](args, Path(folder))
        write_figures(f"live_{part}", TITLES[part], page(part, results))
    return 0


def show(title: str, figures: dict[str, Any]) -> None:
    print(f"{title}:", *(f"  {key}: {value}" for key, value in figures.items()), sep="\n", flush=True)


def page(part: str, results: dict[str, Any]) -> str:
    """Table of a part's main figures, one row per case or node; then all other figures."""
    if part == "load":
        shown = "pose2d", "pose3d/initial", "pose3d/latest"
        head = ("graph", "images with a result, per s (without one)", *(f"`{t}` p50 / p95 / p99, ms" for t in shown),
                "processors, % of one core")  # fmt: skip
        rows = [
            (
                name,
                f"{f['per second']['pose2d']} ({f['images without keypoints %']} %)",
                *(" / ".join(map(str, f["latency ms p50 / p95 / p99"].get(t, ["-"]))) for t in shown),
                f["CPU %, of one core"]["sum"],
            )
            for name, f in results.items()
        ]
        rest = results
    else:
        head = ("node", "topic", "s from SIGKILL to its first message")
        rows = [(name, SIGNS.get(name, "the next file"), text_of(v)) for name, v in results["seconds"].items()]
        rest = {"recording": {k: v for k, v in results.items() if k != "seconds"}}
    text = table(head, rows)
    for name, figures in rest.items():
        text += f"\n## {name}\n\n{table(('figure', 'value'), ((k, text_of(v)) for k, v in figures.items()))}"
    return text


def text_of(value: Any) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{key} {text_of(inner)}" for key, inner in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


# -- the stream and the graph ------------------------------------------------------------------------------


def stream(folder: Path, seamless: bool = False) -> Path:
    """The walk at 1280x720, 30 fps; seamless = its first 5 s and back again, so that a round loses nobody."""
    import cv2

    path = folder / "walk.mp4"
    source = cv2.VideoCapture(str(SHARED / "media" / "outdoor_walk.mp4"))
    images = []
    while (read := source.read())[0]:
        images.append(cv2.resize(read[1], (1280, 720), interpolation=cv2.INTER_AREA))
    if seamless:
        images = images[:150] + images[148:0:-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (1280, 720))
    for image in images:
        writer.write(image)
    writer.release()
    return path


def graph_config(video: Path, session: Path, port: int, threads: int = 2, pose_model: str = "auto") -> Any:
    from drocap_ros.config import DrocapConfig

    config = DrocapConfig().replace("image_ingest", source=str(video), horizontal_fov_deg=60.0, loop=True)
    models = str(SHARED / "models")
    config = config.replace("pose_estimator", models_dir=models, on_loss="next", threads=threads, pose_model=pose_model)
    config = config.replace("mavlink_bridge", url=f"udpin:127.0.0.1:{port}")
    return config.replace("session_recorder", session_dir=str(session))


@contextlib.contextmanager
def vehicle(port: int) -> Iterator[None]:
    """A simulated autopilot for the bridge, in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "lab.simulation.path_vehicle",
        "--url",
        f"udpout:127.0.0.1:{port}",
    ]
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def family(pid: int) -> list[int]:
    """A process and those that it has started; none that have ended."""
    with contextlib.suppress(OSError):
        lists = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
        return [pid, *(found for child in itertools.chain(*lists) for found in family(int(child)))]
    return []


def usage(pid: int) -> tuple[float, float]:
    """Processor seconds and resident MiB of a process and its children so far."""
    ticks = pages = 0
    for one in family(pid):
        fields = Path(f"/proc/{one}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
        pages += int(Path(f"/proc/{one}/statm").read_text().split()[1])
    return ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@contextlib.contextmanager
def slowed(pids: list[int], times: float) -> Iterator[None]:
    """Run processes and their children on a machine that is so many times slower: they are stopped for that share."""
    if times <= 1.0:
        yield
        return
    script = f"import live; live.stop_and_go({times!r}, {pids!r})"
    process = subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).parent)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def stop_and_go(times: float, pids: list[int]) -> None:
    """Body of the process that stops others, until SIGTERM or its parent's death."""
    with contextlib.suppress(OSError):
        os.nice(-15)
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    parent, turns, found = os.getppid(), 0, list[int]()
    while not ended and os.getppid() == parent:
        if turns % 100 == 0:
            found = [one for pid in pids for one in family(pid)]
        turns += 1
        for order, share in ((signal.SIGSTOP, 1.0 - 1.0 / times), (signal.SIGCONT, 1.0 / times)):
            for pid in found:
                with contextlib.suppress(OSError):
                    os.kill(pid, order)
            time.sleep(TURN_S * share)


def taken_by_host() -> tuple[int, int]:
    """Processor ticks that the host took from this virtual machine, and all ticks."""
    ticks = [int(v) for v in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return ticks[7], sum(ticks)


# -- load --------------------------------------------------------------------------------------------------


def part_load(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The requested cases of the graph, one after the other."""
    video = stream(folder, args.seamless)
    results = {}
    for processes in (False, True):
        if (args.one_process or args.processes) and not (args.processes if processes else args.one_process):
            continue
        for adjuster in (True, False):
            if args.no_adjuster and adjuster:
                continue
            # In one process the one that stops it would stop itself, too.
            for slow in args.slow if processes else [1.0]:
                name = ("processes" if processes else "one process") + ("" if adjuster else ", no adjuster")
                name += f", {slow:g} times slower" if slow > 1.0 else ""
                load = os.getloadavg()[0]
                place = folder / name.replace(" ", "_")
                results[name] = measure_load(video, place, processes, adjuster, args, slow)
                results[name]["load average before"] = round(load, 2)
                show(f"load, {name}, {args.seconds:g} s", results[name])
    return results


def measure_load(
    video: Path, session: Path, processes: bool, adjuster: bool, args: argparse.Namespace, slow: float = 1.0
) -> dict[str, Any]:
    from drocap_ros.bringup import bringup
    from drocap_ros.simulation.vehicle.loopback import free_udp_port

    nodes = [name for name in NODES if adjuster or name != "bundle_adjuster"]
    port = free_udp_port()
    config = graph_config(video, session, port, args.threads, args.pose_model)
    with contextlib.ExitStack() as stack:
        stack.enter_context(vehicle(port))
        graph = stack.enter_context(bringup(config, nodes, processes=processes, respawn=True))
        pids = {graph.pid(name): name if processes else "all nodes" for name in nodes}
        with slowed(list(pids), slow):
            graph.spin_for(WARM_S)
            before, begin_ns = {pid: usage(pid)[0] for pid in pids}, time.time_ns()
            taken = taken_by_host()
            graph.spin_for(args.seconds)
            taken = (taken_by_host()[0] - taken[0], taken_by_host()[1] - taken[1])
            after, end_ns = {pid: usage(pid) for pid in pids}, time.time_ns()
    cpu = {pids[pid]: round(100 * (after[pid][0] - before[pid]) / ((end_ns - begin_ns) * 1e-9)) for pid in pids}
    return {
        **session_figures(session, begin_ns, end_ns),
        "CPU %, of one core": {**cpu, "sum": sum(cpu.values())},
        "processor time taken by the machine's host %": round(100 * taken[0] / max(taken[1], 1), 1),
        "resident MiB": {pids[pid]: round(after[pid][1]) for pid in pids},
    }


def percentiles(late_ms: dict[str, list[float]]) -> dict[str, list[float]]:
    """p50, p95 and p99 of the topics that follow from pictures."""
    import numpy as np

    return {
        topic: [round(float(v), 1) for v in np.percentile(late_ms[topic], [50, 95, 99])]
        for topic in ("image/compressed", "pose2d", "pose3d/initial", "pose3d/latest")
        if topic in late_ms
    }


#: Counters of what a node did not pass on.
NOT_PASSED_ON = (
    "missed", "lost", "not_written", "messages_refused", "images_late", "images_skipped", "adjustments_skipped",
    "keypoints_unpaired", "initial_unpaired",
)  # fmt: skip


def session_figures(session: Path, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """Figures of a span of time from the recorded messages and the nodes' counters.

    Latency is the time from the image's stamp to the publication of a message, by the publisher's middleware.  The
    recorder, whose priority is low, receives it later: a figure of its own.
    """
    import numpy as np
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    from drocap_ros.ros.diagnostics import Key

    stamps: dict[str, list[int]] = {}
    late_ms: dict[str, list[float]] = {}
    received_ms: dict[str, list[float]] = {}
    solve_s, frames, strides = [], [], []
    counts: dict[str, dict[str, str]] = {}
    first: dict[str, dict[str, str]] = {}
    for path in sorted(session.glob("*.mcap"), key=lambda p: int(p.stem.rsplit("_", 1)[1])):
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, record, message in reader.iter_decoded_messages(log_time_order=False):
                topic = channel.topic.removeprefix("/drocap/")
                if topic == "/diagnostics":
                    name = message.status[0].name.rsplit("/", 1)[-1]
                    values = {v.key: v.value for v in message.status[0].values}
                    if record.log_time < begin_ns:
                        first[name] = values
                    elif record.log_time <= end_ns:
                        counts[name] = values
                elif begin_ns <= record.log_time <= end_ns and hasattr(message, "header"):
                    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                    stamps.setdefault(topic, []).append(stamp_ns)
                    late_ms.setdefault(topic, []).append((record.publish_time - stamp_ns) * 1e-6)
                    received_ms.setdefault(topic, []).append((record.log_time - stamp_ns) * 1e-6)
                    if topic == "pose3d/refined":
                        solve_s.append(message.solve_seconds)
                        frames.append(len(message.poses))
                        strides.append(message.stride)
    seconds = (end_ns - begin_ns) * 1e-9
    # Exactly, by stamps: images without a result.
    sent = {stamp for stamp in stamps["camera_info"] if stamp < end_ns - 10**9}
    unseen = len(sent - set(stamps["pose2d"])) / len(sent)
    figures: dict[str, Any] = {
        "per second": {topic: round(len(found) / seconds, 2) for topic, found in stamps.items()},
        "latency ms p50 / p95 / p99": percentiles(late_ms),
        "received by the recorder, ms p50 / p95 / p99": percentiles(received_ms),
    }
    initial = figures["latency ms p50 / p95 / p99"]["pose3d/initial"]
    figures["images without keypoints %"] = round(100 * unseen, 2)
    figures["within the bounds (60 / 120 / 200 ms, 1 %)"] = bool(
        all(late <= bound for late, bound in zip(initial, (60, 120, 200), strict=True)) and unseen <= 0.01
    )
    if solve_s:
        figures["solve s p50 / p95"] = [round(float(v), 3) for v in np.percentile(solve_s, [50, 95])]
        figures["frames per solve, median"] = int(np.median(frames))
        figures["windows that took every 1., 2., 3., 4. image"] = [strides.count(i) for i in (1, 2, 3, 4)]
    lost = {
        f"{name}: {key}": int(value) - int(first.get(name, {}).get(key, 0))
        for name, values in counts.items()
        for key, value in values.items()
        if value.isdigit() and key.partition("/")[0] in NOT_PASSED_ON
    }
    figures["not passed on, by the nodes' counters"] = {key: value for key, value in lost.items() if value}
    seen = {name: int(values.get(Key.IMAGES, 0)) for name, values in counts.items()}
    figures["images counted"] = {
        name: number - int(first.get(name, {}).get(Key.IMAGES, 0)) for name, number in seen.items() if number
    }
    return figures


# -- kills -------------------------------------------------------------------------------------------------

#: Topic whose messages prove that a node works again.
SIGNS = {
    "image_ingest": "camera_info",
    "pose_estimator": "pose2d",
    "initializer": "pose3d/initial",
    "bundle_adjuster": "pose3d/refined",
    "mavlink_bridge": "vehicle/state",
}


def part_kills(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Every node killed while all others run, once in every round; the bringup restarts it."""
    from drocap_ros.bringup import bringup
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.ros.topics import TOPICS
    from drocap_ros.simulation.vehicle.loopback import free_udp_port

    video, session, port = stream(folder, seamless=True), folder / "session", free_udp_port()
    results: dict[str, Any] = {"load average before": round(os.getloadavg()[0], 2)}
    # Stamp of the newest message of each topic, ns, and when it came: what was sent before a death may come after it.
    heard: dict[str, tuple[int, float]] = {}
    killed: dict[str, list[tuple[int, int]]] = {name: [] for name in SIGNS}
    took: dict[str, list[float]] = {name: [] for name in (*SIGNS, "session_recorder")}
    with (
        vehicle(port),
        bringup(graph_config(video, session, port), NODES, processes=True, respawn=True) as graph,
    ):

        def hear(message: Any, topic: str) -> None:
            stamp = message.header.stamp
            heard[topic] = stamp.sec * 10**9 + stamp.nanosec, time.monotonic()

        for topic in SIGNS.values():
            entry = TOPICS[topic]
            graph.node.create_subscription(entry.message, topic, partial(hear, topic=topic), entry.qos)
        graph.wait_until(lambda: len(heard) == len(SIGNS), 60, "every node to work")
        graph.spin_for(5.0)
        for done in range(args.rounds):
            for name, topic in SIGNS.items():
                begin, begin_ns = time.monotonic(), time.time_ns()
                os.kill(graph.pid(name), signal.SIGKILL)
                graph.wait_until(
                    lambda name=name, done=done: graph.restarts[name] > done, 30, f"{name} to be restarted"
                )
                graph.wait_until(lambda topic=topic, t=begin_ns: heard[topic][0] > t, 60, f"{topic} again")
                took[name].append(round(heard[topic][1] - begin, 2))
                killed[name].append((begin_ns, time.time_ns()))
                graph.spin_for(5.0)
        begin = time.monotonic()
        os.kill(graph.pid("session_recorder"), signal.SIGKILL)
        second = session.with_name("session_2")
        graph.wait_until(lambda: any(second.glob("*.mcap")), 60, "the recorder's next folder")
        took["session_recorder"].append(round(time.monotonic() - begin, 2))
        graph.spin_for(5.0)
    results["seconds"] = took
    for folder_ in (session, second):
        with open_session(folder_) as opened:
            info = {t.name.removeprefix("/drocap/"): t.count for t in opened.info.topics if t.count}
            # Telemetry must go on while the nodes of the picture die, and pictures while the bridge does.
            gaps = {}
            for topic, dead in (("vehicle/state", "mavlink_bridge"), ("camera_info", "image_ingest")):
                stamps = (m.header.stamp for _, m in opened.messages((f"/drocap/{topic}",)))
                log = sorted(stamp.sec * 10**9 + stamp.nanosec for stamp in stamps)
                longest = [
                    (int(b - a) * 1e-9)
                    for a, b in itertools.pairwise(log)
                    if not any(a <= end and b >= begin for begin, end in killed[dead])
                ]
                gaps[topic] = round(max(longest, default=float("nan")), 3)
            results[f"{folder_.name}: messages"] = info
            results[f"{folder_.name}: longest gap s, own death aside"] = gaps
    show("kills", results)
    return results


if __name__ == "__main__":
    raise SystemExit(main())
