"""Measured figures in one place: every benchmark ends with `write_figures`, the documents link to its pages.

A page names the machine, the date, the revision and the command, so that two pages can be compared.  Short runs belong
elsewhere: `DROCAP_FIGURES=DIR` writes the pages to DIR instead of docs/figures.
"""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Benchmarks measure the sources of this checkout, not an installed package.
sys.path[:0] = [str(ROOT)]

#: What a figure depends on: changes there that are not committed are mentioned beside the revision.
SOURCES = ("drocap_ros", "lab", "benchmarks", "msg", "srv", "setup.py", "pyproject.toml", "requirements.lock")


def write_figures(name: str, title: str, markdown: str) -> Path:
    """Write the page `NAME.md` and return its path; a page of the same measurement is replaced.

    name : file name without ending; one per part of a benchmark that can run alone
    markdown : tables and sentences, without the title and without machine, date and revision
    """
    folder = Path(os.environ.get("DROCAP_FIGURES") or ROOT / "docs" / "figures")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.md"
    head = f"# {title}\n\n`{command()}`, {date.today().isoformat()}, revision {revision()}, {machine()}.\n\n"
    path.write_text(head + markdown.strip() + "\n", encoding="utf-8")
    print(f"written: {path.relative_to(ROOT) if path.is_relative_to(ROOT) else path}", flush=True)
    return path


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    head = list(head)
    lines = (head, ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines) + "\n"


def command() -> str:
    """The command line of this benchmark, absolute paths without their folders."""
    words = (Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])
    return shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])


def revision() -> str:
    """The revision of the checkout, short, and whether the sources differ from it."""
    try:
        short = _git("rev-parse", "--short=7", "HEAD")
        changed = _git("status", "--porcelain", "--", *SOURCES)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{short} with changes not committed" if changed else short


def machine() -> str:
    """Processor, cores that this process may use, and Python."""
    names = [platform.processor() or platform.machine()]
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(encoding="utf-8").splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")] or names
    cores = len(os.sched_getaffinity(0))
    return f"{cores} cores of {names[0]}, Python {platform.python_version()}"


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()
