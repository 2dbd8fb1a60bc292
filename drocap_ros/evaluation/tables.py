"""The paper's tables over a folder of recordings with truth; errors as CSV, Markdown and plots."""

from __future__ import annotations

import csv
import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import TRUTH_SUFFIXES, MotionErrors, WorldErrors, compare, load_truth
from drocap_ros.evaluation.metrics import JOINT_GROUPS
from drocap_ros.pipeline import reconstruct_input
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording.telemetry.read import LOG_SUFFIXES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


logger = logging.getLogger(__name__)

#: Rows of the paper's table, and the default method.
PAPER_METHODS = ("mf-nnm", "initial", "paper", "ba")
#: Inputs of a recording's own folder, the preferred one first.
_INPUTS = ("tracks.npz", "session")


@dataclass(frozen=True)
class Recording:
    """An input of ``drocap reconstruct`` and the file of its truth."""

    name: str
    source: Path
    truth: Path


@dataclass(frozen=True)
class RecordingRow:
    """One recording by one method."""

    sequence: str
    method: str
    errors: MotionErrors


def find_recordings(folder: Path) -> list[Recording]:
    """Recordings with truth, by name.

    One is a folder with ``truth.npz`` (or ``.c3d``, ``.trc``, ``.bvh``) and ``tracks.npz``, ``session`` or one other
    input, such as that of ``drocap demo``; or a file ``NAME.mp4`` (``.npz``, ...) beside ``NAME_truth.npz`` (...).
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of recordings with truth, found no such folder")
    entries = sorted(folder.glob("[!.]*"))
    found = [one for path in (folder, *(p for p in entries if p.is_dir())) if (one := _of_folder(path))]
    for path in (entry for entry in entries if entry.suffix.lower() not in LOG_SUFFIXES):
        truths = [folder / f"{path.stem}_truth{suffix}" for suffix in TRUTH_SUFFIXES]
        if (truth := next((t for t in truths if t.is_file()), None)) is not None:
            found.append(Recording(path.stem, path, truth))
    if not found:
        raise InputError(
            f"{folder}: expected folders with truth.npz (.c3d, .trc, .bvh) and a recording, or NAME.mp4 (.npz, ...)"
            " beside NAME_truth.npz, found none; name the files so"
        )
    return found


def _of_folder(folder: Path) -> Recording | None:
    """Of a folder with a truth; None without."""
    truth = next((t for suffix in TRUTH_SUFFIXES if (t := folder / f"truth{suffix}").is_file()), None)
    if truth is None:
        return None
    named = [folder / name for name in _INPUTS if (folder / name).exists()]
    results = ("truth", "motion", "report", "compare", "table")
    others = [p for p in sorted(folder.glob("[!.]*")) if p.stem not in results and p.suffix.lower() not in LOG_SUFFIXES]
    if not named and len(others) != 1:
        there = ", ".join(path.name for path in others[:9]) or "none"
        raise InputError(f"{folder}: expected one recording beside {truth.name}, found {there}; leave one there")
    return Recording(folder.name, (named or others)[0], truth)


def recordings_table(
    recordings: Sequence[Recording],
    methods: Iterable[str],
    config: DrocapConfig,
    models: Path | None = None,
    progress: Progress = lambda _stage, _done: None,
) -> list[RecordingRow]:
    """Every method on every recording, whose 2D poses are estimated once; one that cannot be used is left out."""
    rows: list[RecordingRow] = []
    for done, recording in enumerate(recordings):
        progress("recordings", done / len(recordings))
        try:
            rows += _measured(recording, tuple(methods), config, models)
        except InputError as error:  # each takes seconds to minutes
            logger.warning("%s: left out: %s", recording.name, error)
    if not rows:
        raise InputError("evaluate table: expected a recording that can be used, found none; see the lines above")
    return rows


def _measured(
    recording: Recording, methods: tuple[str, ...], config: DrocapConfig, models: Path | None
) -> list[RecordingRow]:
    truth = load_truth(recording.truth)
    first, tracks = reconstruct_input(recording.source, method=methods[0], config=config, models=models)
    initializer, adjuster = config.initializer, config.bundle_adjuster
    others = (reconstruct(tracks, method=m, initializer=initializer, adjuster=adjuster) for m in methods[1:])
    return [
        RecordingRow(recording.name, method, compare(motion, *truth))
        for method, motion in zip(methods, (first, *others), strict=True)
    ]


_Row = TypeVar("_Row", bound=RecordingRow)
_LABELS = {
    "ba": "default (`ba`)",
    "paper": "paper: bundle adjustment",
    "paper-no-articulation": "paper without articulation",
    "initial": "paper: single-view initialization",
    "mf-nnm": "MF+NNM",
}
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


def study_record(row: object) -> dict[str, object]:
    """One row of a table or a study as columns for :func:`save_csv`."""
    record = dict(vars(row))
    return record | errors_record(record.pop("errors"))


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


def recordings_markdown(rows: list[RecordingRow]) -> str:
    """The paper's tables: mean error by method and recording, and per joint group; errors in the world where known."""
    of_method, names = by_method(rows), list(dict.fromkeys(row.sequence for row in rows))
    means = {m: np.mean([row.errors.error_mm for row in of]) for m, of in of_method.items()}
    cells = [
        [label(m), *(f"{row.errors.error_mm:.1f}" for row in of), f"{means[m]:.1f}"] for m, of in of_method.items()
    ]
    lines = [
        *("Reconstruction error in mm.", ""),
        *markdown_table(["method", *names, "mean"], cells),
        *("", "Per joint group, mm.", ""),
        *markdown_table(["method", *JOINT_GROUPS, "toe"], list(starmap(group_cells, of_method.items()))),
    ]
    placed = [(f"{r.sequence}, {label(r.method)}", r.errors.world) for r in rows if r.errors.world is not None]
    if placed:
        world = [[name, *world_cells(errors)] for name, errors in placed]
        lines += ["", "In the world.", "", *markdown_table(["recording, method", *WORLD_HEAD], world)]
    return "\n".join(lines) + "\n"


def by_method(rows: list[_Row]) -> dict[str, list[_Row]]:
    """Rows of each method, in the order of their first ones."""
    return {method: [r for r in rows if r.method == method] for method in dict.fromkeys(r.method for r in rows)}


def group_cells(method: str, rows: Sequence[RecordingRow]) -> list[str]:
    """The method and its mean error per joint group and of the toes, "-" where no row knows it."""
    errors = [r.errors for r in rows]
    groups: list[np.floating] = [np.mean([e.per_group_mm[group] for e in errors]) for group in JOINT_GROUPS]
    toes = [e.toe_mm for e in errors if not np.isnan(e.toe_mm)]
    return [label(method), *(f"{g:.1f}" for g in groups), f"{np.mean(toes):.1f}" if toes else "-"]


def save_group_bars(path: Path, e: MotionErrors) -> None:
    """Error per joint group as PNG."""
    figure, axes = plot(6.4, 3.6)
    axes.bar(list(JOINT_GROUPS), [e.per_group_mm[g] for g in JOINT_GROUPS])
    axes.set_ylabel("error, mm")
    figure.savefig(path, dpi=120)


def plot(width: float, height: float) -> tuple[Figure, Axes]:
    """An empty figure of a size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.grid(alpha=0.3)
    return figure, axes
