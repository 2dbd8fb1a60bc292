"""Progress bars on a terminal, no output in a pipe."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.clip import Progress


@contextlib.contextmanager
def progress_bars(quiet: bool = False, shares: Mapping[str, float] | None = None) -> Iterator[Progress]:
    """A callback that draws one bar per stage on stderr while the context lasts.

    shares : of the time that stages take, in their order: they have one bar together
    """
    if quiet or not sys.stderr.isatty():
        yield lambda _stage, _done: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description:<24}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"))
    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Bars(*columns, *times, console=Console(stderr=True)) as bars:
        tasks: dict[str, TaskID] = {}
        names = list(shares or {})

        reached = 0.0

        def show(stage: str, done: float) -> None:
            nonlocal reached
            key, total = stage, None if done < 0 else 1.0
            if shares and stage in shares:
                before = sum(shares[name] for name in names[: names.index(stage)])
                # Stages that run beside each other: the bar stays with the farthest.
                key, done = "", max(reached, before + shares[stage] * max(done, 0.0))
                reached = done
                total = None if total is None else sum(shares.values())
            if key not in tasks:
                tasks[key] = bars.add_task(stage, total=1.0)
            bars.update(tasks[key], description=stage, completed=done, total=total)

        yield show
