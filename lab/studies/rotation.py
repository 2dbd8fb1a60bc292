"""The paper's camera-motion study: MoCap seen by orbits of several speeds, reconstructed by every method."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import compare
from drocap_ros.evaluation.metrics import JOINT_GROUPS
from drocap_ros.evaluation.tables import RecordingRow, by_method, group_cells, label, markdown_table, plot
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.reconstruct import reconstruct
from lab.studies.protocol import Progress, Sequence, orbit_view, reported

#: Speeds of the paper's table, deg/s.
SPEEDS_DEG_S = (0.0, 10.0, 25.0, 50.0)
#: Speed of the tables per joint group and per sequence, deg/s: that of the demo's orbit.
_SPEED_DEG_S = 25.0


@dataclass(frozen=True)
class RotationRow(RecordingRow):
    """One sequence, seen at one speed, by one method.

    limb_spread : standard deviation over mean of each limb's length, averaged; 0 for a rigid skeleton
    seconds_initial, seconds_adjust : wall-clock of the two stages; NaN where the method does not say it
    """

    speed_deg_s: float
    noisy: bool
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


def rotation_markdown(rows: list[RotationRow]) -> str:
    """Error over speed, error per joint group, and error per sequence, as Markdown."""
    speeds = sorted({r.speed_deg_s for r in rows})
    speed = _SPEED_DEG_S if _SPEED_DEG_S in speeds else speeds[-1]
    of_method = by_method(rows)
    by_speed = [_speed_cells(method, of, speeds) for method, of in of_method.items()]
    at_speed = by_method([r for r in rows if r.speed_deg_s == speed])
    per_sequence = [_sequence_cells(same) for same in zip(*at_speed.values(), strict=True)]
    kind = "noisy" if rows[0].noisy else "clean"
    lines = [
        f"Reconstruction error in mm, mean over {len(per_sequence)} sequences, {kind} 2D, by orbit speed in deg/s.",
        "",
        *markdown_table(["method", *(f"{s:g}" for s in speeds), "mirrored"], by_speed),
        *("", f"Per joint group at {speed:g} deg/s, mm.", ""),
        *markdown_table(["method", *JOINT_GROUPS, "toe"], list(starmap(group_cells, at_speed.items()))),
        *("", f"Per sequence at {speed:g} deg/s, mm.", ""),
        *markdown_table(["sequence", *(label(m) for m in of_method)], per_sequence),
    ]
    return "\n".join(lines) + "\n"


def _sequence_cells(rows: tuple[RotationRow, ...]) -> list[str]:
    """The sequence and its error by every method."""
    return [rows[0].sequence, *(f"{r.errors.error_mm:.1f}" for r in rows)]


def _speed_cells(method: str, rows: list[RotationRow], speeds: list[float]) -> list[str]:
    return [label(method), *(f"{_mean_mm(rows, s):.1f}" for s in speeds), str(sum(r.errors.mirrored for r in rows))]


def _mean_mm(rows: list[RotationRow], speed: float) -> float:
    return float(np.mean([r.errors.error_mm for r in rows if r.speed_deg_s == speed]))


def save_curves(path: Path, rows: list[RotationRow]) -> None:
    """Error over orbit speed, one curve per method, as PNG."""
    figure, axes = plot(6.4, 4.2)
    for method, found in by_method(rows).items():
        speeds = sorted({r.speed_deg_s for r in found})
        axes.plot(speeds, [_mean_mm(found, s) for s in speeds], marker="o", label=label(method))
    axes.set(xlabel="orbit speed, deg/s", ylabel="reconstruction error, mm")
    axes.set_title(f"{len({r.sequence for r in rows})} sequences, {'noisy' if rows[0].noisy else 'clean'} 2D")
    axes.set_ylim(bottom=0)
    axes.legend()
    figure.savefig(path, dpi=120)
