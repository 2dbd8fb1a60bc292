"""Results of a study as CSV, Markdown and curves."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drocap_ros.evaluation.compare import PairErrors
from drocap_ros.evaluation.metrics import JOINT_GROUPS
from drocap_ros.evaluation.rotation import StudyRow, as_records

LABELS = {
    "ba": "ours (default)",
    "paper": "paper: bundle adjustment",
    "paper-no-articulation": "paper without articulation",
    "initial": "paper: single-view start",
    "mf-nnm": "MF+NNM",
}


def save_csv(path: Path, rows: list[StudyRow]) -> None:
    """One line per sequence, method and speed."""
    records = as_records(rows)
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
        ["method", *JOINT_GROUPS],
        [
            [LABELS[m], *(f"{np.mean([getattr(r, f'{g}_mm') for r in at]):.1f}" for g in JOINT_GROUPS)]
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


def pair_markdown(name: str, e: PairErrors) -> str:
    """Errors of one motion as Markdown."""
    head = ["motion", "frames", "error mm", *(f"{g} mm" for g in JOINT_GROUPS)]
    line = [name, str(e.frames), f"{e.error_mm:.1f}", *(f"{e.per_group_mm[g]:.1f}" for g in JOINT_GROUPS)]
    more = ["scale error", "scale is", "mirrored", "mirrored frames", "W-MPJPE mm", "horizon deg"]
    rest = [
        f"{e.scale_error:+.1%}",
        "measured" if e.metric else "assumed",
        "yes" if e.mirrored else "no",
        f"{e.mirrored_share:.1%}",
        *("-" if np.isnan(v) else f"{v:.1f}" for v in (e.w_error_mm, e.horizon_deg)),
    ]
    return "\n".join([*markdown_table(head, [line]), "", *markdown_table(more, [rest])]) + "\n"


def save_pair_csv(path: Path, name: str, e: PairErrors) -> None:
    """The same as one CSV line under a head."""
    values: dict[str, object] = {"motion": name, "frames": e.frames, "error_mm": f"{e.error_mm:.4f}"}
    values |= {f"{g}_mm": f"{e.per_group_mm[g]:.4f}" for g in JOINT_GROUPS}
    values |= {"w_error_mm": f"{e.w_error_mm:.4f}", "horizon_deg": f"{e.horizon_deg:.4f}"}
    values |= {"mirrored": e.mirrored, "mirrored_share": f"{e.mirrored_share:.4f}"}
    values |= {"scale_error": f"{e.scale_error:.4f}", "metric": e.metric}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(values))
        writer.writeheader()
        writer.writerow(values)


def save_curves(path: Path, rows: list[StudyRow]) -> None:
    """Error over orbit speed, one curve per method, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    mean = mean_errors(rows)
    for method in dict.fromkeys(r.method for r in rows):
        speeds = sorted({r.speed_deg_s for r in rows if r.method == method})
        axes.plot(speeds, [mean[method, s] for s in speeds], marker="o", label=LABELS[method])
    axes.set_xlabel("orbit speed, deg/s")
    axes.set_ylabel("reconstruction error, mm")
    axes.set_title(f"{len({r.sequence for r in rows})} sequences, {'noisy' if rows[0].noisy else 'clean'} 2D")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def save_joint_bars(path: Path, groups: dict[str, dict[str, float]]) -> None:
    """Error per joint group, one set of bars per label, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    width = 0.8 / len(groups)
    for k, (label, errors) in enumerate(groups.items()):
        axes.bar(np.arange(len(errors)) + k * width, list(errors.values()), width, label=label)
    axes.set_xticks(np.arange(len(JOINT_GROUPS)) + 0.4 - width / 2, list(JOINT_GROUPS))
    axes.set_ylabel("error, mm")
    axes.grid(axis="y", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def markdown_table(head: list[str], lines: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)]
