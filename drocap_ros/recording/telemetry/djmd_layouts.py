"""Places of values in the messages of DJI's ``djmd`` track, by the name of their schema.

A place is a path of protobuf field numbers.  Source: the DJI tags of ExifTool 13, https://exiftool.org/TagNames/DJI.html.
Angles are tenths of a degree; coordinates are radians, or degrees where a unit field holds 1; heights are mm.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from drocap_ros.recording.telemetry.log import Lens
from drocap_ros.recording.telemetry.protobuf import Message

Path = tuple[int, ...]

#: In the first message: the schema's name.
SCHEMA: Path = (1, 1, 1)
#: Fields of a position: unit (1 = degrees), latitude, longitude.
UNIT = 1
LATITUDE = 2  # number of its field
LONGITUDE = 3  # number of its field
#: Highest field number at which a position is searched; the known ones are below 6.
_SEARCHED = 12


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
        for child in range(1, _SEARCHED + 1):
            places += [(*parent, child), (*parent, child, 1)]
    for place in places:
        fields = message.fields(place)
        if isinstance(fields.get(LATITUDE), float) and isinstance(fields.get(LONGITUDE), float):
            yield place
