"""Output files and folders that are written atomically."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from drocap_ros.errors import DrocapError, InputError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def default_folder(source: Path, ending: str) -> Path:
    """Output folder, in the current one, of an input: its name without suffix and leading dots, and the ending."""
    name = source.name if source.is_dir() else source.stem
    return Path(f"{name.lstrip('.') or 'drocap'}_{ending}")


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[str | Path | None], option: str = "--out") -> None:
    """Validate that no output would replace an input of the command."""
    there = [path for path in inputs if path is not None]
    for output in outputs:
        if any(is_same(output, path) for path in there):
            raise InputError(f"{option} {output}: expected a new file, found the command's own input; choose another")


def is_same(output: Path, source: str | Path) -> bool:
    """Whether both exist and are one file."""
    return os.path.exists(output) and os.path.exists(source) and os.path.samefile(output, source)


def check_output_folder(target: Path) -> None:
    """Validate an output folder before the work starts."""
    with _system_errors(target):
        if target.exists() and not target.is_dir():
            raise InputError(f"--out {target}: expected a folder, found a file; choose another name")
        parent = target if target.exists() else target.absolute().parent
        while not parent.exists():
            parent = parent.parent
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise InputError(f"--out {target}: expected a writable folder; choose another")


@contextlib.contextmanager
def output_folder(target: Path) -> Iterator[Path]:
    """A temporary folder; its files are moved to ``target`` together when the block succeeds.

    Raises DrocapError when the disk is full.
    """
    check_output_folder(target)
    real = Path(os.path.realpath(target))
    # An existing target may be a mount, to which no file can be moved from beside it.
    parent = real if real.exists() else real.parent
    with _system_errors(target):
        parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{real.name}.", dir=parent))
    try:
        work.chmod(0o755)
        with _system_errors(target, only=_FULL):
            yield work
        with _system_errors(target):
            if real.exists():
                for path in work.iterdir():
                    _replace(path, real / path.name)
            else:
                work.rename(real)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def check_output_file(target: Path, option: str = "--out") -> None:
    """Validate an output file before the work starts."""
    with _system_errors(target, option):
        if target.is_dir():
            raise InputError(f"{option} {target}: expected a file, found a folder; name a file in it")
        if target.exists() and not target.is_file():
            raise InputError(f"{option} {target}: expected a file, found a pipe or device; name a file")
    check_output_folder(Path(os.path.realpath(target)).parent)


@contextlib.contextmanager
def output_file(target: Path, inputs: Iterable[str | Path | None] = (), option: str = "--out") -> Iterator[Path]:
    """A temporary file, moved to ``target`` when the block succeeds.

    An existing file is replaced, of a link the file that it names.

    Raises DrocapError when the disk is full.
    """
    check_output_file(target, option)
    refuse_inputs([target], inputs, option)
    real = Path(os.path.realpath(target))
    with _system_errors(target, option):
        real.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix=f".{real.name}.", dir=real.parent)
    with folder as work:
        # Some formats hold the name of their file.
        path = Path(work) / target.name
        with _system_errors(target, option, only=_FULL):
            yield path
        with _system_errors(target, option):
            path.replace(real)


@contextlib.contextmanager
def _system_errors(target: Path, option: str = "--out", only: tuple[int, ...] = ()) -> Iterator[None]:
    """Errors of the operating system as one line about the output; ``only`` those numbers, or all."""
    try:
        yield
    except OSError as error:
        if only and error.errno not in only:
            raise
        if error.errno in _FULL:
            raise DrocapError(f"{option} {target}: expected space, found: {error.strerror}; free some") from error
        raise InputError(f"{option} {target}: cannot be written: {error.strerror}; choose another") from error


def _replace(path: Path, target: Path) -> None:
    """Move over what is there; of a folder its files alone, others stay."""
    if target.is_dir() and not target.is_symlink():
        if path.is_dir():
            for file in path.iterdir():
                _replace(file, target / file.name)
            return
        shutil.rmtree(target)
    path.replace(target)
