"""The persons of a file of 2D keypoints, wherever its lists and dictionaries hold them."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints.names import NAMES_BY_COUNT

#: Keys of a person's points, their scores, a frame, a person, all persons of one frame, the rate.
POINTS = ("keypoints", "pose_keypoints_2d", "keypoints_2d", "landmarks", "pose_landmarks", "joints", "points")
SCORES = ("keypoint_scores", "scores", "score", "confidence", "confidences", "visibility", "likelihood")
_FRAME = ("frame_id", "image_id", "frame_index", "frame", "image_name", "file_name", "imgname")
_WHO = ("track_id", "idx", "person_id", "instance_id")
_TOGETHER = ("people", "bodies", "instances", "persons", "predictions")
_RATE = ("fps", "frame_rate", "rate_hz", "framerate")
#: Digits of a frame's number; longer ones are times or sums.
_LONGEST_NUMBER = 10
#: A person's least points, and most: whole bodies have 133 or 136, with a mesh of the face 543.
_LEAST, _MOST = 5, 600


@dataclass
class Content:
    """What a file holds; of a person its frame, its number or None, and points (P, 3): x, y px and score."""

    people: list[tuple[Any, Any, np.ndarray]] = field(default_factory=list)
    frames: list[Any] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    size: tuple[int, int] | None = None
    rate_hz: float | None = None

    def add(self, frame: Any, who: Any, points: np.ndarray) -> None:
        """Append a person; a number below zero, as OpenPose writes it, is none."""
        who = who[0] if isinstance(who, list) and who else who
        known = isinstance(who, str) or (isinstance(who, int | float) and who >= 0)
        self.frames.append(frame)
        if np.isfinite(points).any():
            self.people.append((frame, who if known else None, points))

    def note(self, node: Mapping[str, Any]) -> None:
        """Take the rate and the size of the images where a mapping states them."""
        rate = next((node[key] for key in _RATE if key in node), None)
        if self.rate_hz is None and isinstance(rate, int | float) and rate > 0:
            self.rate_hz = float(rate)
        size = node.get("width", node.get("w")), node.get("height", node.get("h"))
        if self.size is None and all(isinstance(n, int) and n > 0 for n in size):
            self.size = size


def walk(node: Any, frame: Any, content: Content) -> None:
    """Collect the persons below a node of JSON; ``frame`` is the name of the frame that it belongs to."""
    if isinstance(node, list):
        if (points := _points(node, None)) is not None:
            content.add(frame, None, points)
        elif node and isinstance(node[0], list | dict):
            for i, child in enumerate(node):
                walk(child, i if frame is None else frame, content)
    elif isinstance(node, dict):
        content.note(node)
        frame = next((node[key] for key in _FRAME if isinstance(node.get(key), int | float | str)), frame)
        if (points := _points_of(node, content)) is not None:
            content.add(frame, next((node[key] for key in _WHO if key in node), None), points)
            return
        for key, child in node.items():
            below = 0 if frame is None and key in _TOGETHER else frame
            if key in _TOGETHER:
                content.frames.append(below)
            # A key with a number is a picture's name.
            walk(child, key if below is None and re.search(r"\d", key) else below, content)


def _points_of(node: Mapping[str, Any], content: Content) -> np.ndarray | None:
    """Points of a person's node; names of joints go to ``content``."""
    scores = next((node[key] for key in SCORES if isinstance(node.get(key), list)), None)
    for value in (node[key] for key in POINTS if isinstance(node.get(key), list)):
        if (points := _points(value, scores)) is not None:
            if not content.names and isinstance(value[0], dict) and all("name" in p for p in value):
                content.names = [str(p["name"]) for p in value]
            return points
        if len(value) >= _LEAST and all(isinstance(name, str) for name in value):
            content.names = value  # COCO's categories
    return _named_points(node, content)


def _named_points(node: Mapping[str, Any], content: Content) -> np.ndarray | None:
    """Points of a node whose keys are the names of joints."""
    named = {key: p for key, p in node.items() if isinstance(p, dict) and {"x", "y"} <= p.keys()}
    if len(named) < _LEAST:
        return None
    content.names = content.names or list(named)
    return _points([named.get(name, {}) for name in content.names], None)


def _points(value: list[Any], scores: Any) -> np.ndarray | None:
    """(P, 3) x, y, score of a person's points in any form, None where they are none."""
    if len(value) < _LEAST or (isinstance(value[0], dict) and not value[0].keys() & {"x", "y", "name"}):
        return None
    try:
        if isinstance(value[0], dict):
            value = [[p.get("x") or 0, p.get("y") or 0, next((p[w] for w in SCORES if w in p), 1)] for p in value]
        points = np.array(value, dtype=np.float64)
        if points.ndim == 1:  # x y score of each, or x y
            points = points.reshape(-1, 3 if len(points) % 3 == 0 and len(points) // 3 in NAMES_BY_COUNT else 2)
        return scored(points, scores) if points.ndim == 2 else None
    except (ValueError, TypeError, OverflowError, AttributeError):
        return None


def scored(points: np.ndarray, scores: Any) -> np.ndarray | None:
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


def one_person(people: list[tuple[int, Any, np.ndarray]]) -> dict[int, np.ndarray]:
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


def numbers_of(labels: list[Any]) -> dict[Any, int]:
    """Number of each frame: the last one in its name where that tells frames apart, else its place."""
    names = list(dict.fromkeys(labels))
    found = [re.findall(r"\d+", Path(n).stem if isinstance(n, str) else str(n))[-1:] for n in names]
    numbers = [int(digits[0]) for digits in found if digits and len(digits[0]) < _LONGEST_NUMBER]
    return dict(zip(names, numbers if len(set(numbers)) == len(names) else range(len(names)), strict=True))


def table(path: Path) -> Iterator[dict[str, Any]]:
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
        people: dict[str, dict[str, dict[str, Any]]] = {}
        for (who, part, coord), text in zip(columns, row[1:], strict=False):
            people.setdefault(who, {}).setdefault(part, {"name": part})[coord] = text
        persons = [{"person_id": w, "keypoints": list(parts.values())} for w, parts in people.items()]
        yield {"frame_id": row[0], "people": persons}
