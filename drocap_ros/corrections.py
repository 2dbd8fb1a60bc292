"""What a person corrects by hand in a recording's tracks, and its small YAML file beside the motion (docs/app.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FARTHEST_PX
from drocap_ros.errors import InputError, did_you_mean
from drocap_ros.keypoints import difference_noise
from drocap_ros.parameters import Values, read_yaml
from drocap_ros.skeleton import other_side
from drocap_ros.tracks import Tracks

#: Name of the file beside a motion.
FILE = "corrections.yaml"
#: Standard deviation of a place that is clicked, share of the person's height in the image, and its least, px.
_CLICKED = 0.006
_CLICKED_PX = 1.0
#: Time (s) in which an error of a network is forgotten: it lasts while the pose that it misreads does.
_LASTS_S = 0.3
#: Limbs of ``sides`` by the ends of their joints' names: networks exchange what is below hips and shoulders.
LIMBS = {"legs": ("knee", "ankle", "toe", "heel"), "arms": ("elbow", "wrist"), "all": ("",)}


@dataclass(frozen=True)
class Span:
    """A time (s) from the first image on, both ends included, and what is said of it."""

    from_s: float
    to_s: float

    def of(self, seconds: np.ndarray) -> np.ndarray:
        """(F,) bool, the images at these seconds within it, a thousandth of one apart."""
        return np.asarray((seconds >= self.from_s - 1e-3) & (seconds <= self.to_s + 1e-3))


@dataclass(frozen=True)
class Corrections:
    """Entries of a file, checked; times in s since the first image of the tracks, places in px.

    joints : time, name, place; hidden : span and name; sides : span and limbs
    person : span and box or None; feet : span, "left" or "right", whether it rests; upright : time, lower, upper end
    """

    joints: tuple[tuple[float, str, tuple[float, float]], ...] = ()
    hidden: tuple[tuple[Span, str], ...] = ()
    sides: tuple[tuple[Span, str], ...] = ()
    person: tuple[tuple[Span, tuple[float, ...] | None], ...] = ()
    feet: tuple[tuple[Span, str, bool], ...] = ()
    upright: tuple[tuple[float, tuple[float, float], tuple[float, float]], ...] = ()
    values: Values = field(default_factory=dict, compare=False)

    def __bool__(self) -> bool:
        return any(getattr(self, spec.name) for spec in fields(self) if spec.name != "values")


def load_corrections(path: str | Path) -> Corrections:
    """Read a file of corrections; every entry is checked and the error names the file."""
    path = Path(path)
    data = read_yaml(path, "a file of corrections")
    try:
        return parse_corrections({} if data is None else data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_corrections(path: Path, corrections: Values) -> None:
    """Write the entries; without any the file goes."""
    import yaml

    kept = {kind: entries for kind, entries in corrections.items() if entries}
    if not kept:
        path.unlink(missing_ok=True)
        return
    text = "\n".join(
        f"{kind}:\n" + "".join(f"  - {yaml.safe_dump(e, default_flow_style=True, width=math.inf)}" for e in entries)
        for kind, entries in kept.items()
    )
    beside = path.with_suffix(".part")
    beside.write_text(f"# corrections by hand; delete this file to undo them\n{text}", encoding="utf-8")
    beside.replace(path)


def parse_corrections(data: object) -> Corrections:
    """Corrections from the content of a file."""
    if not isinstance(data, Mapping):
        raise InputError(f"expected lists of {', '.join(_READERS)}, found {type(data).__name__}; correct the file")
    found: dict[str, tuple[object, ...]] = {}
    for kind, entries in data.items():
        if kind not in _READERS:
            words = ", ".join(_READERS)
            raise InputError(f"{kind}: expected one of {words}, found another word{did_you_mean(str(kind), _READERS)}")
        if not isinstance(entries, list):
            raise InputError(f"{kind}: expected a list of entries, found {type(entries).__name__}; begin them with '-'")
        read, keys = _READERS[kind]
        rows = []
        for number, entry in enumerate(entries, 1):
            where = f"{kind}, entry {number}"
            if not isinstance(entry, Mapping) or not set(entry) <= set(keys):
                raise InputError(f"{where}: expected {{{', '.join(keys)}}}, found {entry!r}; correct it")
            try:
                rows.append(read(entry))  # type: ignore[no-untyped-call]  # a row of the table
            except KeyError as error:
                raise InputError(f"{where}: expected {error.args[0]!r}, found none; add it") from None
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
        found[kind] = tuple(rows)
    return Corrections(**found, values=dict(data))  # type: ignore[arg-type]  # each reader gives its field's rows


def _number(entry: Mapping[str, object], key: str, default: float | None = None) -> float:
    value = entry[key] if default is None else entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or value < 0:
        raise InputError(f"{key}: expected seconds since the first image, found {value!r}; correct it")
    return float(value)


def _span(entry: Mapping[str, object]) -> Span:
    span = Span(_number(entry, "from", 0.0), _number(entry, "to", math.inf))
    if span.to_s < span.from_s:
        raise InputError(f"from {span.from_s:g} to {span.to_s:g}: expected an end after the begin; correct them")
    return span


def _places(entry: Mapping[str, object], key: str, count: int) -> tuple[float, ...]:
    value = entry[key]
    numbers = value if isinstance(value, list | tuple) else []
    usual = all(isinstance(v, int | float) and abs(v) <= FARTHEST_PX for v in numbers)
    if len(numbers) != count or not usual:
        raise InputError(f"{key}: expected {count} numbers, px of the image, found {value!r}; correct it")
    return tuple(float(v) for v in numbers)


def _place(entry: Mapping[str, object], key: str) -> tuple[float, float]:
    x, y = _places(entry, key, 2)
    return x, y


def _word(entry: Mapping[str, object], key: str, choices: Iterable[str]) -> str:
    value = entry[key]
    if value not in (known := list(choices)):
        raise InputError(f"{key}: expected one of {', '.join(known)}, found {value!r}; correct it")
    return str(value)


def _box(entry: Mapping[str, object]) -> tuple[float, ...] | None:
    if entry.get("box") is None:
        return None
    box = _places(entry, "box", 4)
    if box[2] <= box[0] or box[3] <= box[1]:
        raise InputError(f"box: expected x_min, y_min, x_max, y_max px, found {list(box)}; correct it")
    return box


def _rests(entry: Mapping[str, object]) -> bool:
    if not isinstance(value := entry["rests"], bool):
        raise InputError(f"rests: expected true or false, found {value!r}; correct it")
    return value


#: Kind of entries -> its reader and the words of an entry.
_READERS = {
    "joints": (lambda e: (_number(e, "time"), str(e["joint"]), _place(e, "at")), ("time", "joint", "at")),
    "hidden": (lambda e: (_span(e), str(e["joint"])), ("from", "to", "joint")),
    "sides": (lambda e: (_span(e), _word(e, "limbs", LIMBS)), ("from", "to", "limbs")),
    "person": (lambda e: (_span(e), _box(e)), ("from", "to", "box")),
    "feet": (
        lambda e: (_span(e), _word(e, "foot", ("left", "right")), _rests(e)),
        ("from", "to", "foot", "rests"),
    ),
    "upright": (lambda e: (_number(e, "time"), _place(e, "bottom"), _place(e, "top")), ("time", "bottom", "top")),
}


def corrected(tracks: Tracks, corrections: Corrections) -> Tracks:
    """Tracks with what is said of their joints, feet and of up; the person is changed before (:func:`spliced`)."""
    if not corrections:
        return tracks
    seconds = (tracks.stamp_ns - tracks.stamp_ns[0]) * 1e-9
    tracks = _with_sides(tracks, corrections, seconds)
    tracks = _without_hidden(tracks, corrections, seconds)
    tracks = _with_places(tracks, corrections, seconds)
    return replace(tracks, resting=_resting(corrections, seconds), vertical=_vertical(corrections, seconds))


def spliced(tracks: Tracks, rows: np.ndarray, other: Tracks | None) -> Tracks:
    """Tracks that in some images, (F,) bool, are another person's, of those images alone; None = nobody's."""
    names = ("keypoints", "confidence", "covariance", "evidence", "evidence_sigma")
    arrays = {name: getattr(tracks, name).copy() for name in names if _has(tracks, name)}
    for name, values in arrays.items():
        values[rows] = 0.0 if name == "confidence" else np.nan
        if other is not None and _has(other, name):
            values[rows] = getattr(other, name)
    return replace(tracks, **arrays)


def _has(tracks: Tracks, name: str) -> bool:
    return getattr(tracks, name) is not None


def _joint(tracks: Tracks, name: str) -> int:
    if name not in tracks.joints:
        known = ", ".join(tracks.joints)
        raise InputError(
            f"joint: expected one of {known}, found {name!r}; correct it{did_you_mean(name, tracks.joints)}"
        )
    return tracks.joints.index(name)


def _check_time(time_s: float, seconds: np.ndarray) -> int:
    """The image nearest to a time."""
    if time_s > seconds[-1] + 0.5:
        raise InputError(f"time: expected one within the recording's {seconds[-1]:.2f} s, found {time_s:g}; correct it")
    return int(np.argmin(np.abs(seconds - time_s)))


def _with_sides(tracks: Tracks, corrections: Corrections, seconds: np.ndarray) -> Tracks:
    order = np.tile(np.arange(len(tracks.joints)), (len(tracks), 1))
    for span, limbs in corrections.sides:
        there = [tracks.joints.index(other_side(joint, tracks.joints)) for joint in tracks.joints]
        of_limb = [joint.endswith(LIMBS[limbs]) for joint in tracks.joints]
        exchanged = np.where(of_limb, there, np.arange(len(there)))
        order[span.of(seconds)] = order[span.of(seconds)][:, exchanged]
    rows = np.arange(len(tracks))[:, None]
    names = ("keypoints", "confidence", "covariance", "evidence", "evidence_sigma")
    return replace(tracks, **{name: getattr(tracks, name)[rows, order] for name in names if _has(tracks, name)})


def _without_hidden(tracks: Tracks, corrections: Corrections, seconds: np.ndarray) -> Tracks:
    keypoints = tracks.keypoints.copy()
    for span, name in corrections.hidden:
        keypoints[span.of(seconds), _joint(tracks, name)] = np.nan
    return replace(tracks, keypoints=keypoints)


def _with_places(tracks: Tracks, corrections: Corrections, seconds: np.ndarray) -> Tracks:
    """Tracks whose joints are where they are placed, and near it in time less wrong than the network said.

    In an image that nobody corrected the network still errs as in the next corrected one with the probability that an
    error lasts so long: the keypoint moves by the expected error, and its covariance grows by the error's variance.
    """
    if not corrections.joints:
        return tracks
    keypoints = tracks.keypoints.copy()
    high, low = (f(keypoints, axis=1) for f in (np.fmax.reduce, np.fmin.reduce))
    height = np.nan_to_num((high - low).max(axis=1), nan=0.1 * tracks.image_size[1])
    if tracks.covariance is None:  # that of the recording's own noise; errors last for some frames
        noise = 2.0 * difference_noise(keypoints) if len(keypoints) > 3 else 0.0
        variance = max(noise, _CLICKED_PX) ** 2 * np.array([1.0, 0.0, 1.0])
        covariance = np.broadcast_to(variance, (*keypoints.shape[:2], 3)).copy()
    else:
        covariance = tracks.covariance.copy()
    confidence = np.isfinite(keypoints).all(axis=2) * 1.0 if tracks.confidence is None else tracks.confidence.copy()
    placed: dict[int, dict[int, np.ndarray]] = {}
    for time_s, name, at in corrections.joints:
        placed.setdefault(_joint(tracks, name), {})[_check_time(time_s, seconds)] = np.array(at)
    for joint, places in placed.items():
        rows = np.array(sorted(places))
        error = np.array([places[row] for row in rows]) - keypoints[rows, joint]
        # A joint that was not seen there tells nothing of the network's errors beside it.
        told = np.isfinite(error).all(axis=1)
        if told.any():
            mean, spread = _lasting(seconds, seconds[rows[told]], error[told])
            keypoints[:, joint] += mean
            covariance[:, joint] += spread
        keypoints[rows, joint], confidence[rows, joint] = [places[row] for row in rows], 1.0
        click = np.maximum(_CLICKED * height[rows], _CLICKED_PX)
        covariance[rows, joint] = np.square(click)[:, None] * [1.0, 0.0, 1.0]
    return replace(tracks, keypoints=keypoints, covariance=covariance, confidence=confidence)


def _lasting(seconds: np.ndarray, at: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 2) px expected error of a network that erred by ``error`` (K, 2) at K times, and (F, 3) px^2 its covariance.

    An error lasts with probability exp(-t / 0.3 s); between two it lasts unless it ended after the one and began anew
    before the other, and goes from the one to the other.
    """
    after = np.clip(np.searchsorted(at, seconds, side="left"), 0, len(at) - 1)
    before = np.clip(np.searchsorted(at, seconds, side="right") - 1, 0, len(at) - 1)
    last, ahead = (np.exp(-np.abs(seconds - at[i]) / _LASTS_S)[:, None] for i in (before, after))
    gap = np.maximum(at[after] - at[before], 1e-9)[:, None]
    way = np.clip((seconds - at[before])[:, None] / gap, 0.0, 1.0)
    between = (before != after)[:, None]
    lasts = np.where(between, 1.0 - (1.0 - last) * (1.0 - ahead), last)
    change = np.where(between, error[after] - error[before], 0.0)
    mean = np.where(between, error[before] + way * change, error[before])
    spread = (lasts * (1.0 - lasts))[..., None] * (mean[:, :, None] * mean[:, None])
    spread += (lasts * way * (1.0 - way))[..., None] * (change[:, :, None] * change[:, None])
    return lasts * mean, spread[:, [0, 0, 1], [0, 1, 1]]


def _resting(corrections: Corrections, seconds: np.ndarray) -> np.ndarray | None:
    """(F, 2) whether the right and the left foot rest, 0 or 1; NaN where nobody says so."""
    if not corrections.feet:
        return None
    resting = np.full((len(seconds), 2), np.nan)
    for span, foot, rests in corrections.feet:
        resting[span.of(seconds), ("right", "left").index(foot)] = rests
    return resting


def _vertical(corrections: Corrections, seconds: np.ndarray) -> np.ndarray | None:
    """(N, 5) index of the image, lower and upper end px."""
    rows = [(_check_time(time_s, seconds), *bottom, *top) for time_s, bottom, top in corrections.upright]
    return np.array(rows) if rows else None
