"""A file that grows by whole commits."""

from __future__ import annotations

import os
from pathlib import Path


class CommittedFile:
    """Output stream of the MCAP writer.

    ``write`` collects; ``commit`` writes the collected bytes.  If that fails (disk full), the file is cut back to the
    last commit: it never ends in half a chunk.

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
        """Offset of the next byte, collected bytes included."""
        return self._committed + len(self._pending)

    def flush(self) -> None:
        """No effect, see :meth:`commit`; the MCAP writer calls it."""

    @property
    def pending(self) -> int:
        """Bytes collected and not yet committed."""
        return len(self._pending)

    def commit(self, sync: bool = False) -> None:
        """Write the collected bytes; ``sync`` forces them to the disk.

        Raises
        ------
        OSError
            When they cannot be written; the file then ends at the last commit.
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
        """Close; bytes that are not committed are lost."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
