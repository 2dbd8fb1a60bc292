"""Commands of ``drocap`` that run beside the page, with progress and cancel."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import signal
import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TypeAlias

#: Lines of a command's output that are kept.
_MOST_LINES = 200
#: A line of progress on stderr, as ``DROCAP_PROGRESS`` asks for it, and none on stdout.
_PROGRESS, _SAID = re.compile(r"(-?\d+\.\d{3}) (.*)"), re.compile(r"(?!)")


#: Runs a job with its progress on the page; whether it went well.
Work: TypeAlias = Callable[["Job"], Awaitable[bool]]


@dataclass
class Job:
    """One command line; ``status`` is None while it waits or runs, then its exit status.

    share : of its work that is done, negative while unknown
    lines : what it said
    """

    words: list[str]
    stage: str = ""
    share: float = -1.0
    lines: list[str] = field(default_factory=list)
    status: int | None = None
    _process: asyncio.subprocess.Process | None = None

    @property
    def command(self) -> str:
        """The command as a shell takes it."""
        return shlex.join(["drocap", *self.words])

    async def run(self) -> int:
        """Run to the end; returns the exit status.  A command that is cancelled leaves no half-written file."""
        self._process = process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "drocap_ros.cli", *self.words),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "DROCAP_PROGRESS": "lines"},
        )
        assert process.stdout is not None
        assert process.stderr is not None
        await asyncio.gather(self._read(process.stdout, _SAID), self._read(process.stderr, _PROGRESS))
        self.status = await process.wait()
        return self.status

    async def _read(self, stream: asyncio.StreamReader, progress: re.Pattern[str]) -> None:
        async for raw in stream:
            line = raw.decode(errors="replace").rstrip()
            if found := progress.fullmatch(line):
                self.share, self.stage = float(found[1]), found[2]
            else:
                self.lines = [*self.lines, line][-_MOST_LINES:]

    def cancel(self) -> None:
        """Interrupt it as Ctrl-C does."""
        if self._process is not None and self.status is None:
            self._process.send_signal(signal.SIGTERM)
