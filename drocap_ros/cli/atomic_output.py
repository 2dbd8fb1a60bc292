"""Output files and folders that are written atomically."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from drocap_ros.errors import InputError


def check_output_folder(target: Path) -> None:
    """Validate an output folder before the work starts.

    Raises
    ------
    InputError
        When it is a file, or its nearest existing parent is not writable.
    """
    if target.exists() and not target.is_dir():
        raise InputError(f"--out {target}: expected a folder, found a file; choose another name")
    parent = target if target.exists() else target.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"--out {target}: expected a writable folder; choose another")


@contextlib.contextmanager
def output_folder(target: Path) -> Iterator[Path]:
    """A temporary folder; its files are moved to ``target`` together when the block succeeds."""
    check_output_folder(target)
    parent = target.absolute().parent
    parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=parent))
    try:
        work.chmod(0o755)
        yield work
        if target.exists():
            for path in work.iterdir():
                _replace(path, target / path.name)
        else:
            work.rename(target)
    finally:
        shutil.rmtree(work, ignore_errors=True)


@contextlib.contextmanager
def output_file(target: Path) -> Iterator[Path]:
    """A temporary file, moved to ``target`` when the block succeeds; an existing file is replaced.

    Raises
    ------
    InputError
        When the target is a folder, or its folder is not writable.
    """
    if target.is_dir():
        raise InputError(f"--out {target}: expected a file, found a folder; name a file in it")
    parent = target.absolute().parent
    check_output_folder(parent)
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=parent) as work:
        path = Path(work) / target.name
        yield path
        path.replace(target)


def _replace(path: Path, target: Path) -> None:
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)
    path.replace(target)
