"""Signals that end a command: SIGTERM as Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

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
