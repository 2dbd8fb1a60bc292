"""Signals that end a command: SIGTERM as Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set instead of interrupting the program."""
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interruptible(*signals: signal.Signals) -> Iterator[threading.Event]:
    """SIGTERM interrupts the program as Ctrl-C does, so that no half-written file remains.

    ``signals`` (default: SIGINT and SIGTERM) raise KeyboardInterrupt and set the event: an exception in a destructor,
    for one, is lost.
    """
    interrupted = threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        raise KeyboardInterrupt

    taken = signals or (signal.SIGINT, signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread():
        taken = ()  # Python permits handlers in the main thread only
    before = {number: signal.signal(number, interrupt) for number in taken}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
