"""Errors and results of the studies as CSV, Markdown and plots."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from drocap_ros.evaluation.compare import MotionErrors, WorldErrors
from drocap_ros.evaluation.metrics import JOINT_GROUPS
from drocap_ros.evaluation.recordings import RecordingRow
from drocap_ros.evaluation.rotation import RotationRow
from drocap_ros.evaluation.world import WorldRow, world_means
from drocap_ros.evaluation.world_protocol import WorldCase

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Row = TypeVar("_Row", RotationRow, RecordingRow)
_LABELS = {
    "ba": "default (`ba`)",
    "paper": "paper: bundle adjustment",
    "paper-no-articulation": "paper without articulation",
    "initial": "paper: single-view initialization",
    "mf-nnm": "MF+NNM",
}
#: Speed of the tables per joint group and per sequence, deg/s: that of the demo's orbit.
_SPEED_DEG_S = 25.0
#: Column -> error in the world, its factor and its form.
_WORLD = {
    "PA-MPJPE mm": ("pa_mm", 1, ".1f"),
    "MPJPE mm": ("mpjpe_mm", 1, ".1f"),
    "W-MPJPE mm": ("w_mm", 1, ".0f"),
    "WA-MPJPE mm": ("wa_mm", 1, ".0f"),
    "not aligned mm": ("absolute_mm", 1, ".0f"),
    "RTE %": ("root_percent", 1, ".1f"),
    "scale %": ("scale", 100, "+.1f"),
    "horizon deg": ("horizon_deg", 1, ".1f"),
    "still feet m/s": ("foot_m_s", 1, ".2f"),
    "mm per frame": ("foot_mm", 1, ".1f"),
    "penetration mm": ("penetration_mm", 1, ".0f"),
    "acceleration ratio": ("acceleration_ratio", 1, ".2f"),
    "acceleration error m/s^2": ("acceleration_error_m_s2", 1, ".1f"),
    "in 90 % ellipsoid": ("coverage", 1, ".0%"),
    "about the mean place": ("coverage_about", 1, ".0%"),
}
WORLD_HEAD = list(_WORLD)


def label(method: str) -> str:
    """Name of a method in tables and plots."""
    return _LABELS.get(method, method)


def markdown_table(head: list[str], lines: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)]


def world_cells(e: WorldErrors) -> list[str]:
    """Cells under :data:`WORLD_HEAD`; "-" where an error is not known."""
    return [_cell(factor * getattr(e, name), form) for name, factor, form in _WORLD.values()]


def _cell(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


def save_csv(path: Path, records: Sequence[Mapping[str, object]]) -> None:
    """One line per record under a head; floats with four decimals."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(dict.fromkeys(itertools.chain.from_iterable(records))))
        writer.writeheader()
        for record in records:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in record.items()})


def errors_record(e: MotionErrors | WorldErrors) -> dict[str, object]:
    """Errors as columns for :func:`save_csv`, those in the world after ``world_``."""
    record: dict[str, object] = asdict(e)
    if isinstance(e, MotionErrors):
        del record["per_group_mm"], record["world"]
        record |= {f"world_{key}": value for key, value in asdict(e.world).items()} if e.world else {}
        record |= {f"{group}_mm": value for group, value in e.per_group_mm.items()}
    return record


def study_record(row: RotationRow | WorldRow | RecordingRow) -> dict[str, object]:
    """One result of a study as columns for :func:`save_csv`."""
    return {key: value for key, value in vars(row).items() if key != "errors"} | errors_record(row.errors)


def comparison_markdown(name: str, e: MotionErrors) -> str:
    """Errors of one motion as Markdown."""
    head = ["motion", "frames", "error mm", *(f"{g} mm" for g in JOINT_GROUPS), "toe mm"]
    line = [name, str(e.frames), f"{e.error_mm:.1f}", *(f"{e.per_group_mm[g]:.1f}" for g in JOINT_GROUPS)]
    more = ["scale error", "scale is", "mirrored", "mirrored frames"]
    scale, mirrored = "measured" if e.metric else "assumed", "yes" if e.mirrored else "no"
    rest = [f"{e.scale_error:+.1%}", scale, mirrored, f"{e.mirrored_share:.1%}"]
    tables = [*markdown_table(head, [[*line, _cell(e.toe_mm, ".1f")]]), "", *markdown_table(more, [rest])]
    if e.world is not None:
        tables += ["", *markdown_table(WORLD_HEAD, [world_cells(e.world)])]
    return "\n".join(tables) + "\n"


def rotation_markdown(rows: list[RotationRow]) -> str:
    """Error over speed, error per joint group, and error per sequence, as Markdown."""
    speeds = sorted({r.speed_deg_s for r in rows})
    speed = _SPEED_DEG_S if _SPEED_DEG_S in speeds else speeds[-1]
    by_method = _by_method(rows)
    by_speed = [_speed_cells(method, of, speeds) for method, of in by_method.items()]
    at_speed = _by_method([r for r in rows if r.speed_deg_s == speed])
    per_sequence = [_sequence_cells(same) for same in zip(*at_speed.values(), strict=True)]
    kind = "noisy" if rows[0].noisy else "clean"
    lines = [
        f"Reconstruction error in mm, mean over {len(per_sequence)} sequences, {kind} 2D, by orbit speed in deg/s.",
        "",
        *markdown_table(["method", *(f"{s:g}" for s in speeds), "mirrored"], by_speed),
        *("", f"Per joint group at {speed:g} deg/s, mm.", ""),
        *markdown_table(["method", *JOINT_GROUPS, "toe"], list(starmap(_group_cells, at_speed.items()))),
        *("", f"Per sequence at {speed:g} deg/s, mm.", ""),
        *markdown_table(["sequence", *(label(m) for m in by_method)], per_sequence),
    ]
    return "\n".join(lines) + "\n"


def _sequence_cells(rows: tuple[RotationRow, ...]) -> list[str]:
    """The sequence and its error by every method."""
    return [rows[0].sequence, *(f"{r.errors.error_mm:.1f}" for r in rows)]


def _speed_cells(method: str, rows: list[RotationRow], speeds: list[float]) -> list[str]:
    return [label(method), *(f"{_mean_mm(rows, s):.1f}" for s in speeds), str(sum(r.errors.mirrored for r in rows))]


def recordings_markdown(rows: list[RecordingRow]) -> str:
    """The paper's tables: mean error by method and recording, and per joint group; errors in the world where known."""
    by_method, names = _by_method(rows), list(dict.fromkeys(row.sequence for row in rows))
    means = {m: np.mean([row.errors.error_mm for row in of]) for m, of in by_method.items()}
    cells = [
        [label(m), *(f"{row.errors.error_mm:.1f}" for row in of), f"{means[m]:.1f}"] for m, of in by_method.items()
    ]
    lines = [
        *("Reconstruction error in mm.", ""),
        *markdown_table(["method", *names, "mean"], cells),
        *("", "Per joint group, mm.", ""),
        *markdown_table(["method", *JOINT_GROUPS, "toe"], list(starmap(_group_cells, by_method.items()))),
    ]
    placed = [(f"{r.sequence}, {label(r.method)}", r.errors.world) for r in rows if r.errors.world is not None]
    if placed:
        world = [[name, *world_cells(errors)] for name, errors in placed]
        lines += ["", "In the world.", "", *markdown_table(["recording, method", *WORLD_HEAD], world)]
    return "\n".join(lines) + "\n"


def _by_method(rows: list[_Row]) -> dict[str, list[_Row]]:
    return {method: [r for r in rows if r.method == method] for method in dict.fromkeys(r.method for r in rows)}


def _mean_mm(rows: list[RotationRow], speed: float) -> float:
    return float(np.mean([r.errors.error_mm for r in rows if r.speed_deg_s == speed]))


def _group_cells(method: str, rows: list[_Row]) -> list[str]:
    """The method and its mean error per joint group and of the toes, "-" where no row knows it."""
    errors = [r.errors for r in rows]
    groups: list[np.floating] = [np.mean([e.per_group_mm[group] for e in errors]) for group in JOINT_GROUPS]
    toes = [e.toe_mm for e in errors if not np.isnan(e.toe_mm)]
    return [label(method), *(f"{g:.1f}" for g in groups), f"{np.mean(toes):.1f}" if toes else "-"]


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


def save_curves(path: Path, rows: list[RotationRow]) -> None:
    """Error over orbit speed, one curve per method, as PNG."""
    figure, axes = _plot(6.4, 4.2)
    for method, found in _by_method(rows).items():
        speeds = sorted({r.speed_deg_s for r in found})
        axes.plot(speeds, [_mean_mm(found, s) for s in speeds], marker="o", label=label(method))
    axes.set(xlabel="orbit speed, deg/s", ylabel="reconstruction error, mm")
    axes.set_title(f"{len({r.sequence for r in rows})} sequences, {'noisy' if rows[0].noisy else 'clean'} 2D")
    axes.set_ylim(bottom=0)
    axes.legend()
    figure.savefig(path, dpi=120)


def save_group_bars(path: Path, e: MotionErrors) -> None:
    """Error per joint group as PNG."""
    figure, axes = _plot(6.4, 3.6)
    axes.bar(list(JOINT_GROUPS), [e.per_group_mm[g] for g in JOINT_GROUPS])
    axes.set_ylabel("error, mm")
    figure.savefig(path, dpi=120)


def _plot(width: float, height: float) -> tuple[Figure, Axes]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.grid(alpha=0.3)
    return figure, axes
