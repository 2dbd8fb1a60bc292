"""Truth from files of motion capture systems: C3D, TRC and BVH, as joints of ``BODY_17`` in metres, z up.

Joints are known by their names (:func:`body_joints`).  Units and vertical are those that the file states or its format
has by custom, unless the body contradicts them: a line then says what was taken.
"""

from __future__ import annotations

import logging
import math
import re
import warnings
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, JointSet, in_body_order, indices
from drocap_ros.tracks import MAX_FRAMES, read_npz

logger = logging.getLogger(__name__)

#: Part of the body -> names of its joint in other programs, the most certain first: Vicon's joint centres, names of
#: segments in rigs (a segment begins at its joint), names of joints.  In rigs "shoulder" is often the clavicle, "hand"
#: and "foot" may be ends, "leg" is the shank.
_ALIASES = {
    "hip": "hjc fep upleg upperleg thigh thighbend femur hip",
    "knee": "kjc feo knee lowerleg shin calf tibia leg",
    "ankle": "ajc tio ankle foot",
    "shoulder": "sjc hup upperarm uparm humerus arm shldr shldrbend shoulder",
    "elbow": "ejc huo elbow lowerarm lowarm forearm forearmbend radius",
    "wrist": "wjc rao wrist hand",
    "toe": "bigtoe",
}
#: Metres of a unit, as files write it.
_UNITS = {"mm": 1e-3, "millimeters": 1e-3, "cm": 1e-2, "m": 1.0, "meters": 1.0, "in": 0.0254, "inches": 0.0254}
#: The unit of the CMU database and of BVH files made from it.
_UNITS["in/0.45"] = 0.0254 / 0.45
#: Thigh and shank of people, m: of a child of four years, and of the tallest man.
_LEG_M = (0.4, 1.3)
#: Turns of axes (x, y, z) to z up, by the vertical.
_TO_Z_UP = {
    "X": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z": np.eye(3),
}
#: Markers of Vicon's Plug-in Gait, which CMU and others use too, and of Helen Hayes; some of them are no chance.
_MARKER = re.compile(
    r"[LR]?\.?(FHD|BHD|ASIS?|PSIS?|THI|KNEE?|TIB|ANK(LE)?|HEEL?|TOE|SHO|UPA|ELB|FRM|FRA|WRA|WRB|FIN)|C7|T10|CLAV|STRN|SACR"
)
_FEWEST_MARKERS = 5
_LIMBS = indices(BODY_17.joints, LIMB_JOINTS)
#: Bounds against damaged files.
_MAX_POINTS, _MAX_BYTES = 2000, 1 << 29
_RATES_HZ = (1.0, 10_000.0)


class _Points(NamedTuple):
    """Points of a file: positions (F, P, 3), NaN unknown; times (F,) s; unit, and vertical "X", "Y", "Z" or "-X" ..."""

    names: list[str]
    positions: np.ndarray
    time_s: np.ndarray
    unit: str
    up: str


def read_truth_file(path: Path, subject: str = "") -> tuple[np.ndarray, np.ndarray] | None:
    """Joints (T, 17, 3) m, z up, NaN unknown, and their times (T,) s; None of a file that is none of these.

    subject : name before the joints' names, where a file holds several bodies; empty: the one with fewest gaps
    """
    try:
        with path.open("rb") as file:
            head = file.read(64).removeprefix(b"\xef\xbb\xbf")
        reader = next((read for begins, read in _READERS if begins.match(head)), None)
        if reader is None:
            return None
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"expected at most {_MAX_BYTES >> 20} MiB, found more; cut the file")
        with np.errstate(all="ignore"):
            return _on_the_body(path, _of_subject(path, reader(path), subject))
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def body_joints(names: list[str]) -> dict[str, int]:
    """Joint of ``BODY_17`` -> its place among the names of a file.

    Names of ``BODY_17`` stand for themselves.  Others are a side and a part in any spelling, with or without a prefix
    before a colon: "mixamorig:LeftUpLeg", "RHip", "l_hip", "Subject:RKJC", "thigh.L".
    """
    bare = [re.sub(r".*[:|]", "", name).strip() for name in names]
    words = [re.sub(r"[^a-z]", "", name.lower()) for name in bare]
    found = {joint: bare.index(joint) for joint in BODY_17.joints if joint in bare}
    for side, long in (("l", "left"), ("r", "right")):
        for part, aliases in _ALIASES.items():
            spelt = (form for a in aliases.split() for form in (long + a, side + a, a + long, a + side))
            place = next((words.index(form) for form in spelt if form in words), None)
            if place is not None:
                found.setdefault(side + part, place)
    for place, name in enumerate(bare):
        if (joint := _prefixed(name)) is not None:
            found.setdefault(joint, place)
    return found


_PARTS = {alias: part for part, aliases in _ALIASES.items() for alias in aliases.split()}
_SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}


def _prefixed(name: str) -> str | None:
    """The joint of a rig's name with words before it: "Bip01 L Thigh", "J_Bip_L_UpperLeg", "DEF-upper_arm.L"."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
    at = next((i for i, word in enumerate(words) if word in _SIDES), None)
    if at is None or len(words) < 2:
        return None
    ends = ["".join(words[at + 1 :])] if at < len(words) - 1 else ["".join(words[i:at]) for i in range(at)]
    part = next((_PARTS[end] for end in ends if end in _PARTS), None)
    return None if part is None else _SIDES[words[at]] + part


def _of_subject(path: Path, points: _Points, wanted: str) -> _Points:
    """The points of one of several bodies, whose names stand before a colon or bar."""
    owners = [re.match(r"(.*)[:|]", name) for name in points.names]
    columns: dict[str, list[int]] = {}
    for i, owner in enumerate(owners):
        columns.setdefault(owner[1].strip() if owner else "", []).append(i)
    bodies = {name: of for name, of in columns.items()
              if set(LIMB_JOINTS) <= body_joints([points.names[i] for i in of]).keys()}  # fmt: skip
    if wanted and wanted not in bodies:
        raise InputError(f"expected a body named {wanted!r}, found {', '.join(bodies) or 'none'}; correct the name")
    if len(bodies) < 2:
        return points
    seen = {name: int(np.isfinite(points.positions[:, of]).all(axis=2).sum()) for name, of in bodies.items()}
    best = wanted or max(seen, key=lambda name: seen[name])
    logger.warning("%s: several bodies, %s: %s is used, %s#NAME is another", path, ", ".join(bodies), best, path.name)
    own = bodies[best]
    return points._replace(names=[points.names[i] for i in own], positions=points.positions[:, own])


def _on_the_body(path: Path, points: _Points) -> tuple[np.ndarray, np.ndarray]:
    found = body_joints(points.names)
    if missing := [joint for joint in LIMB_JOINTS if joint not in found]:
        bare = (re.sub(r".*[:|]", "", name).strip().upper() for name in points.names)
        markers = [name for name in bare if _MARKER.fullmatch(name)]
        if len(markers) >= _FEWEST_MARKERS:
            raise InputError(
                f"expected joint centres, found markers on the skin ({', '.join(markers[:6])} ...); export the joint"
                " centres of the model too, as LHJC or LKJC, or a BVH of the fitted skeleton"
            )
        there = ", ".join(re.sub(r"[^ -~]", "?", name)[:30] for name in points.names[:20]) or "none"
        raise InputError(f"expected joints by names, found no {', '.join(missing)} among {there}; rename the joints")
    x = in_body_order(points.positions[:, list(found.values())].astype(np.float64), list(found), LIMB_JOINTS)
    lost = (x == x[..., :1]).all(axis=2)  # programs write a lost point as the origin, or as 9999999 thrice
    lost[:, [i for i in range(len(BODY_17)) if i not in _LIMBS]] = False
    x[lost | ~np.isfinite(x).all(axis=2)] = np.nan
    whole = x[np.isfinite(x[:, _LIMBS]).all(axis=(1, 2))]
    if not len(whole):
        raise InputError("expected every limb joint in some frame, found none; fill the gaps in")
    words, metres = _metres(whole, points.unit)
    up = _vertical(whole, points.up)
    said = [words] * (words != points.unit) + [f"{up} up"] * (up != points.up)
    if said:
        logger.warning("%s: taken as %s, by the size and the stance of the body", path, ", ".join(said))
    turn = _TO_Z_UP[up[-1]] * np.array([[1.0], [-1.0], [-1.0]]) if up[0] == "-" else _TO_Z_UP[up]
    return metres * x @ turn.T, points.time_s


def _metres(x: np.ndarray, stated: str) -> tuple[str, float]:
    """The stated unit, else the first with which the legs are those of a person, and its metres."""
    legs = [x[:, [BODY_17.index(side + joint) for joint in ("hip", "knee", "ankle")]] for side in "lr"]
    leg = float(np.median(np.linalg.norm(np.diff(legs, axis=2), axis=3).sum(axis=2)))
    for unit in dict.fromkeys((stated, "mm", "cm", "m", "in/0.45", "in")):
        if _LEG_M[0] <= leg * _UNITS[unit] <= _LEG_M[1]:
            return unit, _UNITS[unit]
    raise InputError(f"expected legs of a person in {stated}, found thigh and shank of {leg:.3g}; check the units")


def _vertical(x: np.ndarray, stated: str) -> str:
    """The axis along which the person mostly stands, the stated one where that is not clear."""
    ankles, shoulders = (x[:, [BODY_17.index("l" + joint), BODY_17.index("r" + joint)]].mean(axis=1)
                         for joint in ("ankle", "shoulder"))  # fmt: skip
    line = np.median(shoulders - ankles, axis=0)
    share = line / max(float(np.linalg.norm(line)), 1e-12)
    axis = int(np.argmax(np.abs(share)))
    # The vertical of the recording is the axis that has 0.8 of the line from ankles to shoulders.
    if not abs(share[axis]) >= 0.8:
        return stated
    return ("-" if share[axis] < 0 else "") + "XYZ"[axis]


def _even_times(count: int, rate_hz: float) -> np.ndarray:
    if not (_RATES_HZ[0] <= rate_hz <= _RATES_HZ[1] and 1 <= count <= MAX_FRAMES):
        raise InputError(f"expected 1 to {MAX_FRAMES} frames at 1 to 10000 Hz, found {count} at {rate_hz:g} Hz")
    return np.arange(count) / rate_hz


def _read_c3d(path: Path) -> _Points:
    """By the package c3d (https://www.c3d.org/HTML); without a statement millimetres, z up."""
    import c3d

    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the library, about parameters that it misses
        try:
            reader = c3d.Reader(file)
            reader.get_analog_transform = lambda: (1.0, 0.0)  # nobody asks, and of some files it cannot be read
            texts = {
                name: [str(text).strip() for text in np.atleast_1d(found.string_array)]
                for name in ("UNITS", "Y_SCREEN", "LABELS", *(f"LABELS{i}" for i in range(2, 10)))
                if (found := reader.get(f"POINT:{name}"))
            }
            frames = [points[:, :4] for _, points, _ in islice(reader.read_frames(), MAX_FRAMES)]
        except Exception as error:  # noqa: BLE001  # the library raises whatever the damage leads to
            raise InputError(f"expected a C3D file that can be read; {first_line(error) or 'it is damaged'}") from None
    names = [name for key, labels in texts.items() if key.startswith("LABELS") for name in labels]
    table = np.array(frames, dtype=np.float64).reshape(len(frames), -1, 4)[:, : len(names)]
    if not table.size:
        raise InputError("expected named points in the C3D file, found none; export it again")
    table[table[..., 3] < 0] = np.nan
    unit, up = ("".join(texts.get(name, [])[:1]) for name in ("UNITS", "Y_SCREEN"))
    unit, up = unit.lower(), up.upper().lstrip("+")
    return _Points(
        names[: table.shape[1]],
        table[..., :3],
        _even_times(len(table), float(reader.point_rate)),
        unit if unit in _UNITS else "mm",
        up if up.lstrip("-") in _TO_Z_UP else "Z",
    )


def _read_trc(path: Path) -> _Points:
    """Tab-separated: the labels stand in the row that begins with ``Frame#``; an empty cell is unknown."""
    text = _with_points(path)
    rows = [re.split("\t" if "\t" in text else r" +", line) for line in text.splitlines()]
    place = next((i for i, row in enumerate(rows[:20]) if row[0].strip().lower().rstrip("#") == "frame"), None)
    if place is None or place < 2:
        raise InputError("expected a TRC file with a row Frame#, found none; export it again")
    header = dict(zip((cell.strip().lower() for cell in rows[place - 2]), rows[place - 1], strict=False))
    names = [name.strip() for name in rows[place][2 : 2 + 3 * _MAX_POINTS] if name.strip()]
    width = 2 + 3 * len(names)
    data = [
        [_number(cell) for cell in [*row, *[""] * width][:width]]
        for row in rows[place + 1 :]
        if not math.isnan(_number(row[0]))
    ]
    table = np.array(data[: MAX_FRAMES + 1], dtype=np.float64).reshape(-1, width)
    time_s = table[:, 1]
    if not len(table) or len(table) > MAX_FRAMES or not (np.isfinite(time_s).all() and (np.diff(time_s) > 0).all()):
        raise InputError(f"expected 1 to {MAX_FRAMES} rows with a Time that increases, found others; export it again")
    unit = header.get("units", "mm").strip().lower()
    return _Points(names, table[:, 2:].reshape(len(table), -1, 3), time_s, unit if unit in _UNITS else "mm", "Y")


def _with_points(path: Path) -> str:
    """A text whose decimal commas are points."""
    return re.sub(r"(?<=\d),(?=\d)", ".", path.read_text(encoding="utf-8-sig", errors="replace"))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


class _Bone(NamedTuple):
    """A joint of a BVH file: name, place of its parent, offset (3,), and columns of its channels by name, in order."""

    name: str
    parent: int
    offset: list[float]
    channels: list[str]


def _read_bvh(path: Path) -> _Points:
    """Forward kinematics of every joint; the format has no unit, centimetres are usual."""
    words = iter(_with_points(path).split())
    try:
        bones = _hierarchy(words)
        text = list(words)  # Frames: N Frame Time: S, then the values
        count, step = int(text[1]), float(text[4])
        width = sum(len(bone.channels) for bone in bones)
        if text[0].lower() != "frames:" or not 1 <= count <= MAX_FRAMES or count * width > len(text):
            raise InputError(
                f"expected whole frames of {width} numbers, found {len(text) - 5} of them; export it again"
            )
        values = np.array(text[5 : 5 + count * width], dtype=np.float64).reshape(count, width)
    except (StopIteration, ValueError, IndexError) as error:
        raise InputError(f"expected a BVH file that can be read; {first_line(error) or 'it ends early'}") from None
    time_s = _even_times(count, 1.0 / step if step > 0 else 0.0)
    roots = [bone.name for bone in bones if bone.parent < 0]
    names, owner = [], ""
    for bone in bones:
        owner = f"{bone.name}:" if bone.parent < 0 and len(roots) > 1 else owner
        names.append(owner + bone.name)
    return _Points(names, _kinematics(bones, values), time_s, "cm", "Y")


def _hierarchy(words: Iterator[str]) -> list[_Bone]:
    """Joints in the order of the file, up to the word MOTION; ends of bones are no joints."""
    bones: list[_Bone] = []
    above: list[int] = []
    for word in words:
        if word == "MOTION":
            break
        if word in ("ROOT", "JOINT", "End"):
            parts = list(iter(lambda: next(words), "{"))  # names may hold spaces
            above.append(-1 if word == "End" else len(bones))
            if word != "End":
                parent = above[-2] if len(above) > 1 else -1
                bones.append(_Bone(" ".join(parts), parent, [0.0, 0.0, 0.0], []))
        elif word == "OFFSET":
            numbers = [float(next(words)) for _ in range(3)]
            if above[-1] >= 0:
                bones[above[-1]].offset[:] = numbers
        elif word == "CHANNELS":
            bones[above[-1]].channels[:] = [next(words) for _ in range(min(int(next(words)), 6))]
        elif word == "}":
            above.pop()
        if len(bones) > _MAX_POINTS:
            raise InputError(f"expected at most {_MAX_POINTS} joints, found more")
    return bones


def _kinematics(bones: list[_Bone], values: np.ndarray) -> np.ndarray:
    """(F, J, 3) places of joints by the channels (F, N); a channel of a position stands in the place of the offset."""
    places, turns = np.zeros((len(values), len(bones), 3)), list[np.ndarray]()
    column = 0
    for joint, bone in enumerate(bones):
        shift, turn = np.broadcast_to(np.array(bone.offset), (len(values), 3)).copy(), np.eye(3)
        for channel in bone.channels:
            axis, value = "XYZ".find(channel[:1].upper()), values[:, column]
            column += 1
            if channel[1:] == "position" and axis >= 0:
                shift[:, axis] = value
            elif channel[1:] == "rotation" and axis >= 0:
                turn = turn @ exp_so3(np.deg2rad(value)[:, None] * np.eye(3)[axis])
            else:
                raise InputError(f"expected channels such as Xposition and Zrotation, found {channel[:40]!r}")
        if bone.parent >= 0:
            shift = places[:, bone.parent] + np.einsum("fij,fj->fi", turns[bone.parent], shift)
            turn = turns[bone.parent] @ turn
        places[:, joint] = shift
        turns.append(np.broadcast_to(turn, (len(values), 3, 3)))
    return places


_READERS: tuple[tuple[re.Pattern[bytes], Callable[[Path], _Points]], ...] = (
    (re.compile(rb".\x50", re.DOTALL), _read_c3d),
    (re.compile(rb"\s*HIERARCHY"), _read_bvh),
    (re.compile(rb"PathFileType"), _read_trc),
)


def metres_of(path: Path, x: np.ndarray) -> np.ndarray:
    """Joints (T, P, 3) of ``BODY_17``, stated to be mm with z up, in metres; a line where the body contradicts it."""
    try:
        unit, metres = _metres(x, "mm")
    except InputError:  # of no unit
        return x / 1000.0
    if unit != "mm":
        logger.warning("%s: taken as %s, by the size of the body", path, unit)
    if (up := _vertical(x, "Z")) != "Z":
        logger.warning("%s: the body stands or lies along %s, and z is taken as up; turn it if it stands", path, up)
    return metres * x if unit != "mm" else x / 1000.0


def load_mocap(
    path: Path, required: tuple[str, ...] = BODY_15.joints, joints: JointSet = BODY_15
) -> tuple[np.ndarray, float]:
    """Joints (T, P, 3) mm, world z up, and frames per second of one MoCap ``.npz``, C3D, TRC or BVH.

    Toes are further joints of ``X``, or the array ``toes`` (T, 2, 3) with their names in ``toe_joints``.  Where
    ``toe_kind`` is "ball", the array holds the balls of the feet, which are no joints of the body.

    required : joints that the file must hold; others that it lacks are NaN
    joints : ``BODY_15`` or ``BODY_17``, those of the result
    """
    if path.suffix.lower() != ".npz" and path.is_file() and (found := read_truth_file(path)) is not None:
        return 1000.0 * found[0][:, : len(joints)], 1.0 / float(np.median(np.diff(found[1])))
    a = read_npz(path, ("X", "fps", "joints"))
    try:
        x, names = _named_joints(a)
        fps = a["fps"]
        if fps.size != 1 or fps.dtype.kind not in "iuf" or not 1.0 <= float(fps.item()) <= 1000.0:
            raise InputError(f"fps: expected a number from 1 to 1000, got {fps}")
        body = in_body_order(x, names, required)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return body[:, : len(joints)], float(fps.item())


def _named_joints(a: dict[str, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Joints (T, P, 3) mm of a file with its toes, and their names (P)."""
    x, names = a["X"], [str(j) for j in a["joints"]]
    if x.ndim != 3 or x.shape[1:] != (a["joints"].size, 3) or len(x) == 0:
        raise InputError(f"X: expected (T, {a['joints'].size}, 3), got {x.shape}")
    if "toes" in a and str(a.get("toe_kind", "tip")) == "tip":
        toes = [str(j) for j in np.atleast_1d(a.get("toe_joints", ("rtoe", "ltoe")))]
        if a["toes"].shape != (len(x), len(toes), 3):
            raise InputError(f"toes: expected {(len(x), len(toes), 3)}, got {a['toes'].shape}")
        x, names = np.concatenate([x, a["toes"]], axis=1), [*names, *toes]
    x = x.astype(np.float64)
    if not np.isfinite(x).all():
        raise InputError("X, toes: expected finite millimetres, got NaN or infinity; fill the gaps in")
    return x, names
