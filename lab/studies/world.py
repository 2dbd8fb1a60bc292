"""Study of the motion in the world: MoCap by :mod:`world_protocol`, reconstructed with the telemetry that it has."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from drocap_ros.evaluation.compare import WorldErrors, place_covariance, world_errors
from drocap_ros.evaluation.tables import WORLD_HEAD, markdown_table, world_cells
from drocap_ros.reconstruction.reconstruct import reconstruct
from lab.studies.protocol import FPS, Progress, Sequence, reported
from lab.studies.world_protocol import WorldCase, world_view


@dataclass(frozen=True)
class WorldRow:
    """One sequence of the study; in frame "camera" it has no errors but PA-MPJPE and scale."""

    sequence: str
    frames: int
    frame: str
    metric: bool
    seconds: float
    errors: WorldErrors


def measure_world(sequence: Sequence, case: WorldCase, *, seed: int, method: str) -> WorldRow:
    """Reconstruct one view of one sequence and compare it with the truth."""
    view = world_view(sequence, case, seed=seed)
    motion = reconstruct(view.tracks, method=method)
    errors = world_errors(motion.joints3d, view.truth, FPS, motion.covariance, place_covariance(motion))
    if motion.frame != "world":  # its telemetry was refused: in the camera's axes only the body is comparable
        unknown = dict.fromkeys((field.name for field in fields(WorldErrors)), float("nan"))
        errors = WorldErrors(**unknown | {"pa_mm": errors.pa_mm, "scale": errors.scale})
    return WorldRow(
        sequence.name, len(view.truth), motion.frame, motion.metric, float(motion.meta["seconds"]["total"]), errors
    )


def world_study(
    sequences: list[tuple[int, Sequence]],
    case: WorldCase | None = None,
    *,
    seed: int = 0,
    method: str = "ba",
    progress: Progress | None = None,
) -> list[WorldRow]:
    """Every sequence of :func:`~lab.studies.world_protocol.world_sequences`, with its own seed."""
    return [
        measure_world(sequence, case or WorldCase(), seed=seed + own, method=method)
        for own, sequence in reported(sequences, len(sequences), "world study", progress)
    ]


def world_means(rows: list[WorldRow]) -> WorldErrors:
    """Means over the sequences that have the error; of the scale, of its absolute value."""

    def mean(name: str) -> float:
        values = np.array([getattr(row.errors, name) for row in rows])
        values = values[~np.isnan(values)]
        return float((np.abs(values) if name == "scale" else values).mean()) if len(values) else float("nan")

    return WorldErrors(**{field.name: mean(field.name) for field in fields(WorldErrors)})


def world_markdown(rows: list[WorldRow], case: WorldCase) -> str:
    """Errors of every sequence and their means as Markdown."""
    cells = [[row.sequence, *world_cells(row.errors)] for row in rows]
    seconds = sum(row.seconds for row in rows) / sum(row.frames for row in rows) * 300
    measured, placed = sum(row.metric for row in rows), sum(row.frame == "world" for row in rows)
    lines = [
        f"Motion in the world, {len(rows)} sequences, {case.words()}.",
        "",
        *markdown_table(["sequence", *WORLD_HEAD], [*cells, ["mean", *world_cells(world_means(rows))]]),
        "",
        f"In the world {placed}, with measured scale {measured} of {len(rows)}; {seconds:.2f} s per 300 frames.",
    ]
    return "\n".join(lines) + "\n"
