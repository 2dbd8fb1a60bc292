"""What each ingredient of the default method brings: `python benchmarks/body_ingredients.py`.

Rows of `benchmarks/body.py`, with one ingredient left out at a time; page accuracy_ingredients.  `--every 3` takes
every third sequence only.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from body import ROOT, Score, long_enough, score
from figures import table, write_figures

from drocap_ros.reconstruction.lifted import adjustment, window_solver
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig, lifted_config
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LiftedMotion, LifterInput
from drocap_ros.reconstruction.methods import ba
from lab.studies.protocol import mocap_files

MEASURED = ("clean", "clean, camera's rotation known", "noisy", "correlated noise, covariance given")


def _blind(**unknown: None) -> AbstractContextManager[Any]:
    """The network without some of its inputs."""
    lift = Lifter.lift

    def lift_blind(self: Lifter, seen: LifterInput, fps: float) -> LiftedMotion:
        return lift(self, replace(seen, **unknown), fps)

    return patch.object(Lifter, "lift", lift_blind)


def _with(**values: float) -> AbstractContextManager[Any]:
    """Other parameters of the default method."""

    def config(adjuster: Any, drawn_toes: bool) -> LiftedConfig:
        return replace(lifted_config(adjuster, drawn_toes=drawn_toes), **values)

    return patch.object(ba, "lifted_config", config)


def _signs_of_each_frame(reach: np.ndarray, depth: np.ndarray, *_: Any) -> np.ndarray:
    return np.where(depth < 0, -1.0, 1.0)


LEFT_OUT: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "nothing": nullcontext,
    "rotation of the camera, as an input": lambda: _blind(rotation=None),
    "covariances, as an input": lambda: _blind(covariance=None),
    "bone lengths of the first look, as an input of the second": lambda: _blind(lengths=None),
    "hiding outliers from the second look": lambda: _with(alone_mm=1000.0),
    "both adjustments": lambda: _with(first_iterations=0, iterations=0),
    "constant bone lengths in the adjustment": lambda: patch.object(
        adjustment, "SPAN_STD_MM", np.full(len(adjustment.SPAN_STD_MM), 1e4)
    ),
    "signs chosen over time: the network's in each frame": lambda: patch.object(
        window_solver, "depth_signs", _signs_of_each_frame
    ),
    "accelerations": lambda: _with(acceleration_std_m_s2=1000.0),
    "network's depths in the adjustment": lambda: _with(depth_weight=0.0),
    "network's places in the image in the adjustment": lambda: _with(image_weight=0.01),
    "lighter places where noise is fresh": lambda: _with(fresh_weight=1.0),
}


def score_without(job: tuple[str, Path, str]) -> Score:
    """One sequence of one row."""
    left_out, path, row = job
    with LEFT_OUT[left_out]():
        return score((path, row))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mocap", type=Path, default=ROOT / ".." / "shared" / "mocap" / "dev")
    parser.add_argument("--every", type=int, default=1, help="take every n-th sequence (default 1)")
    parser.add_argument("--processes", type=int, default=1)
    args = parser.parse_args()

    paths = [p for p in mocap_files(args.mocap) if long_enough(p)][:: args.every]
    lines = []
    with multiprocessing.get_context("forkserver").Pool(args.processes) as pool:
        for left_out in LEFT_OUT:
            line = [left_out]
            for row in MEASURED:
                scores = pool.map(score_without, [(left_out, path, row) for path in paths], chunksize=1)
                error, wrong = (np.mean([getattr(s, name) for s in scores]) for name in ("error_mm", "wrong"))
                line.append(f"{error:.1f} ({100 * wrong:.0f} %)")
            lines.append(line)
            print(" | ".join(line), flush=True)
    page = f"{len(paths)} sequences of at least 5 s, their first 10 s: PA mm (frames with a wrong sign).\n\n"
    write_figures(
        "accuracy_ingredients", "Ingredients of the default method", page + table(["left out", *MEASURED], lines)
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
