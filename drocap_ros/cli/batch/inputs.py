"""The recordings that the arguments of ``drocap batch`` name: lists, folders, patterns, files."""

from __future__ import annotations

import argparse
import copy
import glob
import itertools
import shlex
from collections.abc import Collection, Iterable
from pathlib import Path

from drocap_ros.cli.options import LineParser
from drocap_ros.errors import InputError

#: Endings by which a folder's recordings are found; a recording that is named itself may end in anything.
_RECORDINGS = (
    ".npz", ".mcap", ".bag", ".db3",
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv", ".mjpeg",
)  # fmt: skip
_LIST = ".txt"


def read_inputs(words: Iterable[str], defaults: argparse.Namespace) -> list[argparse.Namespace]:
    """Arguments of ``drocap reconstruct``, one set per recording.

    Parameters
    ----------
    words : lists (``.txt``), folders, glob patterns and recordings
    defaults : options of ``reconstruct``; a line of a list may change them
    """
    found: list[argparse.Namespace] = []
    for word in words:
        before = len(found)
        for path in [Path(word)] if Path(word).exists() else map(Path, sorted(glob.glob(word, recursive=True))):
            if path.suffix.lower() == _LIST and path.is_file():
                found += _read_list(path, defaults)
            else:
                found += [_arguments(each, defaults) for each in (_in_folder(path) if path.is_dir() else [path])]
        if len(found) == before:
            raise InputError(f"{word}: expected a list, folder, pattern or recording, found none; check the path")
    return found


def _arguments(recording: Path, defaults: argparse.Namespace) -> argparse.Namespace:
    arguments = copy.copy(defaults)
    arguments.input = recording
    return arguments


def _read_list(path: Path, defaults: argparse.Namespace) -> list[argparse.Namespace]:
    """One recording per line, with options of ``reconstruct`` after its path; ``#`` begins a comment line."""
    from drocap_ros.cli.reconstruct import add_options

    parser = LineParser("drocap reconstruct", add_help=False)
    parser.add_argument("input", type=Path)
    add_options(parser)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a text file with one recording per line; {error}") from None
    found = []
    for number, line in enumerate(map(str.strip, lines), 1):
        if not line or line.startswith("#"):
            continue
        if Path(line).exists():  # names with spaces need no quotes
            found.append(_arguments(Path(line), defaults))
            continue
        try:
            found.append(parser.parse_args(shlex.split(line), copy.copy(defaults)))
        except (ValueError, InputError) as error:
            raise InputError(f"{path}:{number}: expected a path and options of reconstruct; {error}") from None
    return found


def _in_folder(folder: Path) -> list[Path]:
    """Recordings at any depth; a session, or a folder of images alone, is one recording."""
    from drocap_ros.perception.sources.image_files import SUFFIXES as IMAGES
    from drocap_ros.recording.mcap.metadata import METADATA_FILE

    if (folder / METADATA_FILE).is_file():
        return [folder]
    entries = sorted(folder.glob("[!.]*"))
    folders = [path for path in entries if path.is_dir() and not path.is_symlink()]
    inside = list(itertools.chain.from_iterable(map(_in_folder, folders)))
    if (folder / "motion.npz").exists():  # the files are a result
        return inside
    files = _of_kinds(entries, _RECORDINGS)
    images_alone = not (files or folders) and _of_kinds(entries, IMAGES)
    return [folder] if images_alone else files + inside


def _of_kinds(entries: list[Path], suffixes: Collection[str]) -> list[Path]:
    return [path for path in entries if path.suffix.lower() in suffixes and path.is_file()]
