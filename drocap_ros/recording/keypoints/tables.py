"""JSON of keypoints, whole, by lines or cut off; tables as JSON: DeepLabCut's, one row a person, one row a point."""

from __future__ import annotations

import csv
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints.orders import counts
from drocap_ros.recording.text import rows_of
from drocap_ros.tracks import MAX_FRAMES

#: A frame, or a person in one.
Frame: TypeAlias = "Mapping[str, object]"
#: Columns of a frame, a person and a point's name; "time" is no number of a frame.
_FRAME = ("frame_idx", "frame_index", "frame_id", "frame", "image_id", "image", "img", "file_name", "image_name")
_WHO = ("track", "track_id", "person_id", "person", "instance_id")
_PART = ("landmark", "landmark_name", "keypoint", "keypoint_name", "joint", "joint_name", "bodypart", "name", "part")
_SCORES = dict.fromkeys(
    [
        "confidence",
        "conf",
        "likelihood",
        "visibility",
        "visible",
        "vis",
        "presence",
        "probability",
        "prob",
        "v",
        "c",
        "p",
    ],
    "score",
)
_AXIS = "|".join(("x", "y", "z", "score", *_SCORES))
#: A column's point and axis, after which its unit may stand: ``nose_x``, ``NoseX`` or ``x_nose``, ``x0``.
_UNIT = re.compile(r" *[(\[_]*(?:px|pixels?)[)\]]*", re.IGNORECASE)
_COLUMN = re.compile(rf"(.+)[._\- ]({_AXIS})", re.IGNORECASE)
_CAMEL = re.compile(r"(.*[a-z\d])([XYZVC])")
_TURNED = re.compile(rf"({_AXIS})[._\- ]?(\d+|(?<=[._\- ]).+)", re.IGNORECASE)


#: What opens and closes in JSON, and texts, in which nothing does.
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[{}\[\]]')


def read_json(path: Path) -> tuple[object, int]:
    """Content of a file, and the number of its damaged parts: of lines of JSON, or of one whose rest is missing."""
    data = path.read_bytes()
    try:
        return json.loads(data), 0
    except (ValueError, RecursionError) as error:
        text = data.decode("utf-8-sig", "replace")
        lines = [line for line in text.splitlines() if line.strip()]
        nodes = [node for line in lines[: MAX_FRAMES + 1] if isinstance(node := _parsed(line), dict | list)]
        if len(nodes) > len(lines) / 2:
            return nodes, len(lines) - len(nodes)
        whole = _parsed(_closed(text[: getattr(error, "pos", 0)]))
        if whole is None:
            raise
        return whole, 1


def _parsed(text: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _closed(text: str) -> str:
    """A text up to its last whole object, with all that is open there closed."""
    open_ones: list[str] = []
    end, closing = 0, ""
    for token in _TOKEN.finditer(text):
        if token[0] in "{[":
            open_ones.append("}" if token[0] == "{" else "]")
        elif token[0] in "}]":
            if not open_ones or open_ones.pop() != token[0]:
                break
            if token[0] == "}" or len(open_ones) < len(closing):
                end, closing = token.end(), "".join(reversed(open_ones))
    return text[:end] + closing


def is_keypoint_table(path: Path) -> bool:
    """Whether the first line of a table is that of keypoints, and no flight log's."""
    try:
        return _kind(next(rows_of(path), [])) is not None
    except (OSError, UnicodeError, csv.Error):
        return False


def read_table(path: Path) -> Iterator[Frame]:
    """Frames, or rows, as the JSON of a person in a frame."""
    rows = rows_of(path)
    first = next(rows, [])
    read = _kind(first)
    if read is None:
        raise InputError("expected a table of keypoints: DeepLabCut's, or columns as nose_x, nose_y; found another")
    return read(itertools.chain([first], rows))


def _kind(head: list[str]) -> Callable[[Iterator[list[str]]], Iterator[Frame]] | None:
    names = [name.lower() for name in head]
    if names[:1] in (["scorer"], ["bodyparts"]):
        return _deeplabcut
    if len(_columns(head)) >= 5:
        return _wide
    if {"x", "y"} <= set(names) and set(names) & set(_PART) and set(names) & set(_FRAME):
        return _long
    return None


def _columns(head: list[str]) -> dict[str, dict[str, int]]:
    """Columns of each point that has both coordinates."""
    found: dict[str, dict[str, int]] = {}
    for i, name in enumerate(head):
        name = _UNIT.sub("", name) if name[-1:] in "lxs)]" else name
        if (match := _COLUMN.fullmatch(name) or _CAMEL.fullmatch(name)) is not None:
            point, axis = match.groups()
        elif (match := _TURNED.fullmatch(name)) is not None:
            axis, point = match.groups()
        if match is not None:
            found.setdefault(point, {}).setdefault(_SCORES.get(axis.lower(), axis.lower()), i)
    return {name: columns for name, columns in found.items() if {"x", "y"} <= columns.keys()}


def _place(head: list[str], names: tuple[str, ...]) -> int | None:
    lower = [name.lower() for name in head]
    return next((lower.index(name) for name in names if name in lower), None)


def _wide(rows: Iterator[list[str]]) -> Iterator[Frame]:
    head = next(rows)
    columns, frame, who = _columns(head), _place(head, _FRAME), _place(head, _WHO)
    times = {
        name.lower(): i for i, name in enumerate(head) if re.fullmatch(r"(time|timestamp|t)(_[mun]?s)?", name, re.I)
    }
    for number, row in enumerate(rows):
        cells = [*row, *[""] * (len(head) - len(row))]
        points = [{"name": name, **{axis: cells[i] for axis, i in of.items()}} for name, of in columns.items()]
        person = {} if who is None or not cells[who] else {"person_id": cells[who]}
        at = {name: cells[i] for name, i in times.items()}
        yield {
            "frame_id": number if frame is None else cells[frame], **at, "people": [{**person, "keypoints": points}]
        }  # fmt: skip


def _long(rows: Iterator[list[str]]) -> Iterator[Frame]:
    head = next(rows)
    frame, part, who = (_place(head, names) for names in (_FRAME, _PART, _WHO))
    values = {_SCORES.get(n.lower(), n.lower()): i for i, n in enumerate(head) if re.fullmatch(_AXIS, n, re.IGNORECASE)}
    assert frame is not None
    assert part is not None
    found: dict[tuple[str, str], list[Mapping[str, str]]] = {}
    for row in rows:
        cells = [*row, *[""] * (len(head) - len(row))]
        person = "" if who is None or who == part else cells[who]
        points = found.setdefault((cells[frame], person), [])
        points.append({"name": cells[part], **{axis: cells[i] for axis, i in values.items()}})
    for (number, person), points in found.items():
        yield {"frame_id": number, "people": [{"person_id": person, "keypoints": points}]}


def _deeplabcut(rows: Iterator[list[str]]) -> Iterator[Frame]:
    """Rows that begin with scorer, individuals, bodyparts, coords; then one row a frame."""
    first = list(itertools.islice(rows, 4))
    head = {row[0]: row for row in first if row[0] in ("scorer", "individuals", "bodyparts", "coords")}
    if not {"bodyparts", "coords"} <= head.keys():
        raise InputError("expected the rows bodyparts and coords of DeepLabCut, found others; export the CSV again")
    begin = next((i for i, cell in enumerate(head["coords"]) if i and cell), 1)  # labels have folders in the first ones
    whose = head.get("individuals", [""] * len(head["coords"]))
    columns = list(zip(whose, head["bodyparts"], head["coords"], strict=False))[begin:]
    for row in itertools.chain(first[len(head) :], rows):
        people: dict[str, dict[str, dict[str, str]]] = {}
        for (who, part, coord), text in zip(columns, row[begin:], strict=False):
            people.setdefault(who, {}).setdefault(part, {"name": part})[coord] = text
        persons = [{"person_id": who, "keypoints": list(parts.values())} for who, parts in people.items()]
        yield {"frame_id": "/".join(row[:begin]), "people": persons}


def read_yolo(path: Path) -> list[Frame]:
    """Persons of a label file of YOLO's: class, box, points in shares of the picture, a score and a number."""
    people: list[Frame] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines()[:1000]:
        cells = line.split()
        sizes = ((each, more) for each in (3, 2) for more in (0, 1, 2))
        fitting = ((e, m) for e, m in sizes if (len(cells) - 5 - m) % e == 0 and (len(cells) - 5 - m) // e in counts())
        if (found := next(fitting, None)) is not None:
            number = {"track_id": cells[-1]} if found[1] and cells[-1].isdecimal() else {}
            people.append({**number, "keypoints": cells[5 : len(cells) - found[1]]})
    return people
