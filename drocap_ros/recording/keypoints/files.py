"""2D keypoints out of the files of other tools, as tracks of one person.

JSON (OpenPose, AlphaPose, COCO, MMPose, MediaPipe, TensorFlow.js) is searched for points, frames and persons wherever
they stand; tables and arrays take the same way.  Joints are those named, else in the order that makes a body.
"""

from __future__ import annotations

import contextlib
import csv
import logging
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.perception.sources.image_files import SUFFIXES, natural, of_one_recording
from drocap_ros.recording.keypoints.content import HIGHEST_SCORE, LARGEST_PX, Content, read_arrays, walk
from drocap_ros.recording.keypoints.frames import (
    Label,
    numbers_of,
    one_person,
    seconds_of,
)
from drocap_ros.recording.keypoints.orders import counts, name_points
from drocap_ros.recording.keypoints.tables import is_keypoint_table, read_json, read_table, read_yolo
from drocap_ros.tracks import MAX_FRAMES, Tracks, kind_of, load_tracks, read_npz, save_tracks, without_unseen

logger = logging.getLogger(__name__)

#: Arrays of our own tracks files.
_OWN = {"joints", "stamp_ns", "image_size"}
_ARRAYS = (".npz", ".npy")
#: Images per second, assumed where a file does not say.
_USUAL_HZ = 30.0
#: Coordinates that are all within it are shares of the picture.
_LARGEST_SHARE = 2.0


def is_keypoint_file(path: Path) -> bool:
    """Whether a file, by its name and for ``.csv`` its first row, or a folder of JSON or of text holds 2D keypoints."""
    if path.is_dir():
        there = [p.suffix.lower() for p in path.glob("[!.]*")]
        few = 2 * there.count(".json") < len(there) or not {*SUFFIXES, ".npz", ".mcap", ".db3"}.isdisjoint(there)
        return (".json" in there and not few) or set(there) == {".txt"}
    if path.suffix.lower() in (".csv", ".tsv") and path.is_file():
        return is_keypoint_table(path)
    return path.suffix.lower() in (".npz", ".npy", ".json", ".jsonl", ".pkl", ".h5")


class Stated(NamedTuple):
    """What a user says of a file; None where nothing.

    rate_hz, size : images per second, and their width and height px
    order : of the joints
    subject : number of the person by the frames that show him, from 1 on
    """

    rate_hz: float | None = None
    size: tuple[int, int] | None = None
    order: str | None = None
    subject: int | None = None


@contextlib.contextmanager
def as_tracks_file(path: Path, stated: Stated) -> Iterator[Path]:
    """The input itself, or for another tool's keypoints a tracks file of them that is there for the time being."""
    arrays = read_npz(path, ()) if path.suffix == ".npz" and path.is_file() else {}
    own = arrays.keys() >= _OWN and stated.order is None
    if not is_keypoint_file(path) or not path.exists() or kind_of(arrays) in ("motion", "MoCap") or own:
        if stated.order is not None:
            raise InputError(f"--order {stated.order}: expected a file of 2D keypoints, found {path}; leave it out")
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        save_tracks(Path(folder) / f"{path.stem}.npz", read_keypoints(path, stated))
        yield Path(folder) / f"{path.stem}.npz"


def read_keypoints(path: Path, stated: Stated = Stated()) -> Tracks:  # noqa: B008  # immutable
    """Tracks of a file of our own, or of the person in most frames of another tool's.

    What is not stated is the file's; else 30 images per second, a person in the middle, and the order of the joints
    that makes a body.  Where the size is known, a network's file is of pictures of a lens.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError("expected a file of 2D keypoints, found a pipe or device; name a file")
        content = _content(path, own=stated.order is None)
        if isinstance(content, Tracks):
            return content if stated.rate_hz is None else content.at_rate(stated.rate_hz)
        return _tracks(path, content, stated)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except (OSError, ValueError, EOFError, RecursionError, MemoryError, csv.Error) as error:
        raise InputError(f"{path}: expected 2D keypoints; {first_line(error)}; check the file") from None


def _content(path: Path, *, own: bool) -> Content | Tracks:
    content, suffix, damaged = Content(), path.suffix.lower(), 0
    if path.is_dir():
        files = sorted(path.glob("[!.]*.json")) or sorted(path.glob("[!.]*.txt"))
        for file in files[: MAX_FRAMES + 1]:
            content.frames.append(file.stem.removesuffix("_keypoints"))
            try:
                walk(read_json(file)[0] if file.suffix == ".json" else read_yolo(file), content.frames[-1], content)
            except ValueError:  # the frame is a gap
                damaged += 1
    elif suffix in (".json", ".jsonl"):
        node, damaged = read_json(path)
        walk(node, None, content)
    elif suffix in (".csv", ".tsv"):
        walk(list(read_table(path)), None, content)
    elif suffix in _ARRAYS:
        arrays = {"keypoints": np.load(path, allow_pickle=False)} if suffix == ".npy" else read_npz(path, ())
        if own and arrays.keys() >= _OWN:
            return load_tracks(path)
        read_arrays(arrays, content)
    else:
        raise InputError(f"expected keypoints as JSON, CSV, .npz or .npy, found {suffix}; save them as one of these")
    if damaged and content.people:
        logger.warning("%s: damaged in %d places: read what is whole", path, damaged)
    return content


def _tracks(path: Path, content: Content, stated: Stated) -> Tracks:
    """Tracks of the person in most frames; warns of what is assumed."""
    frames, points = _series(path, content, stated.subject)
    rate_hz, size = stated.rate_hz or content.rate_hz, stated.size or content.size
    at_s = None if rate_hz else seconds_of(content.times, frames)
    scores, third = np.nan_to_num(points[..., 2]), points[..., 3]
    if scores.max(initial=0.0) > HIGHEST_SCORE:  # per cent, or a heat map's unit
        scores = scores / scores.max()
    spatial = content.space or bool((third < 0).any() or np.nanmax(third, initial=0.0) > HIGHEST_SCORE)
    if stated.size is None and size is not None and np.nanpercentile(points[..., :2], 90) > 1.2 * max(size):
        size = None  # of something else than the picture
    xy = _pixels(points[..., :2], size, spatial)
    names, words = name_points(xy, content.names, stated.order, content.tool)
    # Networks see pictures; arrays come from anywhere.  A guessed size of the picture gives no lens: where keypoints
    # are of a part about the person, it would be far too short.
    pictures = size is not None and path.suffix.lower() not in _ARRAYS
    assumed = [] if rate_hz or at_s is not None else [f"{_USUAL_HZ:g} images per second (--rate HZ)"]
    if size is None:
        middle, end = np.nanmedian(xy, axis=(0, 1)), np.nanmax(xy, axis=(0, 1))
        size = tuple(np.ceil(np.clip(np.maximum(2 * middle, end), 1, LARGEST_PX)).astype(int).tolist())
        assumed.append(f"the person in the middle of images of {size[0]}x{size[1]} px (--image-size WxH)")
    if words:
        logger.warning("%s: %s", path, words)
    if assumed:
        logger.warning("%s: the file does not say, assumed: %s", path, ", ".join(assumed))
    used = len(names)
    return Tracks(
        keypoints=without_unseen(path, xy[:, :used], np.array(size)),
        joints=names,
        stamp_ns=np.round(
            1e9 * at_s if at_s is not None else (frames - frames[0]) * (1e9 / (rate_hz or _USUAL_HZ))
        ).astype(np.int64),
        image_size=(size[0], size[1]),
        confidence=np.clip(scores[:, :used], 0.0, 1.0),
        real_lens=pictures,
    )


def _pixels(xy: np.ndarray, size: tuple[int, int] | None, spatial: bool) -> np.ndarray:
    """Points (F, P, 2) in px; those in shares of the picture are scaled, those in no picture refused."""
    hint = ", as of 3D poses" if spatial else ""
    low, high = float(np.nanmin(xy)), float(np.nanmax(xy))
    below = (xy[np.isfinite(xy).all(axis=2)] < 0).mean(axis=0)
    # Of two coordinates in px along each axis: who is cut off is so at one side.
    # Share of coordinates below zero from which they are about a middle, where half are: of a person whose head is
    # above the picture every sixth is.
    if (below.mean() if spatial or high <= _LARGEST_SHARE else below.min()) > 0.3:
        raise InputError(
            f"expected px of the whole picture, found coordinates from {low:.4g} to {high:.4g}{hint}, about a middle;"
            " convert them to px, x right and y down from the picture's corner; of 3D poses take their 2D keypoints"
        )
    if high <= _LARGEST_SHARE:
        if size is None:
            raise InputError(
                f"expected px, found shares of the picture{hint}; give `drocap reconstruct` its size with --image-size"
                " WxH"
            )
        return xy * size
    seen = xy[np.isfinite(xy).any(axis=(1, 2))]
    extent = float(np.median(np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1), axis=0).max())
    # No network sees a person of fewer px.
    if extent < 6.0:
        raise InputError(f"expected px, found a person of {extent:.3g}{hint}, as in metres; convert them to px")
    return xy


def _series(path: Path, content: Content, subject: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (F,) of the frames, and the person's points (F, P, 4), NaN where unseen."""
    if content.by_name:
        more = [((0, len(content.names) - len(points)), (0, 0)) for _, _, points in content.people]
        content.people = [(f, who, np.pad(points, pad, constant_values=np.nan) if pad[0][1] > 0 else points)
                          for (f, who, points), pad in zip(content.people, more, strict=True)]  # fmt: skip
    counted = Counter(n for _, n in {(f, len(p)) for f, _, p in content.people})
    if not counted:
        found = "3D poses; take the 2D keypoints of the pictures" if content.space else "none; check the file"
        raise InputError(f"expected 2D keypoints of a person, found {found}")
    # Hands and faces may stand beside a body.
    count = max(counted, key=lambda n: (counted[n], n in (len(content.names), *counts()), n))
    frames, people = _by_time(path, content, count)
    chosen, words = one_person(people, subject)
    if words:
        logger.warning("%s: %s", path, words)
    missing = np.full((count, 4), np.nan)
    return frames, np.stack([chosen.get(frame, missing) for frame in frames.tolist()])


def _by_time(path: Path, content: Content, count: int) -> tuple[np.ndarray, list[tuple[int, Label, np.ndarray]]]:
    """Numbers (F,) of the frames, gaps filled up, and the persons of ``count`` points by these numbers."""
    labels = {frame: content.pictures.get(frame, frame) for frame in content.frames}
    names = list(dict.fromkeys(labels.values()))
    kept, words = of_one_recording(names, list(map(str, names)))
    if not any(labels[frame] in kept for frame, _, _ in content.people):  # its names say nothing of the persons
        kept, words = names, ""
    if words:
        logger.warning("%s: %s", path, words)
    numbers = numbers_of(sorted(kept, key=natural) if content.pictures else kept)
    people = [(numbers[labels[f]], who, p) for f, who, p in content.people if len(p) == count and labels[f] in numbers]
    frames = np.unique(list(numbers.values()))
    step = np.gcd.reduce(np.diff(frames)) if len(frames) > 1 else 1
    # Frames so many times as far apart as they are many are no video's.
    if (frames[-1] - frames[0]) // step < min(10 * len(frames), MAX_FRAMES):
        frames = np.arange(frames[0], frames[-1] + 1, step)
    return frames, people
