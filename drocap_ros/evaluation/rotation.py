"""The paper's camera-motion study: MoCap seen by orbits of several speeds, reconstructed by every method."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import MotionErrors, compare
from drocap_ros.evaluation.protocol import Progress, orbit_view, reported
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.mocap import Sequence
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.reconstruct import reconstruct

#: Speeds of the paper's table, deg/s.
SPEEDS_DEG_S = (0.0, 10.0, 25.0, 50.0)


@dataclass(frozen=True)
class RotationRow:
    """One sequence, seen at one speed, by one method.

    limb_spread : standard deviation over mean of each limb's length, averaged; 0 for a rigid skeleton
    seconds_initial, seconds_adjust : wall-clock of the two stages; NaN where the method does not say it
    """

    sequence: str
    method: str
    speed_deg_s: float
    noisy: bool
    errors: MotionErrors
    limb_spread: float
    seconds_initial: float
    seconds_adjust: float


def measure(sequence: Sequence, method: str, speed_deg_s: float, noisy: bool, seed: int = 0) -> RotationRow:
    """Reconstruct one view of one sequence and compare it with the truth."""
    view = orbit_view(sequence.x, speed_deg_s, noisy=noisy, seed=seed)
    motion = reconstruct(view.tracks, method=method)
    lengths = limb_lengths(motion.joints3d)
    return RotationRow(
        sequence=sequence.name,
        method=method,
        speed_deg_s=float(speed_deg_s),
        noisy=noisy,
        errors=compare(motion, view.truth / 1000.0, view.tracks.stamp_ns * 1e-9, "camera"),
        limb_spread=float(np.mean(lengths.std(axis=0) / lengths.mean(axis=0))),
        seconds_initial=float(motion.meta["seconds"].get("initial", math.nan)),
        seconds_adjust=float(motion.meta["seconds"].get("ba", math.nan)),
    )


def rotation_study(
    sequences: list[Sequence],
    *,
    speeds_deg_s: Iterable[float] = SPEEDS_DEG_S,
    methods: Iterable[str] = METHODS,
    noisy: bool = False,
    seed: int = 0,
    processes: int = 1,
    progress: Progress | None = None,
) -> list[RotationRow]:
    """Every sequence at every speed by every method, in a fixed order."""
    speeds = [float(s) for s in speeds_deg_s]
    for speed in speeds:
        if not abs(speed) <= 360.0:
            raise InputError(f"--speeds: expected -360 to 360 deg/s, got {speed:g}; choose slower orbits")
    if processes < 1:
        raise InputError(f"--processes: expected at least 1, got {processes}")
    jobs = [(q, method, speed, noisy, seed) for method in methods for speed in speeds for q in sequences]
    if processes == 1:
        return list(reported(starmap(measure, jobs), len(jobs), "rotation study", progress))
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # Forked children would inherit locked mutexes of onnxruntime's and BLAS's threads.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(reported(pool.map(measure, *zip(*jobs, strict=True)), len(jobs), "rotation study", progress))
