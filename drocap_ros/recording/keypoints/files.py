"""2D keypoints out of the files of other tools, as tracks of one person.

JSON (OpenPose, AlphaPose, COCO, MMPose, MediaPipe, TensorFlow.js) is searched for points, frames and persons wherever
they stand; tables and arrays take the same way.  Joints are those named, else in the order that makes a body.
"""

from __future__ import annotations

import contextlib
import csv
import logging
import re
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.keypoints.frames import (
    Label,
    natural,
    numbers_of,
    of_one_recording,
    one_person,
    rate_of_times,
)
from drocap_ros.recording.keypoints.orders import counts, name_points
from drocap_ros.recording.keypoints.tables import is_keypoint_table, read_json, read_table
from drocap_ros.tracks import MAX_FRAMES, Tracks, kind_of, load_tracks, read_npz, save_tracks, without_unseen

Value = TypeVar("Value")
#: An object of JSON.
Node = Mapping[str, object]
#: Keys of a person's points, their scores, a frame, a person, all persons of one frame, the rate.
_POINTS = ("keypoints", "pose_keypoints_2d", "keypoints_2d", "landmarks", "pose_landmarks", "joints", "points")
_SCORES = ("keypoint_scores", "scores", "score", "confidence", "confidences", "visibility", "likelihood")
_FRAME = ("frame_id", "image_id", "frame_index", "frame", "image_name", "file_name", "imgname")
_WHO = ("track_id", "idx", "person_id", "instance_id")
_TOGETHER = ("people", "bodies", "instances", "persons", "predictions")
_RATE = ("fps", "frame_rate", "rate_hz", "framerate")
#: Keys of a frame's time.
_TIMES = frozenset(f"{name}{unit}" for name in ("time", "timestamp") for unit in ("", "_s", "_ms", "_us", "_ns"))
#: Keys of the names of joints, in their order or by their numbers.
_NAMES = re.compile(r"(key_?points?|joints?|nodes?|body_?parts|landmarks?)_?(names?|labels?|id2name|name2id)|bodyparts")
#: Keys of poses in space, which are no keypoints of a picture.
_SPACE = re.compile(r"3d|world|xyz", re.IGNORECASE)
#: A person's least points, and most: whole bodies have 133 or 136, with a mesh of the face 543.
_LEAST, _MOST = 5, 600
#: No camera has larger images, px.
LARGEST_PX = 1e5


@dataclass
class Content:
    """What a file holds; of a person its frame, its number or None, and points (P, 4): x, y px, score, third number.

    tool : begin of the names of the orders that the file's form has
    space : whether it holds poses in space
    """

    people: list[tuple[Label, Label, np.ndarray]] = field(default_factory=list)
    frames: list[Label] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    size: tuple[int, int] | None = None
    rate_hz: float | None = None
    pictures: dict[Label, str] = field(default_factory=dict)
    times: dict[Label, tuple[str, float]] = field(default_factory=dict)
    tool: str = ""
    space: bool = False

    def add(self, frame: Label, who: object, points: np.ndarray) -> None:
        """Append a person; a number below zero, as OpenPose writes it, is none."""
        who = who[0] if isinstance(who, list) and who else who
        self.frames.append(frame)
        if np.isfinite(points).any():
            known = isinstance(who, str) or (isinstance(who, int | float) and who >= 0)
            self.people.append((frame, cast("Label", who) if known else None, points))

    def note(self, node: Node) -> None:
        """Take the rate, the size of the images, the names of joints and of pictures where a mapping states them."""
        rate = _first_of(node, _RATE)
        if self.rate_hz is None and isinstance(rate, int | float) and rate > 0:
            self.rate_hz = float(rate)
        width, height = node.get("width", node.get("w")), node.get("height", node.get("h"))
        if self.size is None and isinstance(width, int) and isinstance(height, int) and min(width, height) > 0:
            self.size = width, height
        for key, value in node.items():
            if not self.names and _NAMES.fullmatch(key.lower()):
                self.names = _listed_names(value)
        if isinstance(pictures := node.get("images"), list):  # of COCO: numbers of pictures need not be in their order
            pairs = [
                (p["id"], p["file_name"]) for p in pictures if isinstance(p, dict) and {"id", "file_name"} <= p.keys()
            ]
            self.pictures |= {number: str(name) for number, name in pairs if isinstance(number, int | str)}


def walk(node: object, frame: Label, content: Content) -> None:
    """Collect the persons below a node of JSON; ``frame`` is the name of the frame that it belongs to."""
    if isinstance(node, dict):
        _walk_object(node, frame, content)
    elif isinstance(node, list) and (points := _points(node, None)) is not None:
        content.add(frame, None, points)
    elif isinstance(node, list) and node and isinstance(node[0], list | dict):
        for i, child in enumerate(node):
            walk(child, i if frame is None else frame, content)


def _walk_object(node: Node, frame: Label, content: Content) -> None:
    content.note(node)
    frame = next((name for key in _FRAME if isinstance(name := node.get(key), int | float | str)), frame)
    for key in _TIMES & node.keys():
        with contextlib.suppress(TypeError, ValueError):
            content.times.setdefault(frame, (key, float(cast("float", node[key]))))
    if (points := _points_of(node, content)) is not None:
        content.add(frame, _first_of(node, _WHO), points)
        return
    for key, child in node.items():
        if _SPACE.search(key):
            content.space = True
            continue
        below = 0 if frame is None and key in _TOGETHER else frame
        if key in _TOGETHER:
            content.frames.append(below)
        # A key with a number is a picture's name.
        walk(child, key if below is None and re.search(r"\d", key) else below, content)


def _points_of(node: Node, content: Content) -> np.ndarray | None:
    """Points of a person's node; names of joints and the tool go to ``content``."""
    if "pose_keypoints_2d" in node:
        content.tool = "openpose"
    scores = next(_lists(node, _SCORES), None)
    for value in _lists(node, _POINTS):
        points = _points(value, scores)
        if points is None or not content.names:  # a list of names without points is COCO's categories
            content.names = _names_in(value) or content.names
        if points is not None:
            return points
    return _named_points(node, content)


def _named_points(node: Node, content: Content) -> np.ndarray | None:
    """Points of a node whose keys are the names of joints."""
    named = {key: p for key, p in node.items() if isinstance(p, dict) and {"x", "y"} <= p.keys()}
    if len(named) < _LEAST:
        return None
    content.names = content.names or list(named)
    return _points([named.get(name, {}) for name in content.names], None)


def _lists(node: Node, keys: tuple[str, ...]) -> Iterator[list[object]]:
    for value in (node.get(key) for key in keys):
        if isinstance(value, list):
            yield value
        elif isinstance(value, dict):  # Ultralytics writes columns
            columns = [column for name in ("x", "y", "visible") if isinstance(column := value.get(name), list)]
            yield list(map(list, zip(*columns, strict=False)))


def _first_of(values: Mapping[str, Value], keys: tuple[str, ...]) -> Value | None:
    """The value of the first of the keys that is there."""
    return next((values[key] for key in keys if key in values), None)


def _names_in(value: list[object]) -> list[str]:
    """The names of a list of names or of named points; empty where it is neither."""
    names = [p.get("name") if isinstance(p, dict) else p for p in value]
    found = [name for name in names if isinstance(name, str)]
    return found if len(found) == len(names) >= _LEAST else []


def _listed_names(value: object) -> list[str]:
    """Names of a list, or of an object from numbers to names or from names to numbers; empty of anything else."""
    if isinstance(value, dict) and all(isinstance(number, int) for number in value.values()):
        value = {number: name for name, number in value.items()}
    if isinstance(value, dict) and all(str(number).isdigit() for number in value):
        value = [value[number] for number in sorted(value, key=lambda number: int(str(number)))]
    return _names_in(value) if isinstance(value, list) else []


def _points(value: list[object], scores: object) -> np.ndarray | None:
    """(P, 4) of a person's points in any form, None where they are none."""
    try:
        points = np.array(_rows(value), dtype=np.float64)
        if points.ndim == 1:  # x y score of each, or x y
            points = points.reshape(-1, 3 if len(points) % 3 == 0 and len(points) // 3 in counts() else 2)
        return _scored(points, scores) if points.ndim == 2 else None
    except (ValueError, TypeError, OverflowError, AttributeError):
        return None


def _rows(value: list[object]) -> list[object]:
    """Points as lists of numbers, also of objects with x and y; none where they are other objects or too few."""
    objects = [p for p in value if isinstance(p, dict)]
    if len(value) < _LEAST or len(objects) not in (0, len(value)):
        return []
    if not objects:
        return value
    return [_row(p) for p in objects] if any(p.keys() & {"x", "y", "name"} for p in objects) else []


def _row(point: Node) -> list[object]:
    score = _first_of(point, _SCORES)
    return [point.get("x") or 0, point.get("y") or 0, point.get("z") or 0, 1 if score in (None, "") else score]


def _scored(points: np.ndarray, scores: object) -> np.ndarray | None:
    """(..., P, 4) x, y, score, third of points (..., P, 2 to 4) and their scores; None where they are none."""
    if not _LEAST <= points.shape[-2] <= _MOST or not 2 <= points.shape[-1] <= 4:  # x, y, z, score
        return None
    given: np.ndarray = points[..., -1] if scores is None else np.array(scores, dtype=np.float64)
    # A last number below zero is a depth, as MediaPipe writes it.
    if given.size != points[..., 0].size or (scores is None and (points.shape[-1] == 2 or (given < 0).any())):
        given = np.ones(points.shape[:-1])
    third = points[..., 2] if points.shape[-1] > 2 else np.zeros(points.shape[:-1])
    found: np.ndarray = np.stack([*np.moveaxis(points[..., :2], -1, 0), given.reshape(third.shape), third], axis=-1)
    marked = (found[..., :2] == 0).all(axis=-1) | (found[..., :2] == -1).all(axis=-1)
    seen = np.isfinite(found[..., :3]).all(axis=-1) & (found[..., 2] > 0) & ~marked
    found[~seen] = np.nan
    return found


def read_arrays(arrays: Mapping[str, np.ndarray], content: Content) -> None:
    """Collect the persons, joints, rate and size of arrays by name."""
    words = {name: array.ravel().astype(str).tolist() for name, array in arrays.items() if array.dtype.kind in "US"}
    content.names = words.get("joints", [])
    content.note(words)
    content.space = any(map(_SPACE.search, arrays))
    numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiu" and not _SPACE.search(name)}
    size = numbers.get("image_size", np.zeros(0))
    if size.shape == (2,) and ((size >= 1) & (size <= LARGEST_PX)).all():
        content.size = int(size[0]), int(size[1])
    content.note({name: value.item() for name, value in numbers.items() if value.size == 1})
    for i, person in enumerate(_points_in(numbers)):
        content.add(i, None, person)


def _points_in(arrays: Mapping[str, np.ndarray]) -> Iterable[np.ndarray]:
    """(F, P, 4) of the first array (F, P, 2 to 4) that holds points; empty where none does."""
    for value in (arrays[name] for name in (*_POINTS, *arrays) if name in arrays):
        points = _scored(value.astype(np.float64), _first_of(arrays, _SCORES)) if value.ndim == 3 else None
        if points is not None and np.isfinite(points).any():
            return points
    return ()


logger = logging.getLogger(__name__)

#: Arrays of our own tracks files.
_OWN = {"joints", "stamp_ns", "image_size"}
_ARRAYS = (".npz", ".npy")
#: Images per second, assumed where a file does not say.
_USUAL_HZ = 30.0
#: Coordinates that are all within the first are shares of the picture.  Scores beyond the second are no shares of one:
#: some networks exceed 1 a little, and COCO's flags end there.
_LARGEST_SHARE, _HIGHEST_SCORE = 2.0, 2.0


def is_keypoint_file(path: Path) -> bool:
    """Whether a file, by its name and for ``.csv`` its first word, or a folder of JSON files, holds 2D keypoints."""
    if path.is_dir():
        return {p.suffix for p in path.iterdir() if not p.name.startswith(".")} == {".json"}
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
        for file in sorted(path.glob("[!.]*.json"))[: MAX_FRAMES + 1]:
            content.frames.append(file.stem.removesuffix("_keypoints"))
            try:
                walk(read_json(file)[0], content.frames[-1], content)
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
    rate_hz, size = stated.rate_hz or content.rate_hz or rate_of_times(content.times), stated.size or content.size
    scores, third = np.nan_to_num(points[..., 2]), points[..., 3]
    if scores.max(initial=0.0) > _HIGHEST_SCORE:  # per cent, or a heat map's unit
        scores = scores / scores.max()
    spatial = content.space or bool((third < 0).any() or np.nanmax(third, initial=0.0) > _HIGHEST_SCORE)
    xy = _pixels(points[..., :2], size, spatial)
    names, words = name_points(xy, content.names, stated.order, content.tool)
    # Networks see pictures; arrays come from anywhere.  A guessed size of the picture gives no lens: where keypoints
    # are of a part about the person, it would be far too short.
    pictures = size is not None and path.suffix.lower() not in _ARRAYS
    assumed = [] if rate_hz else [f"{_USUAL_HZ:g} images per second (--rate HZ)"]
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
        stamp_ns=np.round((frames - frames[0]) * (1e9 / (rate_hz or _USUAL_HZ))).astype(np.int64),
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
            raise InputError(f"expected px, found shares of the picture{hint}; give its size with --image-size WxH")
        return xy * size
    seen = xy[np.isfinite(xy).any(axis=(1, 2))]
    extent = float(np.median(np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1), axis=0).max())
    # No network sees a person of fewer px.
    if extent < 6.0:
        raise InputError(f"expected px, found a person of {extent:.3g}{hint}, as in metres; convert them to px")
    return xy


def _series(path: Path, content: Content, subject: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (F,) of the frames, and the person's points (F, P, 4), NaN where unseen."""
    counted = Counter(len(points) for _, _, points in content.people)
    if not counted:
        found = "3D poses; take the 2D keypoints of the pictures" if content.space else "none; check the file"
        raise InputError(f"expected 2D keypoints of a person, found {found}")
    count = counted.most_common(1)[0][0]
    frames, people = _by_time(path, content, count)
    chosen, words = one_person(people, subject)
    if words:
        logger.warning("%s: %s", path, words)
    missing = np.full((count, 4), np.nan)
    return frames, np.stack([chosen.get(frame, missing) for frame in frames.tolist()])


def _by_time(path: Path, content: Content, count: int) -> tuple[np.ndarray, list[tuple[int, Label, np.ndarray]]]:
    """Numbers (F,) of the frames, gaps filled up, and the persons of ``count`` points by these numbers."""
    labels = {frame: content.pictures.get(frame, frame) for frame in content.frames}
    kept, words = of_one_recording(list(labels.values()))
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
