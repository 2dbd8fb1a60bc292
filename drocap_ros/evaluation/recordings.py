"""The paper's tables over a folder of recordings with truth: every method on each of them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.clip import Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import TRUTH_SUFFIXES, MotionErrors, compare, load_truth
from drocap_ros.pipeline import reconstruct_input
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording.telemetry.read import LOG_SUFFIXES

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
