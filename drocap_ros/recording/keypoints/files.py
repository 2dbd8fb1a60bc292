"""2D keypoints out of the files of other tools, as tracks of one person.

JSON (OpenPose, AlphaPose, COCO, MMPose, MediaPipe, TensorFlow.js) is searched for points, frames and persons wherever
they stand; DeepLabCut's table and arrays take the same way.  Joints are those named, else of the set of that size.
"""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.keypoints.content import (
    LARGEST_PX,
    NAMES_BY_COUNT,
    Content,
    Label,
    joint_name,
    numbers_of,
    one_person,
    read_arrays,
    table,
    walk,
)
from drocap_ros.tracks import MAX_FRAMES, Tracks, kind_of, load_tracks, read_npz, save_tracks, without_unseen

logger = logging.getLogger(__name__)

#: Arrays of our own tracks files.
_OWN = {"joints", "stamp_ns", "image_size"}
_ARRAYS = (".npz", ".npy")
#: Images per second, assumed where a file does not say.
_USUAL_HZ = 30.0
#: Coordinates that are all within the first are shares of the picture.  Scores beyond the second are no shares of one:
#: some networks exceed 1 a little, and COCO's flags end there.
_LARGEST_SHARE, _HIGHEST_SCORE = 2.0, 2.0
#: Frames so many times as far apart as they are many are no video's.
_SPARSE = 10


def is_keypoint_file(path: Path) -> bool:
    """Whether a file, by its name and for ``.csv`` its first word, or a folder of JSON files, holds 2D keypoints."""
    if path.is_dir():
        return {p.suffix for p in path.iterdir() if not p.name.startswith(".")} == {".json"}
    if path.suffix.lower() == ".csv" and path.is_file():
        with path.open("rb") as file:
            return re.match(rb'(\xef\xbb\xbf)?"?(scorer|bodyparts)\b', file.read(24)) is not None
    return path.suffix.lower() in (".npz", ".npy", ".json", ".pkl", ".h5")


@contextlib.contextmanager
def as_tracks_file(path: Path, rate_hz: float | None, size: tuple[int, int] | None) -> Iterator[Path]:
    """The input itself, or for another tool's keypoints a tracks file of them that is there for the time being."""
    arrays = read_npz(path, ()) if path.suffix == ".npz" and path.is_file() else {}
    if (
        not is_keypoint_file(path)
        or not path.exists()
        or kind_of(arrays) in ("motion", "MoCap")
        or arrays.keys() >= _OWN
    ):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        save_tracks(Path(folder) / f"{path.stem}.npz", read_keypoints(path, rate_hz, size))
        yield Path(folder) / f"{path.stem}.npz"


def read_keypoints(path: Path, rate_hz: float | None = None, size: tuple[int, int] | None = None) -> Tracks:
    """Tracks of a file of our own, or of the person in most frames of another tool's.

    Without ``rate_hz`` and ``size`` (width, height) px these are the file's; else 30 and a person in the middle.  Where
    the size is known, a network's file is of pictures of a lens.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError("expected a file of 2D keypoints, found a pipe or device; name a file")
        content = _content(path)
        if isinstance(content, Tracks):
            return content if rate_hz is None else content.at_rate(rate_hz)
        return _tracks(path, content, rate_hz or content.rate_hz, size or content.size)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except (OSError, ValueError, EOFError, RecursionError, MemoryError, csv.Error) as error:
        raise InputError(f"{path}: expected 2D keypoints; {first_line(error)}; check the file") from None


def _content(path: Path) -> Content | Tracks:
    content, suffix = Content(), path.suffix.lower()
    if path.is_dir():
        for file in sorted(path.glob("*.json"))[: MAX_FRAMES + 1]:
            content.frames.append(file.stem.removesuffix("_keypoints"))
            walk(json.loads(file.read_bytes()), content.frames[-1], content)
    elif suffix == ".json":
        walk(json.loads(path.read_bytes()), None, content)
    elif suffix == ".csv":
        walk(list(table(path)), None, content)
    elif suffix in _ARRAYS:
        arrays = {"keypoints": np.load(path, allow_pickle=False)} if suffix == ".npy" else read_npz(path, ())
        if arrays.keys() >= _OWN:
            return load_tracks(path)
        read_arrays(arrays, content)
    else:
        raise InputError(f"expected keypoints as JSON, CSV, .npz or .npy, found {suffix}; save them as one of these")
    return content


def _tracks(path: Path, content: Content, rate_hz: float | None, size: tuple[int, int] | None) -> Tracks:
    """Tracks of the person in most frames; warns of what is assumed."""
    frames, names, points = _series(path, content)
    xy, scores = points[..., :2], np.nan_to_num(points[..., 2])
    if scores.max(initial=0.0) > _HIGHEST_SCORE:  # per cent, or a heat map's unit
        scores = scores / scores.max()
    if np.nanmax(xy) <= _LARGEST_SHARE:
        if size is None:
            raise InputError("expected px, found shares of the picture; give its size with --image-size WxH")
        xy = xy * size
    # Networks see pictures; arrays come from anywhere.  A guessed size of the picture gives no lens: where keypoints
    # are of a part about the person, it would be far too short.
    pictures = size is not None and path.suffix.lower() not in _ARRAYS
    assumed = [] if rate_hz else [f"{_USUAL_HZ:g} images per second (--rate HZ)"]
    if size is None:
        middle, end = np.nanmedian(xy, axis=(0, 1)), np.nanmax(xy, axis=(0, 1))
        size = tuple(np.ceil(np.clip(np.maximum(2 * middle, end), 1, LARGEST_PX)).astype(int).tolist())
        assumed.append(f"the person in the middle of images of {size[0]}x{size[1]} px (--image-size WxH)")
    if assumed:
        logger.warning("%s: the file does not say, assumed: %s", path, ", ".join(assumed))
    return Tracks(
        keypoints=without_unseen(path, xy, np.array(size)),
        joints=tuple(map(joint_name, names)),
        stamp_ns=np.round((frames - frames[0]) * (1e9 / (rate_hz or _USUAL_HZ))).astype(np.int64),
        image_size=(size[0], size[1]),
        confidence=np.clip(scores, 0.0, 1.0),
        real_lens=pictures,
    )


def _series(path: Path, content: Content) -> tuple[np.ndarray, Sequence[str], np.ndarray]:
    """Numbers (F,) of the frames, names (P) of the joints, and the person's points (F, P, 3), NaN where unseen."""
    counts = Counter(len(points) for _, _, points in content.people)
    if not counts:
        raise InputError("expected 2D keypoints of a person, found none; check the file")
    count = counts.most_common(1)[0][0]
    names = content.names if len(content.names) == count else NAMES_BY_COUNT.get(count, ())
    if not names:
        raise InputError(f"expected points with names, or {', '.join(map(str, NAMES_BY_COUNT))} of them, found {count}")
    frames, people = _by_time(content, count)
    if len({frame for frame, _, _ in people}) < len(people):
        logger.warning("%s: several persons, the one in most frames or the largest is reconstructed", path)
    chosen, missing = one_person(people), np.full((count, 3), np.nan)
    return frames, names, np.stack([chosen.get(frame, missing) for frame in frames.tolist()])[:, : len(names)]


def _by_time(content: Content, count: int) -> tuple[np.ndarray, list[tuple[int, Label, np.ndarray]]]:
    """Numbers (F,) of the frames, gaps filled up, and the persons of ``count`` points by these numbers."""
    numbers = numbers_of(content.frames)
    people = [(numbers[frame], who, p) for frame, who, p in content.people if len(p) == count]
    frames = np.unique(list(numbers.values()))
    step = np.gcd.reduce(np.diff(frames)) if len(frames) > 1 else 1
    if (frames[-1] - frames[0]) // step < min(_SPARSE * len(frames), MAX_FRAMES):
        frames = np.arange(frames[0], frames[-1] + 1, step)
    return frames, people
