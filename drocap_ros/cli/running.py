"""While a command runs: progress bars on a terminal, and signals that end it, SIGTERM as Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.clip import Progress


#: What :func:`signal.signal` takes and gives.
Handler = Callable[[int, FrameType | None], object] | int | None

BOTH = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set instead of interrupting the program."""
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in BOTH}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interruptible(signals: Sequence[signal.Signals] = BOTH) -> Iterator[threading.Event]:
    """SIGTERM interrupts the program as Ctrl-C does, so that no half-written file remains.

    ``signals`` raise KeyboardInterrupt and set the event, and that of an ``interruptible`` around it: an exception in a
    destructor is lost, and one in a C++ library can become another one.
    """
    interrupted = threading.Event()
    before: dict[signal.Signals, Handler] = {}

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        around = before.get(signal.Signals(number))
        if callable(around):
            around(number, frame)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        signals = ()  # Python permits handlers in the main thread only
    for number in signals:
        # A shell's background job ignores Ctrl-C.
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, interrupt)
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


#: Value of the environment's ``DROCAP_PROGRESS`` with which progress is lines for a program: share, space, stage.
PROGRESS_LINES = "lines"


class _Shares:
    """Completed share of work whose stages have known shares of its time, in their order."""

    def __init__(self, shares: Mapping[str, float] | None) -> None:
        self._shares, self._reached = shares or {}, 0.0

    def __call__(self, stage: str, done: float) -> tuple[str, float]:
        """The bar of a stage, one for all that have a share, and its completed share, negative where unknown."""
        if stage not in self._shares:
            return stage, done
        names = list(self._shares)
        before = sum(self._shares[name] for name in names[: names.index(stage)])
        # Stages that run beside each other: the bar stays with the farthest.
        self._reached = max(self._reached, before + self._shares[stage] * max(done, 0.0))
        return "", self._reached / sum(self._shares.values()) if done >= 0 else -1.0


@contextlib.contextmanager
def progress_bars(quiet: bool = False, shares: Mapping[str, float] | None = None) -> Iterator[Progress]:
    """A callback that draws one bar per stage on stderr while the context lasts.

    shares : of the time that stages take, in their order: they have one bar together
    """
    of_all = _Shares(shares)
    if os.environ.get("DROCAP_PROGRESS") == PROGRESS_LINES:
        yield lambda stage, done: print(f"{of_all(stage, done)[1]:.3f} {stage}", file=sys.stderr, flush=True)
        return
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

        def show(stage: str, done: float) -> None:
            key, share = of_all(stage, done)
            if key not in tasks:
                tasks[key] = bars.add_task(stage, total=1.0)
            bars.update(tasks[key], description=stage, completed=max(share, 0.0), total=None if share < 0 else 1.0)

        yield show
