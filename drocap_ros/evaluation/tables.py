"""Results of the studies as CSV, Markdown and plots."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.evaluation.compare import MotionErrors
from drocap_ros.evaluation.metrics import JOINT_GROUPS
from drocap_ros.evaluation.rotation import StudyRow
from drocap_ros.evaluation.world_errors import WORLD_HEAD, world_cells

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABELS = {
    "ba": "default (`ba`)",
    "paper": "paper: bundle adjustment",
    "paper-no-articulation": "paper without articulation",
    "initial": "paper: single-view initialization",
    "mf-nnm": "MF+NNM",
}


def markdown_table(head: list[str], lines: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)]


def save_csv(path: Path, records: Sequence[Mapping[str, object]]) -> None:
    """One line per record under a head; floats with four decimals."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]))
        writer.writeheader()
        for record in records:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in record.items()})


def mean_errors(rows: list[StudyRow]) -> dict[tuple[str, float], float]:
    """Mean error in mm over sequences, by (method, speed)."""
    keys = dict.fromkeys((r.method, r.speed_deg_s) for r in rows)
    return {key: float(np.mean([r.error_mm for r in rows if (r.method, r.speed_deg_s) == key])) for key in keys}


def study_markdown(rows: list[StudyRow]) -> str:
    """Error over speed, error per joint group, and error per sequence, as Markdown."""
    methods = list(dict.fromkeys(r.method for r in rows))
    speeds = sorted({r.speed_deg_s for r in rows})
    mean = mean_errors(rows)
    count = len({r.sequence for r in rows})
    kind = "noisy" if rows[0].noisy else "clean"
    lines = [f"Reconstruction error in mm, mean over {count} sequences, {kind} 2D, by orbit speed in deg/s.", ""]
    lines += markdown_table(
        ["method", *(f"{s:g}" for s in speeds), "mirrored"],
        [
            [LABELS[m], *(f"{mean[m, s]:.1f}" for s in speeds), str(sum(r.mirrored for r in rows if r.method == m))]
            for m in methods
        ],
    )
    speed = 25.0 if 25.0 in speeds else speeds[-1]
    lines += ["", f"Per joint group at {speed:g} deg/s, mm.", ""]
    lines += markdown_table(
        ["method", *JOINT_GROUPS, "toe"],
        [
            [LABELS[m], *(_mean_cell([getattr(r, f"{g}_mm") for r in at]) for g in (*JOINT_GROUPS, "toe"))]
            for m in methods
            if (at := [r for r in rows if r.method == m and r.speed_deg_s == speed])
        ],
    )
    lines += ["", f"Per sequence at {speed:g} deg/s, mm.", ""]
    by = {(r.sequence, r.method): r.error_mm for r in rows if r.speed_deg_s == speed}
    lines += markdown_table(
        ["sequence", *(LABELS[m] for m in methods)],
        [[q, *(f"{by[q, m]:.1f}" for m in methods)] for q in dict.fromkeys(r.sequence for r in rows)],
    )
    return "\n".join(lines) + "\n"


def _mean_cell(values: list[float | None]) -> str:
    """Mean of the known values, "-" without any."""
    known = [v for v in values if v is not None and not np.isnan(v)]
    return f"{np.mean(known):.1f}" if known else "-"


def comparison_markdown(name: str, e: MotionErrors) -> str:
    """Errors of one motion as Markdown."""
    head = ["motion", "frames", "error mm", *(f"{g} mm" for g in JOINT_GROUPS), "toe mm"]
    line = [name, str(e.frames), f"{e.error_mm:.1f}", *(f"{e.per_group_mm[g]:.1f}" for g in JOINT_GROUPS)]
    line.append(_mean_cell([e.toe_mm]))
    more = ["scale error", "scale is", "mirrored", "mirrored frames", "W-MPJPE mm", "horizon deg"]
    rest = [
        f"{e.scale_error:+.1%}",
        "measured" if e.metric else "assumed",
        "yes" if e.mirrored else "no",
        f"{e.mirrored_share:.1%}",
        *("-" if np.isnan(v) else f"{v:.1f}" for v in (e.w_error_mm, e.horizon_deg)),
    ]
    tables = [*markdown_table(head, [line]), "", *markdown_table(more, [rest])]
    if e.world is not None:
        tables += ["", *markdown_table(WORLD_HEAD, [world_cells(e.world)])]
    return "\n".join(tables) + "\n"


def comparison_record(name: str, e: MotionErrors) -> dict[str, object]:
    """Errors of one motion as a record for :func:`save_csv`."""
    record: dict[str, object] = {"motion": name, **asdict(e)}
    del record["per_group_mm"], record["world"]
    if e.world is not None:
        record |= {f"world_{key}": value for key, value in asdict(e.world).items()}
    return record | {f"{group}_mm": value for group, value in e.per_group_mm.items()}


def save_curves(path: Path, rows: list[StudyRow]) -> None:
    """Error over orbit speed, one curve per method, as PNG."""
    figure, axes = _plot(6.4, 4.2)
    mean = mean_errors(rows)
    for method in dict.fromkeys(r.method for r in rows):
        speeds = sorted({r.speed_deg_s for r in rows if r.method == method})
        axes.plot(speeds, [mean[method, s] for s in speeds], marker="o", label=LABELS[method])
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
