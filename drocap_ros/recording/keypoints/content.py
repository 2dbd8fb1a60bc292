"""The persons of a file of 2D keypoints, wherever its lists and dictionaries hold them."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import JOINT_SETS

#: OpenPose's order of COCO's points, and BlazePose's points.
_ARMS = "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist"
_LEGS = "r_hip r_knee r_ankle l_hip l_knee l_ankle"
_FACE = "r_eye l_eye r_ear l_ear"
_BLAZE = (
    "nose l_eye_inner l_eye l_eye_outer r_eye_inner r_eye r_eye_outer l_ear r_ear l_mouth r_mouth l_shoulder r_shoulder"
    " l_elbow r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip r_hip l_knee r_knee"
    " l_ankle r_ankle l_heel r_heel l_big_toe r_big_toe"
)
#: Other words for a joint -> ours.
_PARTS = {
    "sho": "shoulder", "elb": "elbow", "wri": "wrist", "kne": "knee", "ank": "ankle",
    "hand": "wrist", "foot_index": "big_toe", "bigtoe": "big_toe", "toe": "big_toe", "smalltoe": "small_toe",
}  # fmt: skip


def joint_name(name: str) -> str:
    """Our name of a joint: ``RHip``, ``hip_R`` and ``Hip.right`` are ``right_hip``; ours stay."""
    if any(name in joints.joints for joints in JOINT_SETS.values()):
        return name
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=^[LR])(?=[A-Z][a-z])", "_", name)
    words = [{"l": "left", "r": "right"}.get(word, word) for word in re.split(r"[\W_]+", spaced.lower()) if word]
    part = "_".join(word for word in words if word not in ("left", "right"))
    return "_".join([*(word for word in words if word in ("left", "right")), _PARTS.get(part, part)])


def _names(words: str) -> tuple[str, ...]:
    return tuple(map(joint_name, words.split()))


#: Number of points of a public network -> their names; Halpe's 136 begin with its 26.
NAMES_BY_COUNT = {
    **{len(s): s.joints for name in ("mpii16", "coco17", "halpe26", "wholebody133") for s in (JOINT_SETS[name],)},
    18: _names(f"{_ARMS} {_LEGS} {_FACE}"),
    25: _names(f"{_ARMS} hip {_LEGS} {_FACE} l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel"),
    33: _names(_BLAZE),
    136: JOINT_SETS["halpe26"].joints,
}


Value = TypeVar("Value")
#: A frame's name or number, or a person's; None = not stated.
Label = str | int | float | None
#: An object of JSON.
Node = Mapping[str, object]
#: Keys of a person's points, their scores, a frame, a person, all persons of one frame, the rate.
_POINTS = ("keypoints", "pose_keypoints_2d", "keypoints_2d", "landmarks", "pose_landmarks", "joints", "points")
_SCORES = ("keypoint_scores", "scores", "score", "confidence", "confidences", "visibility", "likelihood")
_FRAME = ("frame_id", "image_id", "frame_index", "frame", "image_name", "file_name", "imgname")
_WHO = ("track_id", "idx", "person_id", "instance_id")
_TOGETHER = ("people", "bodies", "instances", "persons", "predictions")
_RATE = ("fps", "frame_rate", "rate_hz", "framerate")
#: Digits of a frame's number; longer ones are times or sums.
_LONGEST_NUMBER = 10
#: A person's least points, and most: whole bodies have 133 or 136, with a mesh of the face 543.
_LEAST, _MOST = 5, 600
#: No camera has larger images, px.
LARGEST_PX = 1e5


@dataclass
class Content:
    """What a file holds; of a person its frame, its number or None, and points (P, 3): x, y px and score."""

    people: list[tuple[Label, Label, np.ndarray]] = field(default_factory=list)
    frames: list[Label] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    size: tuple[int, int] | None = None
    rate_hz: float | None = None

    def add(self, frame: Label, who: object, points: np.ndarray) -> None:
        """Append a person; a number below zero, as OpenPose writes it, is none."""
        who = who[0] if isinstance(who, list) and who else who
        self.frames.append(frame)
        if np.isfinite(points).any():
            known = isinstance(who, str) or (isinstance(who, int | float) and who >= 0)
            self.people.append((frame, cast("Label", who) if known else None, points))

    def note(self, node: Node) -> None:
        """Take the rate and the size of the images where a mapping states them."""
        rate = _first_of(node, _RATE)
        if self.rate_hz is None and isinstance(rate, int | float) and rate > 0:
            self.rate_hz = float(rate)
        width, height = node.get("width", node.get("w")), node.get("height", node.get("h"))
        if self.size is None and isinstance(width, int) and isinstance(height, int) and min(width, height) > 0:
            self.size = width, height


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
    if (points := _points_of(node, content)) is not None:
        content.add(frame, _first_of(node, _WHO), points)
        return
    for key, child in node.items():
        below = 0 if frame is None and key in _TOGETHER else frame
        if key in _TOGETHER:
            content.frames.append(below)
        # A key with a number is a picture's name.
        walk(child, key if below is None and re.search(r"\d", key) else below, content)


def _points_of(node: Node, content: Content) -> np.ndarray | None:
    """Points of a person's node; names of joints go to ``content``."""
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


def _points(value: list[object], scores: object) -> np.ndarray | None:
    """(P, 3) x, y, score of a person's points in any form, None where they are none."""
    try:
        points = np.array(_rows(value), dtype=np.float64)
        if points.ndim == 1:  # x y score of each, or x y
            points = points.reshape(-1, 3 if len(points) % 3 == 0 and len(points) // 3 in NAMES_BY_COUNT else 2)
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
    return [_row(p) for p in objects] if objects[0].keys() & {"x", "y", "name"} else []


def _row(point: Node) -> list[object]:
    score = _first_of(point, _SCORES)
    return [point.get("x") or 0, point.get("y") or 0, 1 if score is None else score]


def _scored(points: np.ndarray, scores: object) -> np.ndarray | None:
    """(..., P, 3) x, y, score of points (..., P, 2 to 4) and their scores; None where they are none."""
    if not _LEAST <= points.shape[-2] <= _MOST or not 2 <= points.shape[-1] <= 4:  # x, y, z, score
        return None
    given: np.ndarray = points[..., -1] if scores is None else np.array(scores, dtype=np.float64)
    # A last number below zero is a depth, as MediaPipe writes it.
    if given.size != points[..., 0].size or (scores is None and (points.shape[-1] == 2 or (given < 0).any())):
        given = np.ones(points.shape[:-1])
    found: np.ndarray = np.concatenate([points[..., :2], given.reshape(*points.shape[:-1], 1)], axis=-1)
    found[~(np.isfinite(found).all(axis=-1) & (found[..., 2] > 0) & (found[..., :2] > 0).any(axis=-1))] = np.nan
    return found


def one_person(people: list[tuple[int, Label, np.ndarray]]) -> dict[int, np.ndarray]:
    """Points by frame of the person with most frames by its number; of several the largest, then the nearest to it."""
    most = Counter(who for _, who, _ in people).most_common(1)[0][0]
    by_frame: dict[int, list[np.ndarray]] = {}
    for frame, who, points in people:
        if who == most:
            by_frame.setdefault(frame, []).append(points)
    chosen: dict[int, np.ndarray] = {}
    last: np.ndarray | None = None
    for frame in sorted(by_frame):
        sizes = [-np.ptp(p[np.isfinite(p[:, 0]), :2], axis=0).sum() for p in by_frame[frame]]
        steps = sizes if last is None else [np.nanmedian(np.abs(p - last)[:, :2]) for p in by_frame[frame]]
        last = chosen[frame] = by_frame[frame][int(np.argmin(np.nan_to_num(steps, nan=np.inf)))]
    return chosen


def numbers_of(labels: list[Label]) -> dict[Label, int]:
    """Number of each frame: the last one in its name where that tells frames apart, else its place."""
    names = list(dict.fromkeys(labels))
    found = [re.findall(r"\d+", Path(n).stem if isinstance(n, str) else str(n))[-1:] for n in names]
    numbers = [int(digits[0]) for digits in found if digits and len(digits[0]) < _LONGEST_NUMBER]
    return dict(zip(names, numbers if len(set(numbers)) == len(names) else range(len(names)), strict=True))


def read_arrays(arrays: Mapping[str, np.ndarray], content: Content) -> None:
    """Collect the persons, joints, rate and size of arrays by name."""
    content.names = np.atleast_1d(arrays.get("joints", ())).astype(str).tolist()
    numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiu"}
    size = numbers.get("image_size", np.zeros(0))
    if size.shape == (2,) and ((size >= 1) & (size <= LARGEST_PX)).all():
        content.size = int(size[0]), int(size[1])
    content.note({name: value.item() for name, value in numbers.items() if value.size == 1})
    for i, person in enumerate(_points_in(numbers)):
        content.add(i, None, person)


def _points_in(arrays: Mapping[str, np.ndarray]) -> Iterable[np.ndarray]:
    """(F, P, 3) of the first array (F, P, 2 to 4) that holds points; empty where none does."""
    for value in (arrays[name] for name in (*_POINTS, *arrays) if name in arrays):
        points = _scored(value.astype(np.float64), _first_of(arrays, _SCORES)) if value.ndim == 3 else None
        if points is not None and np.isfinite(points).any():
            return points
    return ()


def table(path: Path) -> Iterator[Node]:
    """DeepLabCut's table as JSON: rows that begin with scorer, individuals, bodyparts, coords; then one row a frame."""
    with path.open("r", encoding="utf-8-sig", errors="replace", newline="") as file:
        semicolons = ";" in file.readline()
        file.seek(0)
        rows = [row for row in csv.reader(file, delimiter=";" if semicolons else ",") if row]
    head = {row[0].strip(): row[1:] for row in rows[:4] if not row[0].strip().isdigit()}
    if not {"bodyparts", "coords"} <= head.keys():
        raise InputError("expected the rows bodyparts and coords of DeepLabCut, found others; export the CSV again")
    whose = head.get("individuals", [""] * len(head["coords"]))
    columns = list(zip(whose, head["bodyparts"], head["coords"], strict=False))
    for row in rows[len(head) :]:
        people: dict[str, dict[str, dict[str, str]]] = {}
        for (who, part, coord), text in zip(columns, row[1:], strict=False):
            people.setdefault(who, {}).setdefault(part, {"name": part})[coord] = text
        persons = [{"person_id": w, "keypoints": list(parts.values())} for w, parts in people.items()]
        yield {"frame_id": row[0], "people": persons}
