"""One recording of a batch: its key, its output folder, its record."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import math
import os
import re
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import DrocapError, InputError
from drocap_ros.parameters import Values

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

#: In each output folder; the folder appears with it, complete, so its presence means "done".
RECORD_FILE = "record.json"
#: None = unknown.
Record = Values

#: Threads of one cluster worker would share the limit of BLAS threads and the peak of memory.
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A recording to reconstruct.

    arguments : of ``drocap reconstruct`` without its output folder, paths absolute
    out : folder of the batch
    command : command line of the batch
    version : :func:`version` of the batch's process
    digests : of files that many recordings share, so that each is read once
    stat_key : :func:`fingerprint` by names, sizes and times of the files
    """

    arguments: argparse.Namespace
    out: Path
    command: str
    version: str
    digests: dict[Path, str]
    stat_key: str

    @property
    def record(self) -> Record:
        """The record's part that is known before the work."""
        return {"input": str(self.arguments.input), "stat_key": self.stat_key}


def version() -> str:
    """Version of drocap_ros, with its revision where known."""
    from drocap_ros import __version__
    from drocap_ros.revision import git_revision

    revision = git_revision()
    return f"{__version__}+{revision[:12]}" if revision else __version__


def fingerprint(arguments: argparse.Namespace, version: str, of_path: Callable[[Path], str]) -> str:
    """Hash of a version and of every argument, paths by ``of_path``."""
    values = {name: of_path(value) if isinstance(value, Path) else value for name, value in vars(arguments).items()}
    return hashlib.sha256(json.dumps({"": version, **values}, sort_keys=True).encode()).hexdigest()[:16]


def content_digest(path: Path) -> str:
    """Hash of a file's bytes, or of a folder's names and bytes."""
    digest = hashlib.sha256()
    for file in _files(path):
        digest.update(f"{file.relative_to(path)}\0{file.stat().st_size}\0".encode(errors="surrogateescape"))
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def stat_digest(path: Path) -> str:
    """Names, sizes and times of modification: equal while nothing is written."""
    try:
        return repr([(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in _files(path) or [path]])
    except OSError as error:  # the recording's own failure, later
        return f"{path}: {error}"


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path] * path.exists()


def reconstruct_recording(task: Task) -> Record:
    """Reconstruct into the folder NAME-KEY of the batch, unless it exists; the record of the recording.

    Input that cannot be used gives the record of a failure; unexpected errors are raised.
    """
    begin = time.perf_counter()
    with _ONE_AT_A_TIME:
        _reset_peak_memory()
        try:
            if version() != task.version:
                raise InputError(f"worker: expected drocap_ros {task.version}, found {version()}; install the same one")
            return _reconstruct(task, begin)
        except DrocapError as error:
            return failure(task, str(error), time.perf_counter() - begin)


def failure(task: Task, error: str, seconds: float | None = None) -> Record:
    """Record of a failure; ``seconds`` = None where the process is gone.  The error leaves out the input's path."""
    words = " ".join(error.split()).removeprefix(f"{task.arguments.input}: ")
    record = {**task.record, "status": "failed", "error": words}
    return record if seconds is None else {**record, **_costs(seconds)}


def _reconstruct(task: Task, begin: float) -> Record:
    from drocap_ros.cli import reconstruct
    from drocap_ros.cli.atomic_output import output_folder
    from drocap_ros.motion import load_motion

    key = fingerprint(task.arguments, task.version, lambda path: task.digests.get(path) or content_digest(path))
    name = re.sub(r"[^\w-]", "_", task.arguments.input.stem)[:40]
    folder = task.out / f"{name}-{key}"
    if (folder / RECORD_FILE).is_file():
        return {**json.loads((folder / RECORD_FILE).read_text(encoding="utf-8")), **task.record}
    with output_folder(folder) as work:
        own = {"out": work, "quiet": True, "command_line": task.command, "threads": 2}
        with _warnings() as warnings:
            reconstruct.run(argparse.Namespace(**{**vars(task.arguments), **own}))
        figures = quality(load_motion(work / "motion.npz"))
        record = {**task.record, "status": "done", "folder": folder.name, "key": key, **figures, "messages": warnings}
        if (work / "report.html").exists():
            record["page"] = f"{folder.name}/report.html"
        record |= _costs(time.perf_counter() - begin)
        (work / RECORD_FILE).write_text(json.dumps(record) + "\n", encoding="utf-8")
        _flush_to_disk(work)
    return record


def quality(motion: Motion) -> Record:
    """Figures of a motion without a truth, and the titles of the checks that doubt it.

    ``seen`` share of frames with a subject; ``error_body`` median reprojection error over the body's size in the
    image; ``bone_spread`` mean relative standard deviation of bone lengths; ``view_span_deg`` range of the azimuth.
    """
    from drocap_ros.report.checks import Severity, run_checks
    from drocap_ros.report.statistics import mean_known, motion_statistics

    s = motion_statistics(motion)
    values = {
        "duration_s": float(s.times_s[-1]),
        "seen": float(s.seen.mean()),
        "error_px": s.median_px,
        "error_body": s.median_px / s.body_px,
        "bone_spread": float(mean_known(s.bone_spread, None)),
        "view_span_deg": s.view_span_deg,
    }
    return {
        "doubts": [check.title for check in run_checks(motion, s) if check.severity is Severity.WARNING],
        "frames": len(s.times_s),
        **{name: round(value, 4) if math.isfinite(value) else None for name, value in values.items()},
        "frame": motion.frame,
        "metric": motion.metric,
    }


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Log messages of drocap_ros, kept instead of printed."""
    lines: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("drocap_ros")
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.propagate = True
        logger.removeHandler(handler)


def _flush_to_disk(folder: Path) -> None:
    """Write the files out, so that no power cut leaves an empty file behind a complete name."""
    for path in [*folder.iterdir(), folder]:
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)


def _costs(seconds: float) -> Record:
    return {"seconds": round(seconds, 3), "peak_memory_mb": round(_peak_memory_mb(), 1)}


def _reset_peak_memory() -> None:
    # Without it the peak of a worker's earlier recordings counts too.
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory_mb() -> float:
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        status = ""
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return (int(found[1]) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1000
