"""Branches of a simulated flight: many ends of one beginning, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import traceback
from collections.abc import Callable, Iterable
from typing import TypeVar

Result = TypeVar("Result")
Job = TypeVar("Job")


def branch(end: Callable[[], Result]) -> Result:
    """Result of `end`, which may change everything: it runs in a copy of this process.

    Raises
    ------
    RuntimeError
        When it fails there; its trace is on the error output.
    """
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            with os.fdopen(write, "wb") as file:
                pickle.dump(end(), file)
            status = 0
        except BaseException:  # noqa: BLE001 - the child ends here, whatever it is
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(write)
    with os.fdopen(read, "rb") as file:
        data = file.read()
    if os.waitpid(child, 0)[1] != 0:
        raise RuntimeError("a branch of the flight failed")
    result: Result = pickle.loads(data)
    return result


def over_processes(work: Callable[[Job], Result], jobs: Iterable[Job], processes: int) -> Iterable[Result]:
    """`map` over so many processes, in the order of the jobs."""
    if processes <= 1:
        yield from map(work, jobs)
        return
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        yield from pool.imap(work, jobs)
