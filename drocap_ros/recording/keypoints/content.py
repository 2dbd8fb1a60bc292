"""Persons, frames and joints in the JSON and the arrays of other tools, wherever they stand."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar, cast

import numpy as np

from drocap_ros.recording.keypoints.body_check import limbs_of
from drocap_ros.recording.keypoints.frames import Label
from drocap_ros.recording.keypoints.orders import counts, names_of

Value = TypeVar("Value")
#: An object of JSON.
Node = Mapping[str, object]
#: Keys of a person's points, their scores, a frame, a person, all persons of one frame, the rate.
_POINTS = (
    "keypoints",
    "pose_keypoints_2d",
    "keypoints_2d",
    "landmarks",
    "pose_landmarks",
    "joints",
    "points",
    "shapes",
    "result",
)
_SCORES = ("keypoint_scores", "scores", "score", "confidence", "confidences", "visibility", "likelihood")
_FRAME = ("frame_id", "image_id", "frame_index", "frame", "image_name", "file_name", "imgname")
_WHO = ("track_id", "idx", "person_id", "instance_id")
_TOGETHER = ("people", "bodies", "instances", "persons", "predictions")
_RATE = ("fps", "framerate", "ratehz", "videofps", "samplingrate", "samplerate")
#: Keys, in small letters, of the size of the images: each side, both, or rows before columns as arrays have them.
_WIDTH, _HEIGHT, _SIZE, _SHAPE = (
    tuple(f"{of}{word}" for word in words for of in ("image", "img", "video", "frame", "ori", "orig", "original", ""))
    for words in (("width", "w"), ("height", "h"), ("size", "resolution"), ("shape",))
)
#: Keys of a frame's time.
_TIMES = frozenset(f"{name}{unit}" for name in ("time", "timestamp") for unit in ("", "_s", "_ms", "_us", "_ns"))
#: Keys of the names of joints, in their order or by their numbers.
_NAMES = re.compile(r"(key_?points?|joints?|nodes?|body_?parts|landmarks?)_?(names?|labels?|id2name|name2id)|bodyparts")
#: Keys of poses in space, which are no keypoints of a picture.
_SPACE = re.compile(r"3d|world|xyz", re.IGNORECASE)
#: A person's least points, and most: whole bodies have 133 or 136, with a mesh of the face 543.
_LEAST, _MOST = 5, 600
#: Both coordinates of a missing point: 0, -1, -9999, or such a large one.
_CODE = 9999.0
#: Scores beyond it are no shares of one: some networks exceed 1 a little, and COCO's flags end there.
HIGHEST_SCORE = 2.0
#: No camera has larger images, px.
LARGEST_PX = 1e5


@dataclass
class Content:
    """What a file holds; of a person its frame, its number or None, and points (P, 4): x, y px, score, third number.

    category : of COCO's kinds of things that of persons, and all kinds with joints; None where there are none
    by_name : whether points came by the names of their joints, of which later persons may have more
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
    category: tuple[object, set[object]] | None = None
    by_name: bool = False
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
        plain = {_plain(key): value for key, value in node.items()}
        rate = re.match(r"\s*(\d+(?:\.\d*)?)(?:/(\d+))?", str(_first_of(plain, _RATE)))
        if self.rate_hz is None and rate and float(rate[1]) > 0 and rate[2] != "0":
            self.rate_hz = float(rate[1]) / float(rate[2] or 1)
        sides = (_first_of(plain, _WIDTH), _first_of(plain, _HEIGHT)), _first_of(plain, _SIZE), _first_of(plain, _SHAPE)
        found = [[int(float(n)) for n in re.findall(r"\d+(?:\.\d+)?", str(side)[:60])] for side in sides]
        found[2] = found[2][1::-1]
        possible = [(s[0], s[1]) for s in found if len(s) == 2 and min(s) > 16 and max(s) < LARGEST_PX]
        if self.size is None and possible and not plain.keys() & {"x", "y", "left", "top"}:  # else they are a box's
            self.size = possible[0]
        for key, value in node.items():
            if not self.names and _NAMES.fullmatch(key.lower()):
                self.names = _listed_names(value)
        if isinstance(kinds := node.get("categories"), list):
            joints = {
                str(kind.get("id")): _listed_names(kind.get("keypoints")) for kind in kinds if isinstance(kind, dict)
            }
            limbs = {number: len(limbs_of(names_of(names))) for number, names in joints.items() if names}
            if limbs:
                best = max(limbs, key=lambda number: limbs[number])
                self.category, self.names = (best, set(limbs)), joints[best]
        if isinstance(pictures := node.get("images"), list):  # of COCO: numbers of pictures need not be in their order
            pairs = [
                (p["id"], p["file_name"]) for p in pictures if isinstance(p, dict) and {"id", "file_name"} <= p.keys()
            ]
            self.pictures |= {number: str(name) for number, name in pairs if isinstance(number, int | str)}


@lru_cache(maxsize=4096)
def _plain(key: str) -> str:
    return re.sub(r"[^a-z]", "", key.lower())


#: A key that names a person.
_PERSON = re.compile(r"(person|people|player|subject|skeleton|body|track|id)[_ -]?\d+", re.IGNORECASE)


def walk(node: object, frame: Label, content: Content, who: Label = None) -> None:
    """Collect the persons below a node of JSON; ``frame`` and ``who`` are the frame and person that it belongs to."""
    if isinstance(node, dict):
        _walk_object(node, frame, content, who)
    elif isinstance(node, list) and (points := _points(node, None)) is not None:
        content.add(frame, who, points)
    elif isinstance(node, list) and node and isinstance(node[0], list | dict):
        for i, child in enumerate(node):
            walk(child, i if frame is None else frame, content, who)


def _walk_object(node: Node, frame: Label, content: Content, who: Label) -> None:
    content.note(node)
    if content.category and str(node.get("category_id")) in content.category[1] - {content.category[0]}:
        return  # an animal
    frame = next((name for key in _FRAME if isinstance(name := node.get(key), int | float | str)), frame)
    for key in _TIMES & node.keys():
        with contextlib.suppress(TypeError, ValueError):
            content.times.setdefault(frame, (key, float(cast("float", node[key]))))
    if (points := _points_of(node, content)) is not None:
        content.add(frame, _first_of({"": who, **node}, (*_WHO, "")), points)
        return
    for key, child in node.items():
        if _SPACE.search(key):
            content.space = True
            continue
        below = 0 if frame is None and key in _TOGETHER else frame
        if key in _TOGETHER:
            content.frames.append(below)
        person = key if _PERSON.fullmatch(key) else who
        # Another key with a number is a picture's name.
        walk(child, key if below is None and re.search(r"\d", key) and person != key else below, content, person)


def _points_of(node: Node, content: Content) -> np.ndarray | None:
    """Points of a person's node; names of joints and the tool go to ``content``."""
    if "pose_keypoints_2d" in node:
        content.tool = "openpose"
    scores = next(_lists(node, _SCORES), None)
    for value in _lists(node, _POINTS):
        entries = [_flat(p) for p in value if isinstance(p, dict)]
        placed = [p for p in entries if isinstance(p.get("name"), str) and {"x", "y"} <= p.keys()]
        named = {str(p["name"]): p for p in placed}
        if len(placed) == len(named) >= _LEAST and (not content.names or not named.keys().isdisjoint(content.names)):
            content.note({key: side for key, side in placed[0].items() if key.startswith("original")})
            return _of_names(named, content)
        points = _points(value, scores)
        # A list of names without points is COCO's category.
        if content.category is None and (points is None or not content.names):
            content.names = _names_in(value) or content.names
        if points is not None:
            return points
    return _named_points(node, content)


def _named_points(node: Node, content: Content) -> np.ndarray | None:
    """Points of a node whose keys are the names of joints."""
    named = {key: p for key, p in node.items() if isinstance(p, dict) and {"x", "y"} <= p.keys()}
    pairs = {key: p for key, p in node.items() if isinstance(p, list) and 2 <= len(p) <= 3}
    if len(named) < _LEAST and len(limbs_of(names_of(list(pairs)))) >= 4:
        named = {key: dict(zip(("x", "y", "score"), p, strict=False)) for key, p in pairs.items()}
    return None if len(named) < _LEAST else _of_names(named, content)


def _of_names(named: Mapping[str, Node], content: Content) -> np.ndarray | None:
    """Points by their names in the order of the names so far; each frame may lack some, and have more."""
    content.names = [*content.names, *(name for name in named if name not in content.names)]
    content.by_name = True
    return _points([named.get(name, {}) for name in content.names], None)


def _flat(point: Node) -> Node:
    """A point's name, place and score beside each other; PoseNet, labelme and Label Studio (per cent) nest them."""
    inner = [value for key in ("position", "value") if isinstance(value := point.get(key), dict)]
    found: dict[str, object] = {**point, **{key: value for part in inner for key, value in part.items()}}
    name, place = _first_of(found, ("name", "part", "label", "keypointlabels")), found.get("points")
    if isinstance(place, list) and len(place) == 1 and isinstance(place[0], list) and len(place[0]) == 2:
        found["x"], found["y"] = place[0]
    for axis, side in (("x", "original_width"), ("y", "original_height")):
        if isinstance(full := found.get(side), int) and isinstance(share := found.get(axis), int | float):
            found[axis] = share * full / 100
    return {**found, "name": name[0] if isinstance(name, list) and name else name}


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
            points = points.reshape(-1, _each(points))
        return _scored(points, scores) if points.ndim == 2 else None
    except (ValueError, TypeError, OverflowError, AttributeError):
        return None


def _each(values: np.ndarray) -> int:
    """Numbers of each point of (..., N): with a score where a third could be one, else two; 66 are 33 or 22 points."""
    count = values.shape[-1]
    fitting = [n for n in (3, 2) if count % n == 0 and count // n in counts()]
    is_score = np.nanmax(np.abs(values[..., 2::3]), initial=0.0) <= HIGHEST_SCORE
    return 2 if not fitting or (len(fitting) > 1 and not is_score) else fitting[0]


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
    x, y = found[..., 0], found[..., 1]
    marked = (x == y) & ((x <= 0) | (x >= _CODE))
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
    for i, frame in enumerate(_points_in(numbers)):
        for who, person in enumerate(frame if np.ndim(frame) == 3 else [frame]):
            content.add(i, who if np.ndim(frame) == 3 else None, person)


def _points_in(arrays: Mapping[str, np.ndarray]) -> Iterable[np.ndarray]:
    """(F, P, 4), or (F, N, P, 4), of the first array that holds points; empty where none does."""
    for value in (arrays[name] for name in (*_POINTS, *arrays) if name in arrays):
        value = _in_frames(value)
        points = _scored(value.astype(np.float64), _first_of(arrays, _SCORES)) if value.ndim in (3, 4) else None
        if points is not None and np.isfinite(points).any():
            return points
    return ()


def _in_frames(value: np.ndarray) -> np.ndarray:
    """(F, P, 2 to 4), or (F, N, P, 2 to 4) of several persons or cameras, of an array with other axes; else itself."""
    if value.ndim == 4 and value.shape[0] < value.shape[1]:
        return np.moveaxis(value, 0, 1)
    if value.ndim == 3 and value.shape[1] in (2, 3) and value.shape[2] >= _LEAST:
        return np.moveaxis(value, 1, 2)
    if value.ndim == 2 and value.shape[1] in (2, 3):
        return value[None]
    if value.ndim == 2 and value.shape[1] % (each := _each(value)) == 0 and value.shape[1] // each in counts():
        return value.reshape(len(value), -1, each)
    return value
