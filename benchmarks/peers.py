"""Images per core-second of `drocap track` and of peers on the same clip: `python benchmarks/peers.py`.

Each runs in turn, as often as the others, in a process of its own; what counts is the processor time from the first
image to the last.  Peers are mediapipe up to 0.10.21 (BlazePose in its wheel, one person) and rtmlib (its light
detector and pose network, all persons, which it downloads), both one image after another with decoding by OpenCV; one
that is not installed, in this Python or in that of `--python`, is left out.  What drocap tracks are the subject and
the scene's fixed points.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from figures import ROOT, table, write_figures

SHARED = ROOT.parent / "shared"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", type=Path, default=SHARED / "media" / "outdoor_walk.mp4")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the peers")
    parser.add_argument("--one", choices=PIPELINES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(*PIPELINES[args.one](str(args.clip)))
        return 0
    found: dict[str, list[float]] = {name: [] for name in PIPELINES}
    for _ in range(args.rounds):
        for name, rates in found.items():
            if (rate := run(name, args)) is not None:
                rates.append(rate)
    medians = {name: statistics.median(rates) for name, rates in found.items() if rates}
    rows = [
        (name, f"{rate:.1f}", f"{medians['drocap'] / rate:.2f}", f"{min(found[name]):.1f} to {max(found[name]):.1f}")
        for name, rate in medians.items()
    ]
    missing = [f"{name} is not installed, or has no networks." for name in found if name not in medians]
    head = ("pipeline", "images per core-second, median", "drocap over it", "range")
    text = table(head, rows) + "\n" + " ".join(missing)
    print(text)
    write_figures("peers", f"2D tracking of {args.clip.name} beside peers", text)
    return 0


def run(name: str, args: argparse.Namespace) -> float | None:
    """Images per second of processor time; None where the pipeline cannot run."""
    python = sys.executable if name == "drocap" else args.python
    command = [python, __file__, "--one", name, "--clip", str(args.clip)]
    threads = {"OPENCV_FOR_THREADS_NUM": "1", "OMP_NUM_THREADS": "1"}
    environment = {**os.environ, **threads, "DROCAP_MODELS": str(SHARED / "models")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{name}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}", file=sys.stderr)
        return None
    images, seconds = done.stdout.split()[-2:]
    return int(images) / float(seconds)


def drocap(clip: str) -> tuple[int, float]:
    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.sources import open_source
    from drocap_ros.perception.track_video import observe

    estimator = PoseEstimator(models_folder(""))
    begin = time.process_time()
    with open_source(clip) as source:
        return len(observe(source, estimator)), time.process_time() - begin


def mediapipe(clip: str) -> tuple[int, float]:
    import cv2
    import mediapipe as mp

    with mp.solutions.pose.Pose(model_complexity=1) as pose:
        return each_image(clip, lambda image: pose.process(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)))


def rtmlib(clip: str) -> tuple[int, float]:
    from rtmlib import Body

    return each_image(clip, Body(mode="lightweight", backend="onnxruntime", device="cpu"))


def each_image(clip: str, work: Callable[..., object]) -> tuple[int, float]:
    """Number of images, and seconds of processor time of reading and working on them."""
    import cv2

    video = cv2.VideoCapture(clip)
    begin, count = time.process_time(), 0
    while (read := video.read())[0]:
        work(read[1])
        count += 1
    return count, time.process_time() - begin


PIPELINES: dict[str, Callable[[str], tuple[int, float]]] = {
    "drocap": drocap, "mediapipe": mediapipe, "rtmlib": rtmlib,
}  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
