"""Study of the motion in the world: MoCap by :mod:`world_protocol`, reconstructed with the telemetry that it has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.protocol import FPS, reported
from drocap_ros.evaluation.tables import markdown_table
from drocap_ros.evaluation.world_errors import WORLD_HEAD, WorldErrors, world_cells, world_errors
from drocap_ros.evaluation.world_protocol import TELEMETRY, world_sequences, world_view
from drocap_ros.mocap import Sequence
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.reconstruct import reconstruct


@dataclass(frozen=True)
class WorldRow:
    """One sequence of the study; in frame "camera" it has no errors but PA-MPJPE and scale."""

    sequence: str
    frames: int
    frame: str
    metric: bool
    seconds: float
    errors: WorldErrors


def measure_world(sequence: Sequence, telemetry: str, *, still: bool, seed: int, method: str) -> WorldRow:
    """Reconstruct one view of one sequence and compare it with the truth."""
    view = world_view(sequence, telemetry, still=still, seed=seed)
    motion = reconstruct(view.tracks, method=method)
    errors = world_errors(motion.joints3d, view.truth, FPS, motion.covariance)
    if motion.frame != "world":  # its telemetry was refused: in the camera's axes only the body is comparable
        unknown = dict.fromkeys((field.name for field in fields(WorldErrors)), float("nan"))
        errors = WorldErrors(**unknown | {"pa_mm": errors.pa_mm, "scale": errors.scale})
    return WorldRow(
        sequence.name, len(view.truth), motion.frame, motion.metric, float(motion.meta["seconds"]["total"]), errors
    )


def world_study(
    folder: Path,
    telemetry: str = "exact",
    *,
    still: bool = False,
    seed: int = 0,
    method: str = "ba",
    every: int = 1,
    limit: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[WorldRow]:
    """Every ``every``-th sequence of at least 8 s of a MoCap folder, by name; the choice does not change their seeds.

    Raises
    ------
    InputError
        When the folder has no such sequence, or an argument is impossible.
    """
    if telemetry not in TELEMETRY:
        raise InputError(f"--telemetry: expected one of {', '.join(TELEMETRY)}, got {telemetry!r}")
    if method not in METHODS:
        raise InputError(f"--method: expected one of {', '.join(METHODS)}, got {method!r}")
    for name, value in (("every", every), ("limit", limit)):
        if value is not None and value < 1:
            raise InputError(f"--{name}: expected at least 1, got {value}")
    sequences = world_sequences(folder, every, limit)
    return [
        measure_world(sequence, telemetry, still=still, seed=seed + own, method=method)
        for own, sequence in reported(sequences, len(sequences), "world study", progress)
    ]


def world_means(rows: list[WorldRow]) -> WorldErrors:
    """Means over the sequences that have the error; of the scale, of its absolute value."""

    def mean(name: str) -> float:
        values = np.array([getattr(row.errors, name) for row in rows])
        values = values[~np.isnan(values)]
        return float((np.abs(values) if name == "scale" else values).mean()) if len(values) else float("nan")

    return WorldErrors(**{field.name: mean(field.name) for field in fields(WorldErrors)})


def world_markdown(rows: list[WorldRow], telemetry: str, still: bool) -> str:
    """Errors of every sequence and their means as Markdown."""
    kind = f"{telemetry} telemetry, {'still camera' if still else 'orbit'}"
    lines = [f"Motion in the world, {len(rows)} sequences, {kind}.", ""]
    cells = [[row.sequence, *world_cells(row.errors)] for row in rows]
    lines += markdown_table(["sequence", *WORLD_HEAD], [*cells, ["mean", *world_cells(world_means(rows))]])
    seconds = sum(row.seconds for row in rows) / sum(row.frames for row in rows) * 300
    measured, placed = sum(row.metric for row in rows), sum(row.frame == "world" for row in rows)
    lines += [
        "",
        f"In the world {placed}, with measured scale {measured} of {len(rows)}; {seconds:.2f} s per 300 frames.",
    ]
    return "\n".join(lines) + "\n"
