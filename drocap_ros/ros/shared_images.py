"""Decoded images in memory that nodes of one machine share: the estimator need not decode what image_ingest has read.

The JPEG messages go to everybody as before; who finds no image here by its stamp decodes one.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from pathlib import Path

import numpy as np
from rclpy.node import Node

_FOLDER = Path("/dev/shm")
_SLOTS = 8  # images: those that may wait, and one that is copied
_SHARE = 0.5  # of the free memory there, at most: a container has 64 MiB
_HEAD = 3 + _SLOTS  # numbers before the pixels: height, width, images written, and the stamp in each slot


class SharedImages:
    """A ring of the newest images of a node's graph, by its domain and namespace; one node writes, others read."""

    def __init__(self, node: Node) -> None:
        place = f"{node.context.get_domain_id()}{node.get_namespace()}"
        name = "".join(c if c.isalnum() else "_" for c in place)
        self._path = _FOLDER / f"drocap_{os.getuid()}_{name}"
        self._memory: mmap.mmap | None = None
        self._inode = self._refused = 0

    def put(self, stamp_ns: int, image: np.ndarray) -> None:
        """Write an image (H, W, 3) uint8; where there is no room it is left out."""
        there = self._path.exists()  # a reader that ends removes the file: its writer may have been killed
        if self._memory is None or not there or tuple(self._head()[:2]) != image.shape[:2]:
            self._create(image)
        if self._memory is None:
            return
        head = self._head()
        slot = int(head[2]) % _SLOTS
        head[3 + slot] = 0  # who copies that one meanwhile finds another stamp afterwards
        self._pixels(slot)[:] = image
        head[3 + slot], head[2] = stamp_ns, head[2] + 1

    def get(self, stamp_ns: int) -> np.ndarray | None:
        """A copy of the image of a stamp; None = it is not here."""
        with contextlib.suppress(OSError, ValueError):
            stat = self._path.stat()
            if stat.st_ino != self._inode:
                self._memory, self._inode = None, 0
                if stat.st_uid == os.getuid():
                    with self._path.open("r+b") as file:
                        self._memory, self._inode = mmap.mmap(file.fileno(), 0), stat.st_ino
            if self._memory is not None:
                head = self._head()
                for slot in np.flatnonzero(head[3:_HEAD] == stamp_ns)[:1]:
                    image = self._pixels(int(slot)).copy()
                    if head[3 + slot] == stamp_ns:
                        return image
        return None

    def close(self) -> None:
        """Release the memory, and remove its file."""
        if self._memory is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
        self._memory, self._inode = None, 0

    def _create(self, image: np.ndarray) -> None:
        """A new ring for images of this size."""
        size = _HEAD * 8 + _SLOTS * image.nbytes
        if self._refused == size:
            return
        self.close()
        with contextlib.suppress(OSError):
            free = os.statvfs(_FOLDER)
            if size > _SHARE * free.f_bavail * free.f_frsize:
                self._refused = size
                return
            new = self._path.with_suffix(".new")
            with contextlib.suppress(FileNotFoundError):
                new.unlink()
            with open(os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600), "r+b") as file:
                os.posix_fallocate(file.fileno(), 0, size)
                self._memory, self._inode = mmap.mmap(file.fileno(), size), os.fstat(file.fileno()).st_ino
            self._head()[:2] = image.shape[:2]
            new.rename(self._path)

    def _head(self) -> np.ndarray:
        assert self._memory is not None
        return np.frombuffer(self._memory, np.int64, _HEAD)

    def _pixels(self, slot: int) -> np.ndarray:
        assert self._memory is not None
        height, width = (int(n) for n in self._head()[:2])
        count = height * width * 3
        at = _HEAD * 8 + slot * count
        return np.frombuffer(self._memory, np.uint8, count, at).reshape(height, width, 3)
