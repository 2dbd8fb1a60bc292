"""Where a batch's recordings run: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import sys
import threading
from collections.abc import Generator, Sequence
from concurrent.futures.process import BrokenProcessPool

from drocap_ros.cli.batch.recording import Record, Task, failure, reconstruct_recording
from drocap_ros.errors import DrocapError, InputError

#: A process of a recording begins as a fork of a server with these modules.
_PRELOAD = (
    "drocap_ros.cli.reconstruct",
    "drocap_ros.pipeline",
    "drocap_ros.report.page",
    "scipy.linalg.lapack",
    "scipy.ndimage",
    "cv2",
)
#: Attempts after an unexpected error, such as one of the file system: three in all (docs/batch.md).
_RETRIES = 2
#: Longest wait for the scheduler, s; a judgement.
_CONNECT_S = 20.0


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

    Raises
    ------
    InputError
        When dask.distributed is not installed, or no scheduler answers.
    DrocapError
        When the scheduler is lost.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        install = f"{sys.executable} -m pip install 'drocap_ros[cluster]'"
        raise InputError(f"--cluster: expected dask.distributed, found none; run {install}") from None
    try:
        client = Client(address, timeout=_CONNECT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"--cluster {address}: expected the address of a Dask scheduler; {error}") from None
    with client:
        threads = client.nthreads()  # type: ignore[no-untyped-call]
        print(f"{len(threads)} workers at {address}, dashboard {client.dashboard_link}", file=sys.stderr)
        if any(count > 1 for count in threads.values()):
            print("workers with several threads use one of them; start them with --nthreads 1", file=sys.stderr)
        futures = client.map(reconstruct_recording, tasks, pure=False, retries=_RETRIES)
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
