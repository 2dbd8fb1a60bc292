"""States of the camera from the timed-metadata track ``djmd`` inside the video files of DJI drones.

One protobuf message belongs to each image.  The format is not published: values are read at known places and checked.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import orientation_to_ros
from drocap_ros.geometry.rotations import unit_quaternions
from drocap_ros.recording.telemetry import djmd_layouts as layouts
from drocap_ros.recording.telemetry import gpmf
from drocap_ros.recording.telemetry.djmd_layouts import Layout, Message, Model, Value
from drocap_ros.recording.telemetry.log import (
    Lack,
    Lens,
    LogFormat,
    LogLack,
    Series,
    TelemetryLog,
    dji_attitude,
    from_first_fix,
    make_log,
    plausible,
)
from drocap_ros.recording.telemetry.srt import TEXT_TRACKS, read_srt
from drocap_ros.recording.telemetry.video_tracks import find_track, read_samples
from drocap_ros.tracks import MAX_FRAMES

#: Format of the track's samples.
_FORMAT = "djmd"
#: Bytes of a message; known ones have some kilobytes.
_MAX_MESSAGE = 1 << 18
_FIRST = 4  # the header stands in one of these
#: Unit of the file's angles, by ExifTool's DJI tags.
_TENTH_DEG = 0.1
#: Digital zooms; others are another value at that place.
_ZOOM_RANGE = (1.0, 60.0)
#: Ends of the columns of one message's numbers: gimbal 3, aircraft 3, quaternion 4, latitude, longitude, unit, two
#: heights, zoom.
_COLUMNS = (3, 6, 10, 13, 15, 16)


def has_djmd(path: Path) -> bool:
    """Whether a file is a video with such a track, with subtitles, or with a GoPro's."""
    try:
        return find_track(path, (_FORMAT, *TEXT_TRACKS, gpmf.CODE)) is not None
    except OSError:
        return False


def read_djmd(path: Path) -> TelemetryLog:
    """Gimbal and aircraft attitude, position and lens of every image, by the video's own clock.

    Raises OSError when the file cannot be read.
    """
    found = find_track(path, (_FORMAT, *TEXT_TRACKS, gpmf.CODE))
    if found is None:
        raise InputError(f"{path}: expected a DJI djmd track in the video, found none; give a log beside it")
    if found[1] in TEXT_TRACKS:
        return read_srt(path)
    try:
        return gpmf.read_gpmf(path, found[0]) if found[1] == gpmf.CODE else _to_log(path, found[0])
    except InputError as error:
        words = str(error)
        raise InputError(
            words if words.startswith(str(path)) else f"{path}: {found[1]} track: {words}; copy it again"
        ) from None


def _samples(path: Path, number: int) -> Iterator[tuple[int, bytes]]:
    """Samples that can hold a message, at times that increase."""
    count = fit = 0
    last_ns = -1
    for stamp_ns, data in itertools.islice(read_samples(path, number), MAX_FRAMES):
        count += 1
        # Four bytes are a field's key, its length and a message of one value.
        if 4 <= len(data) <= _MAX_MESSAGE and stamp_ns > last_ns:
            fit, last_ns = fit + 1, stamp_ns
            yield stamp_ns, data
    if fit < 0.5 * count or not fit:
        raise InputError(f"expected messages at times that increase, found {fit} of {count} samples")


def _message(data: bytes) -> Message | None:
    try:
        return Message(data)
    except ValueError:
        return None


def _probe(path: Path, number: int) -> tuple[np.ndarray, list[Message]]:
    """Times of all samples, and messages from the begin to the end, however long the track is."""
    stamps: list[int] = []
    probed: list[bytes] = []
    step = 1
    for i, (stamp_ns, data) in enumerate(_samples(path, number)):
        stamps.append(stamp_ns)
        if i % step == 0:
            probed.append(data)
            if len(probed) >= 64:  # the layout is found from at least half of them
                probed, step = [*probed[:_FIRST], *probed[_FIRST::2]], 2 * step
    return np.array(stamps, np.int64), [message for data in probed if (message := _message(data)) is not None]


def _to_log(path: Path, number: int) -> TelemetryLog:
    stamp_ns, messages = _probe(path, number)
    count = len(stamp_ns)
    name = _schema_name(messages)
    model = layouts.MODELS.get(name)
    layout = layouts.find_layout(messages, model)
    if layout is None:
        raise InputError(
            f"{path}: expected attitude or position at the known places of a djmd track, found neither (schema"
            f" {name or 'without a name'}); give a log beside the video with --telemetry"
        )
    rows = np.full((count, _COLUMNS[-1]), np.nan)
    for i, (_, data) in zip(range(count), _samples(path, number), strict=False):
        if (message := _message(data)) is not None:
            rows[i] = _numbers_of(message, layout, model)
    damaged = int(np.isnan(rows).all(axis=1).sum())
    if damaged > 0.5 * count:
        raise InputError(f"{path}: expected djmd messages, found {damaged} of {count} damaged; copy the file again")
    lacks = [LogLack(Lack.DAMAGED_STATES, str(damaged))] if damaged else []
    with np.errstate(all="ignore"):  # damaged numbers may be infinite
        return _from_rows(path, stamp_ns, rows, (name, model), lacks)


def _schema_name(messages: list[Message]) -> str:
    schema = next((v for m in messages if isinstance(v := m.at(layouts.SCHEMA), bytes)), b"")
    return "".join(c for c in schema.decode("latin1")[:60] if c.isascii() and c.isprintable()).removesuffix(".proto")


def _title(name: str, model: Model | None) -> str:
    if model:
        return f"DJI djmd track ({model.name})"
    return f"DJI djmd track (unknown schema {name or 'without a name'}, read at the places of known ones and plausible)"


def _numbers_of(message: Message, layout: Layout, model: Model | None) -> tuple[float, ...]:
    """The numbers of one message in the units of the file, NaN where missing."""
    place = _numbers(message, layout.position, (layouts.LATITUDE, layouts.LONGITUDE, layouts.UNIT))
    relative = _numbers(message, layout.relative_height[:-1], layout.relative_height[-1:])
    return (
        *(_numbers(message, layout.gimbal, (1, 2, 3)) if layout.gimbal else (np.nan,) * 3),
        *_numbers(message, layout.aircraft, (2, 1, 3)),  # pitch, roll, yaw
        *(_numbers(message, layout.quaternion, (1, 2, 3, 4)) if layout.quaternion else (np.nan,) * 4),
        *place,
        *relative,
        _number(message.at((*layout.position[:-1], 2)), np.nan),
        _number(message.at(model.zoom), np.nan) if model and model.zoom else np.nan,
    )


def _numbers(message: Message, path: tuple[int, ...], fields: tuple[int, ...]) -> tuple[float, ...]:
    """Numbers in fields of the message at a path: zero where one is left out, NaN where there is no message."""
    found = message.fields(path)
    missing = 0.0 if message.holds(path) else np.nan  # proto3 leaves out zeros
    return tuple(_number(found.get(field), missing) for field in fields)


def _number(value: Value | None, missing: float) -> float:
    if value is None:
        return missing
    return np.nan if isinstance(value, bytes) else float(value)


def _from_rows(
    path: Path, stamp_ns: np.ndarray, rows: np.ndarray, schema: tuple[str, Model | None], lacks: list[LogLack]
) -> TelemetryLog:
    name, model = schema
    gimbal, aircraft, quaternion, place, heights, zoom = np.split(rows, _COLUMNS[:-1], axis=1)
    relative, absolute = heights.T * 1e-3  # mm
    above_takeoff = np.isfinite(relative).any()
    geodetic = _degrees(place, model)
    geodetic[:, 2] = relative if above_takeoff else absolute
    found, more = plausible(path, Series(stamp_ns, gimbal * _TENTH_DEG, aircraft * _TENTH_DEG, geodetic))
    lacks += more
    if model is None:
        _check_unknown(path, found)
    position = from_first_fix(found.geodetic, above_takeoff=bool(above_takeoff))
    if position is not None and not above_takeoff:
        lacks.append(LogLack(Lack.HEIGHT, "absolute altitude"))
    attitude, agrees = _with_quaternion(dji_attitude(found.gimbal), quaternion)
    if not agrees:
        lacks.append(LogLack(Lack.QUATERNION))
    factor, steady = _zoom(zoom[:, 0])
    if not steady:
        lacks.append(LogLack(Lack.ZOOM, f"{np.nanmin(zoom):.1f} to {np.nanmax(zoom):.1f}"))
    lens = model.lens() if model else Lens()
    body, title = dji_attitude(found.aircraft), _title(name, model)
    log = make_log(path, title, stamp_ns, lacks, orientation=body, position=position, gimbal=attitude)
    return log._replace(video_clock=True, lens=lens._replace(zoom=factor) if steady else None)


def _check_unknown(path: Path, series: Series) -> None:
    """Refuses an attitude at the known places that is no gimbal's: with roll, or turned away from the aircraft."""
    roll = np.nanmedian(np.abs(series.gimbal[:, 1])) if np.isfinite(series.gimbal).any() else 0.0
    turn = np.abs((series.gimbal[:, 2] - series.aircraft[:, 2] + 180.0) % 360.0 - 180.0)
    away = np.nanmedian(turn) if np.isfinite(turn).any() else 0.0
    # A gimbal keeps the camera level, and its yaw follows the aircraft's: a larger median roll or turn from the nose,
    # deg, is another field.
    if roll > 45.0 or away > 90.0:
        raise InputError(
            f"{path}: expected a level gimbal that follows the aircraft at the places of known djmd schemas, found a"
            f" roll of {roll:.0f} deg and a turn of {away:.0f} deg; give a log beside the video with --telemetry"
        )


def _degrees(place: np.ndarray, model: Model | None) -> np.ndarray:
    """(N, 3) latitude and longitude in degrees, of coordinates and their unit; the third column is free."""
    known = np.isfinite(place).all(axis=1)
    beyond_radians = known & ((np.abs(place[:, 0]) > np.pi / 2) | (np.abs(place[:, 1]) > np.pi))
    degrees = (model.degrees if model else False) or beyond_radians.any()
    factor = np.where((place[:, 2] == 1) | degrees, 1.0, np.rad2deg(1.0))
    return np.column_stack([place[:, :2] * factor[:, None], place[:, 2]])


def _with_quaternion(attitude: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, bool]:
    """Attitude by the quaternion, which is finer, where one of both orders of components agrees with the angles.

    The second value is False where quaternions are given and disagree.
    """
    given = np.isfinite(quaternion).all(axis=1) & (np.abs(np.linalg.norm(quaternion, axis=1) - 1) < 0.01)
    given &= np.isfinite(attitude).all(axis=1)
    if not given.any():
        return attitude, True
    for order in ([1, 2, 3, 0], [0, 1, 2, 3]):  # w x y z; x y z w
        finer = orientation_to_ros(unit_quaternions(quaternion[given][:, order]))
        cosine = np.clip(np.abs(np.sum(finer * attitude[given], axis=1)), 0.0, 1.0)
        # Largest angle between the gimbal's quaternion and its angles, deg: five times their rounding to 0.1 deg.
        if np.percentile(np.rad2deg(2 * np.arccos(cosine)), 95) < 0.5:
            attitude = attitude.copy()
            attitude[given] = finer
            return attitude, True
    return attitude, False


def _zoom(zoom: np.ndarray) -> tuple[float, bool]:
    """The digital zoom, and whether it is the same throughout."""
    known = zoom[(zoom >= _ZOOM_RANGE[0]) & (zoom <= _ZOOM_RANGE[1])]
    if not len(known):
        return 1.0, True
    return float(np.median(known)), bool(np.ptp(known) < 0.01 * np.median(known))


FORMAT = LogFormat("", read_djmd, magic=b"ftyp", at=4)
