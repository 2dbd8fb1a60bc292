"""Recordings of a batch: key, output folder and record of each, the processes that run them, the page of all."""

from __future__ import annotations

import argparse
import concurrent.futures
import hashlib
import json
import logging
import math
import multiprocessing
import os
import re
import resource
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

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


#: A process of a recording begins as a fork of a server with these modules.
_PRELOAD = (
    "drocap_ros.cli.reconstruct",
    "drocap_ros.pipeline",
    "drocap_ros.report.page",
    "scipy.linalg.lapack",
    "scipy.ndimage",
    "cv2",
)


def run_on_this_machine(tasks: Sequence[Task], jobs: int) -> Generator[Record, None, None]:
    """Records in the order of completion; ``jobs`` recordings at a time, each in a process of its own."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_PRELOAD))
    with concurrent.futures.ThreadPoolExecutor(jobs) as threads:
        futures = [threads.submit(_run_in_process, task, context) for task in tasks]
        try:
            for future in concurrent.futures.as_completed(futures):
                yield future.result()
        finally:
            threads.shutdown(cancel_futures=True)


def _run_in_process(task: Task, context: multiprocessing.context.ForkServerContext) -> Record:
    # One process per recording: a pool fails as a whole when a process dies, and then names no culprit.
    try:
        with concurrent.futures.ProcessPoolExecutor(1, context, _end_with_parent) as pool:
            return pool.submit(reconstruct_recording, task).result()
    except BrokenProcessPool:
        return failure(task, "process ended: out of memory, or a crash in a library; see the system's log")
    except Exception as error:  # noqa: BLE001 - what fails in one recording ends no other one
        return failure(task, f"unexpected {type(error).__name__}: {error}")


def _end_with_parent() -> None:
    """End this process when the batch's process ends, even by SIGKILL."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def run_on_cluster(tasks: Sequence[Task], address: str) -> Generator[Record, None, None]:
    """Records in the order of completion, from the workers of a Dask scheduler.

    The scheduler moves the recordings of a lost worker to another one, up to its ``allowed-failures`` (3) times.

    Raises DrocapError when the scheduler is lost.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        install = f"{sys.executable} -m pip install 'drocap_ros[cluster]'"
        raise InputError(f"--cluster: expected dask.distributed, found none; run {install}") from None
    for again in (True, True, False):
        try:
            # Longest wait for the scheduler; a judgement.
            client = Client(address, timeout=20.0)  # type: ignore[no-untyped-call]
            break
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"--cluster {address}: expected the address of a Dask scheduler; {error}") from None
        except AssertionError:
            # A busy scheduler sends further messages with its greeting, which the library does not expect.
            if not again:
                raise DrocapError(f"--cluster {address}: the scheduler is too busy; start the batch again") from None
    with client:
        threads = client.nthreads()  # type: ignore[no-untyped-call]
        print(f"{len(threads)} workers at {address}, dashboard {client.dashboard_link}", file=sys.stderr)
        if any(count > 1 for count in threads.values()):
            print("workers with several threads use one of them; start them with --nthreads 1", file=sys.stderr)
        # Attempts after an unexpected error, such as one of the file system: three in all (docs/batch.md).
        futures = client.map(reconstruct_recording, tasks, pure=False, retries=2)
        pending = dict(zip(futures, tasks, strict=True))
        del futures
        for future in as_completed(list(pending)):  # type: ignore[no-untyped-call]
            task = pending.pop(future)
            if future.cancelled():
                raise DrocapError(f"--cluster {address}: the scheduler was lost; start the batch again to go on")
            cause = future.exception()
            if isinstance(cause, KilledWorker):
                lost = f"KilledWorker: {cause.allowed_failures + 1} workers ended during this recording"
                yield failure(task, f"{lost}: more memory than a worker's limit, or a crash; see the workers' logs")
            else:
                yield future.result() if cause is None else failure(task, f"{type(cause).__name__}: {cause}")


#: Title, unit, explanation, key of the record, factor, format.
_COLUMNS = (
    ("doubts", "", "automatic checks that doubt the motion", "doubts", 1, "d"),
    (
        "error",
        "% of body",
        "median reprojection error, share of the body's size in the image",
        "error_body",
        100,
        ".2f",
    ),
    ("seen", "% of frames", "frames with a subject", "seen", 100, ".0f"),
    ("bones", "% spread", "spread of bone lengths", "bone_spread", 100, ".1f"),
    ("view", "°", "range of the view of the body", "view_span_deg", 1, ".0f"),
    ("length", "s", "of the recording", "duration_s", 1, ".1f"),
    ("time", "s", "of the reconstruction", "seconds", 1, ".1f"),
    ("memory", "MB", "peak", "peak_memory_mb", 1, ".0f"),
)

#: On top of the report's style.
_STYLE = """
body { max-width: 1560px }
.tiles { grid-template-columns: repeat(3, minmax(0, 180px)); margin-bottom: 14px }
.card { overflow-x: auto }
td, th { padding: 7px 14px; text-align: right; width: auto; white-space: nowrap }
th { cursor: pointer; border-bottom: 2px solid var(--line) }
th:hover { color: var(--accent) }
th i { display: block; font-size: 11.5px; font-style: normal }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left }
td:first-child, th:first-child { position: sticky; left: 0; background: var(--card) }
td:first-child { max-width: min(40vw, 26em); overflow: hidden; text-overflow: ellipsis }
td:last-child { min-width: 18em; white-space: normal }
td { font-variant-numeric: tabular-nums }
a { color: var(--accent) }
tr.failed td:last-child, tr.failed td:first-child { color: var(--right) }
"""

_SCRIPT = """
for (const [column, head] of document.querySelectorAll("th").entries()) {
  let sign = 1;
  head.onclick = () => {
    const body = document.querySelector("tbody");
    const value = (row) => row.cells[column].dataset.v ?? row.cells[column].textContent;
    const compare = (a, b) => a - b || String(a).localeCompare(b);
    sign = -sign;
    body.append(...[...body.rows].sort((a, b) => sign * compare(value(a), value(b))));
  };
}
"""


def save_summary(path: Path, records: Sequence[Record], total: int) -> None:
    """Write the page: failures first, then the most doubtful motions.

    records : of the recordings so far, of ``total``
    """
    failures = sum(record["status"] != "done" for record in records)
    style = (files("drocap_ros.report") / "page" / "style.css").read_text(encoding="utf-8") + _STYLE
    heads = "".join(f'<th title="{escape(text)}">{title}<i>{unit}</i></th>' for title, unit, text, *_ in _COLUMNS)
    counts = {"done": len(records) - failures, "failed": failures, "to do": total - len(records)}
    tiles = "".join(f'<div class="tile"><b>{count}</b><span>{name}</span></div>' for name, count in counts.items())
    rows = "\n".join(map(_row, sorted(records, key=_doubtfulness)))
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>drocap batch: {total} recordings</title>
<style>{style}</style>
<header><h1>{total} recordings</h1><p>A name opens its report, a click on a column's title sorts.</p></header>
<section class="tiles">{tiles}</section>
<section class="card"><table><thead><tr><th>recording</th>{heads}<th>remarks</th></tr></thead>
<tbody>
{rows}
</tbody></table></section>
<script>{_SCRIPT}</script>
</html>
"""
    path.write_text(page, encoding="utf-8", errors="backslashreplace")


def _doubtfulness(record: Record) -> tuple[bool, int, float, str]:
    doubts, error = len(record.get("doubts", ())), record.get("error_body") or 0.0
    return record["status"] == "done", -doubts, -error, record["input"]


def _row(record: Record) -> str:
    name = escape(Path(record["input"]).name)
    link = f'<a href="{quote(record["page"])}">{name}</a>' if "page" in record else name
    cells = "".join(_cell(record.get(key), factor, form) for *_, key, factor, form in _COLUMNS)
    remarks = [record["error"]] if "error" in record else [*record["doubts"], *record["messages"]]
    title = escape(record["input"])
    text = escape("; ".join(remarks))
    return f'<tr class="{record["status"]}"><td title="{title}">{link}</td>{cells}<td>{text}</td></tr>'


def _cell(value: float | list[str] | None, factor: float, form: str) -> str:
    if value is None:
        return '<td data-v="Infinity"></td>'
    return f"<td>{factor * (len(value) if isinstance(value, list) else value):{form}}</td>"
