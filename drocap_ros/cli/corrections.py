"""What the options ``--corrections`` and ``--video`` of ``drocap reconstruct`` name."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.corrections import Corrections

#: Number of the only person, which none of several has.
ONE = 0


def videos_of(args: argparse.Namespace, inputs: list[Path]) -> list[Path]:
    """Images of tracks, for each input or for none."""
    from drocap_ros.motion import people_files

    given = args.video or []
    videos: list[Path] = given if isinstance(given, list) else [given]  # `drocap batch` takes one
    if len(videos) not in (0, len(inputs)):
        raise InputError(f"--video: expected one for each INPUT, {len(inputs)}, found {len(videos)}; name each")
    for video, path in zip(videos, inputs, strict=False):
        if not video.exists():
            raise InputError(f"--video {video}: expected the images of tracks, found no such file; correct it")
        if path.suffix != ".npz" and not people_files(path, "tracks.npz"):
            raise InputError(f"--video {video}: expected the images of tracks as INPUT, found {path.name}; correct it")
    return videos


def corrections_of(args: argparse.Namespace, people: tuple[int, ...] | None) -> dict[int, Corrections]:
    """By hand, of several persons by their numbers, or of one."""
    from drocap_ros.corrections import FILE, load_corrections
    from drocap_ros.motion import people_files

    if (path := args.corrections) is None:
        return {}
    if args.method == "live":
        raise InputError(f"--corrections {path}: expected another method than live; leave one of them out")
    if people is None:
        return {ONE: load_corrections(path / FILE if path.is_dir() else path)}
    if not (files := people_files(path, FILE)):
        raise InputError(f"--corrections {path}: expected a folder of person_N/{FILE}, found none; name it")
    return {number: load_corrections(file) for number, file in files.items()}


def corrections_together(args: argparse.Namespace, motions: list[str]) -> list[Corrections]:
    """Of each recording, beside its motion in a folder; of a file the first one's."""
    from drocap_ros.corrections import FILE, Corrections, load_corrections
    from drocap_ros.motion import beside

    if (path := args.corrections) is None:
        return [Corrections()] * len(motions)
    if not path.is_dir():
        return [load_corrections(path), *[Corrections()] * (len(motions) - 1)]
    files = [beside(path / motion, FILE) for motion in motions]
    if not any(file.exists() for file in files):
        raise InputError(f"--corrections {path}: expected {FILE} beside its motions, found none; name a folder with it")
    return [load_corrections(file) if file.exists() else Corrections() for file in files]
