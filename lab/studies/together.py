"""Study of two cameras: the world protocol's views of one person, whose times and places nobody knows, joined."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.evaluation.compare import world_errors
from drocap_ros.reconstruction.reconstruct import solve
from drocap_ros.reconstruction.together.joined import join_views
from drocap_ros.tracks import Tracks
from lab.studies.protocol import FPS, Progress, Sequence, reported
from lab.studies.world_protocol import WorldCase, world_view

#: Images that the second camera starts later: 1.375 s.
LATER = 33


class TogetherRow(NamedTuple):
    """One sequence: errors mm of the first camera alone and of both, and of the time between their first images."""

    sequence: str
    alone_pa: float
    pa: float
    alone_w: float
    w: float
    scale: float
    coverage: float
    offset_ms: float
    offset_std_ms: float


def together_study(
    sequences: list[tuple[int, Sequence]],
    case: WorldCase,
    progress: Progress | None = None,
    other: WorldCase | None = None,
) -> list[TogetherRow]:
    """Every sequence seen by two cameras; the second one's clock starts with its own first image.

    other : of the second camera; None = that of the first
    """
    return [
        _measure(sequence, (case, other or case), seed)
        for seed, sequence in reported(sequences, len(sequences), "two cameras", progress)
    ]


def _measure(sequence: Sequence, cases: tuple[WorldCase, WorldCase], seed: int) -> TogetherRow:
    first = world_view(sequence, cases[0], seed=seed)
    second = started_later(world_view(sequence, replace(cases[1], camera=1), seed=seed).tracks, LATER)
    solved = [solve(first.tracks), solve(second)]
    alone = world_errors(solved[0].motion.joints3d, first.truth, FPS)
    motion = join_views(solved, ["first", "second"])[0]
    in_world = motion.frame == "world"
    errors = world_errors(motion.joints3d, first.truth, FPS, motion.covariance if in_world else None)
    found = motion.meta["together"]["views"][1]
    return TogetherRow(
        sequence.name,
        alone.pa_mm,
        errors.pa_mm,
        alone.w_mm if solved[0].motion.frame == "world" else float("nan"),
        errors.w_mm if in_world else float("nan"),
        100.0 * errors.scale,
        errors.coverage,
        1e3 * (found["offset_s"] - LATER / FPS),
        1e3 * found["offset_std_s"],
    )


def started_later(tracks: Tracks, images: int) -> Tracks:
    """Tracks without their first images, on a clock of their own."""
    cut = tracks.of_frames(slice(images, len(tracks)))
    return replace(cut, stamp_ns=cut.stamp_ns - cut.stamp_ns[0])


def together_markdown(rows: list[TogetherRow], case: WorldCase, other: WorldCase | None = None) -> str:
    """A table with the means in its last row; offsets and scales by their size."""
    head = (
        "sequence", "PA mm, one", "two", "W-MPJPE100 mm, one", "two", "scale %", "90 % ellipsoids hold",
        "time off by ms", "deviation said ms",
    )  # fmt: skip
    mean = [float(np.mean(np.abs([row[i] for row in rows]))) for i in range(1, len(head))]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    lines += [_line(row.sequence, row[1:]) for row in rows]
    lines.append(_line("mean", mean))
    words = case.words() if other is None else f"{case.words()}; the second camera: {other.words()}"
    return f"## {words}\n\n" + "\n".join(lines) + "\n"


def _line(name: str, values: tuple[float, ...] | list[float]) -> str:
    pa, pa2, w, w2, scale, coverage, late, std = values
    cells = (
        f"{pa:.1f} | {pa2:.1f} | {w:.0f} | {w2:.0f} | {scale:+.1f} | {100 * coverage:.0f} % | {late:+.1f} | {std:.1f}"
    )
    return f"| {name} | {cells} |"
