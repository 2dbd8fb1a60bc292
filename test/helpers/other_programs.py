"""How much of the machine programs beside the test run use: what watches a clock may fail for that alone."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

#: Environment variable that every process of one run has.
MARK = "DROCAP_TEST_RUN"
_TICKS = os.sysconf("SC_CLK_TCK")


class Moment(NamedTuple):
    """Wall-clock time, and processor time so far of the machine and of this run, s."""

    time_s: float
    machine_s: float
    run_s: float


def moment() -> Moment:
    """The moment now; nothing is known of the machine where there is no ``/proc``: others then use nothing."""
    try:
        fields = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    except OSError:
        return Moment(time.monotonic(), 0.0, 0.0)
    idle, waiting = fields[3:5]
    return Moment(time.monotonic(), (sum(fields) - idle - waiting) / _TICKS, _run_s())


def used_by_others(since: Moment) -> float:
    """Processors that other programs used, or the host took away, on average since a moment."""
    now = moment()
    others = (now.machine_s - since.machine_s) - (now.run_s - since.run_s)
    return max(others, 0.0) / max(now.time_s - since.time_s, 1e-3)


def _run_s() -> float:
    """Processor time of the run's processes, and of their children that have ended."""
    mark = f"{MARK}={os.environ.get(MARK, '')}".encode()
    return sum(_of_run(process, mark) for process in Path("/proc").glob("[0-9]*"))


def _of_run(process: Path, mark: bytes) -> float:
    try:
        if process.name != str(os.getpid()) and mark not in (process / "environ").read_bytes().split(b"\0"):
            return 0.0
        words = (process / "stat").read_text().rpartition(")")[2].split()
        return sum(map(int, words[11:15])) / _TICKS
    except OSError:  # it ended meanwhile, or is another user's
        return 0.0
