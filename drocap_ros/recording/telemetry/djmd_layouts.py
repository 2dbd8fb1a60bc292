"""Places of values in the messages of DJI's ``djmd`` track, by the name of their schema.

A place is a path of protobuf field numbers.  Source: the DJI tags of ExifTool 13, https://exiftool.org/TagNames/DJI.html.
Angles are tenths of a degree; coordinates are radians, or degrees where a unit field holds 1; heights are mm.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from drocap_ros.recording.telemetry.log import Lens

#: An integer (varint), a number (fixed 32 or 64 bits, as float or double), or bytes (text or a message).
Value = int | float | bytes

#: Values of a varint: the sign bit of 64, and their number.
_SIGN = 1 << 63
_RANGE = 1 << 64  # values of 64 bits

#: Wire type -> bytes of a number of fixed size.
_SIZES = {1: 8, 5: 4}


def read_message(data: bytes) -> dict[int, Value]:
    """Fields of a message by number; of a repeated one the last.  Integers are signed by two's complement.

    Raises ValueError when the data is no message.
    """
    fields: dict[int, Value] = {}
    place, end = 0, len(data)
    while place < end:
        key, place = _varint(data, place)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, place = _varint(data, place)
            fields[number] = value - _RANGE if value >= _SIGN else value
            continue
        size, place = _varint(data, place) if wire == 2 else (_SIZES.get(wire, end), place)
        if number == 0 or place + size > end:
            raise ValueError("a field that is cut off or of an unknown kind")
        content = data[place : place + size]
        place += size
        fields[number] = content if wire == 2 else struct.unpack("<d" if wire == 1 else "<f", content)[0]
    return fields


class Message:
    """A message whose parts are read when they are asked for, each once; damaged parts count as missing."""

    def __init__(self, data: bytes) -> None:
        self._parts: dict[tuple[int, ...], dict[int, Value]] = {(): read_message(data)}

    def at(self, path: tuple[int, ...]) -> Value | None:
        """The value at a path of field numbers, None where there is none."""
        return self.fields(path[:-1]).get(path[-1])

    def fields(self, path: tuple[int, ...]) -> dict[int, Value]:
        """The fields of the message at a path, empty where there is none."""
        found = self._parts.get(path)
        if found is None:
            content = self.at(path)
            try:
                found = read_message(content) if isinstance(content, bytes) else {}
            except ValueError:
                found = {}
            self._parts[path] = found
        return found

    def holds(self, path: tuple[int, ...]) -> bool:
        """Whether there is a message at a path, an empty one included: proto3 leaves out zeros."""
        return isinstance(self.at(path), bytes)


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        if place >= len(data):
            raise ValueError("a number that is cut off")
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (_RANGE - 1), place
        shift += 7
    raise ValueError("a number of more than ten bytes")


Path = tuple[int, ...]

#: In the first message: the schema's name.
SCHEMA: Path = (1, 1, 1)
#: Fields of a position: unit (1 = degrees), latitude, longitude.
UNIT = 1
LATITUDE = 2  # number of its field
LONGITUDE = 3  # number of its field


class Layout(NamedTuple):
    """Places of the values of one family of models.

    aircraft : roll, pitch, yaw in fields 1 to 3
    gimbal : pitch, roll, yaw in fields 1 to 3; None = the file has none
    quaternion : of the gimbal, in fields 1 to 4, on some models
    position : unit, latitude, longitude in fields 1 to 3; the height above the sea is in field 2 beside it
    relative_height : above take-off
    """

    aircraft: Path
    gimbal: Path | None
    quaternion: Path | None
    position: Path
    relative_height: Path


WITH_GIMBAL = Layout((3, 3, 3), (3, 4, 3), (3, 4, 4), (3, 3, 4, 1), (3, 3, 5, 1))
WITHOUT_GIMBAL = Layout((3, 4, 3), None, None, (3, 4, 4, 1), (3, 4, 5, 1))


class Model(NamedTuple):
    """A model of drone.

    focal_35mm_mm : 35 mm equivalents of its cameras, the main one first
    degrees : whether coordinates are degrees whatever the unit field holds
    zoom : place of the digital zoom, None = unknown
    """

    name: str
    layout: Layout
    focal_35mm_mm: tuple[float, ...]
    degrees: bool = False
    zoom: Path | None = None

    def lens(self) -> Lens:
        """The main camera's lens."""
        focal = self.focal_35mm_mm[0]
        which = "only camera" if len(self.focal_35mm_mm) == 1 else "main camera, which is assumed"
        return Lens(focal, f"{focal:g} mm equivalent of the {self.name}'s {which}, full sensor width assumed")


#: Schema name -> model.
MODELS = {
    "dvtm_Mini4_Pro": Model("Mini 4 Pro", WITH_GIMBAL, (24,)),
    "dvtm_Mini5Pro": Model("Mini 5 Pro", WITH_GIMBAL, (24,), degrees=True),
    "dvtm_Air3": Model("Air 3", WITH_GIMBAL, (24, 70)),
    "dvtm_Air3s": Model("Air 3S", WITH_GIMBAL, (24, 70)),
    "dvtm_wm265e": Model("Mavic 3", WITH_GIMBAL, (24, 162), zoom=(3, 2, 6, 1)),
    "dvtm_wm261": Model("Mavic 3 Pro", WITH_GIMBAL, (24, 70, 166)),
    "dvtm_Mavic4": Model("Mavic 4 Pro", WITH_GIMBAL, (28, 70, 168), degrees=True),
    "dvtm_pm320": Model("Matrice 30", WITH_GIMBAL, (24, 113), zoom=(3, 2, 6, 1)),
    "dvtm_wa345e": Model("Matrice 4E", WITH_GIMBAL, (24, 70, 168)),
    "dvtm_AVATA2": Model("Avata 2", WITHOUT_GIMBAL, (12,)),
    "dvtm_dji_neo": Model("Neo", WITHOUT_GIMBAL, (14,)),
}


def find_layout(messages: list[Message], model: Model | None) -> Layout | None:
    """The layout of a clip from some of its messages, of an unknown model by what is there; None = none fits.

    Its position is where coordinates are found, which is not the same place in every firmware.
    """
    layout = model.layout if model else None
    if layout is None and any(m.holds(WITH_GIMBAL.aircraft) for m in messages):
        layout = WITH_GIMBAL
    position = next((place for m in messages for place in _positions(m, layout)), None)
    if position is None:
        return layout
    if layout is None:
        layout = WITHOUT_GIMBAL if position[:2] == WITHOUT_GIMBAL.position[:2] else WITH_GIMBAL
    return layout._replace(position=position)


def _positions(message: Message, layout: Layout | None) -> Iterator[Path]:
    """Places of two doubles at the fields of a latitude and a longitude, the known places first."""
    places = [one.position for one in ((layout,) if layout else (WITH_GIMBAL, WITHOUT_GIMBAL))]
    for parent in ((3, 3, 4), (3, 4)):
        places.append(parent)
        # Highest field number at which a position is searched; the known ones are below 6.
        for child in range(1, 13):
            places += [(*parent, child), (*parent, child, 1)]
    for place in places:
        fields = message.fields(place)
        if isinstance(fields.get(LATITUDE), float) and isinstance(fields.get(LONGITUDE), float):
            yield place
