"""The paper's camera-motion study: MoCap seen by orbits of several speeds, reconstructed by every method."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import JOINT_GROUPS, group_errors, is_mirrored, mirrored_frames, pa_mpjpe, toe_error
from drocap_ros.evaluation.protocol import orbit_view, protocol_sequences, reported
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.mocap import Sequence
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.reconstruct import reconstruct

SPEEDS_DEG_S = (0.0, 10.0, 25.0, 50.0)


@dataclass(frozen=True)
class StudyRow:
    """One sequence, seen at one speed, by one method.

    error_mm : reconstruction error, mean over frames and the twelve limb joints; the others per joint group; of the
        toes None where truth or method has none
    mirrored, mirrored_share : handedness of the whole sequence, share of mirrored frames
    limb_spread : standard deviation over mean of each limb's length, averaged; 0 for a rigid skeleton
    seconds_initial, seconds_adjust : wall-clock of the two stages
    """

    sequence: str
    method: str
    speed_deg_s: float
    noisy: bool
    frames: int
    error_mm: float
    wrist_mm: float
    elbow_mm: float
    shoulder_mm: float
    hip_mm: float
    knee_mm: float
    ankle_mm: float
    toe_mm: float | None
    mirrored: bool
    mirrored_share: float
    limb_spread: float
    seconds_initial: float
    seconds_adjust: float


def measure(sequence: Sequence, method: str, speed_deg_s: float, noisy: bool, seed: int = 0) -> StudyRow:
    """Reconstruct one view of one sequence and compare it with the truth."""
    view = orbit_view(sequence.x, speed_deg_s, noisy=noisy, seed=seed)
    motion = reconstruct(view.tracks, method=method)
    estimate = motion.joints3d * 1000.0
    groups = group_errors(estimate, view.truth)
    lengths = limb_lengths(estimate)
    seconds = motion.meta["seconds"]
    return StudyRow(
        sequence=sequence.name,
        method=method,
        speed_deg_s=float(speed_deg_s),
        noisy=noisy,
        frames=len(estimate),
        error_mm=float(pa_mpjpe(estimate, view.truth).mean()),
        **{f"{group}_mm": groups[group] for group in JOINT_GROUPS},
        toe_mm=None if np.isnan(toes := toe_error(estimate, view.truth)) else toes,
        mirrored=is_mirrored(estimate, view.truth),
        mirrored_share=float(mirrored_frames(estimate, view.truth).mean()),
        limb_spread=float(np.mean(lengths.std(axis=0) / lengths.mean(axis=0))),
        seconds_initial=float(seconds["initial"]),
        seconds_adjust=float(seconds["ba"]),
    )


def rotation_study(
    folder: Path,
    *,
    speeds_deg_s: Iterable[float] = SPEEDS_DEG_S,
    methods: Iterable[str] = METHODS,
    noisy: bool = False,
    seed: int = 0,
    limit: int | None = None,
    processes: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> list[StudyRow]:
    """Every sequence of at least 5 s of a MoCap folder at every speed by every method, in a fixed order.

    Raises
    ------
    InputError
        When the folder has no such sequence, or a method, speed or number is impossible.
    """
    methods, speeds = tuple(methods), tuple(float(s) for s in speeds_deg_s)
    for method in methods:
        if method not in METHODS:
            raise InputError(f"--methods: expected some of {', '.join(METHODS)}, got {method!r}")
    for speed in speeds:
        if not abs(speed) <= 360.0:
            raise InputError(f"--speeds: expected -360 to 360 deg/s, got {speed:g}; choose slower orbits")
    for name, value in (("limit", limit), ("processes", processes)):
        if value is not None and value < 1:
            raise InputError(f"--{name}: expected at least 1, got {value}")
    sequences = protocol_sequences(folder, limit=limit)
    jobs = [(q, method, speed, noisy, seed) for method in methods for speed in speeds for q in sequences]
    return list(reported(_results(jobs, processes), len(jobs), "rotation study", progress))


def _results(jobs: list[tuple[Sequence, str, float, bool, int]], processes: int) -> Iterator[StudyRow]:
    if processes == 1:
        yield from starmap(measure, jobs)
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # Forked children would inherit locked mutexes of onnxruntime's and BLAS's threads.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from pool.map(measure, *zip(*jobs, strict=True))
