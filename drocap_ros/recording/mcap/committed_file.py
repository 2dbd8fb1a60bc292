"""A file that grows by whole pieces: what is written counts only once it is committed."""

from __future__ import annotations

import os
from pathlib import Path


class CommittedFile:
    """Output stream of the MCAP writer.

    ``write`` collects; ``commit`` hands the collected bytes to the system in one go, and if that fails (disk full)
    cuts the file back to the last commit, so that it never ends in half a chunk.

    Raises
    ------
    FileExistsError
        At construction, when the file exists.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._pending = bytearray()
        self._committed = 0

    def write(self, data: bytes) -> int:
        """Collect."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Place of the next byte, counting what is collected."""
        return self._committed + len(self._pending)

    def flush(self) -> None:
        """Nothing: see :meth:`commit`."""

    @property
    def pending(self) -> int:
        """Bytes collected and not yet committed."""
        return len(self._pending)

    def commit(self, sync: bool = False) -> None:
        """Write what is collected; with ``sync``, to the disk itself.

        Raises
        ------
        OSError
            When it cannot be written; the file then ends where it ended before.
        """
        view = memoryview(bytes(self._pending))
        self._pending.clear()
        try:
            place = 0
            while place < len(view):
                place += os.write(self._fd, view[place:])
            if sync:
                os.fdatasync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._committed)
            os.lseek(self._fd, self._committed, os.SEEK_SET)
            raise
        self._committed += len(view)

    def close(self) -> None:
        """Close; what is not committed is lost."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
