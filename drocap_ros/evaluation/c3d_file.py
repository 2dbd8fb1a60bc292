"""Points of a C3D file (https://www.c3d.org/HTML): names, positions, rate, unit and vertical as it states them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.tracks import MAX_FRAMES

#: Bytes of a block, in which the file counts its sections.
_BLOCK = 512
#: Processors whose numbers are read: Intel, and MIPS with the other order of bytes; DEC's floats are no IEEE ones.
_ORDERS = {84: "<", 86: ">"}
#: Parameters of text are of this type.
_TEXT = -1
#: The header counts frames in 16 bits: with this last one the file may hold more.
_LAST_COUNTED = 65_535


class C3d(NamedTuple):
    """positions (F, P, 3) in ``unit``, NaN unknown; ``vertical`` as of the parameter Y_SCREEN, empty where unknown."""

    names: list[str]
    positions: np.ndarray
    rate_hz: float
    unit: str
    vertical: str


def read_c3d(path: Path) -> C3d:
    """The points of a file."""
    data = path.read_bytes()
    try:
        begin = _BLOCK * (data[0] - 1)
        order = _ORDERS[data[begin + 3]]
        parameters = _parameters(data[begin : begin + _BLOCK * data[begin + 2]], order)
        count, analog, first, last, _, scale, block, _, rate = struct.unpack_from(f"{order}HHHHHfHHf", data, 2)
    except (struct.error, IndexError, KeyError) as error:
        raise InputError(f"expected a C3D file of an Intel or MIPS processor, found damage ({error})") from None
    if count == 0 or block < 2:
        raise InputError(f"expected points in the C3D file, found {count}; export it again")
    kind = np.dtype(f"{order}{'f4' if scale < 0 else 'i2'}")
    words = np.frombuffer(data[_BLOCK * (block - 1) :], np.uint8)
    width = 4 * count + analog
    whole = len(words) // (width * kind.itemsize)
    frames = min(whole, MAX_FRAMES) if last >= _LAST_COUNTED else min(whole, max(last - first + 1, 0))
    table = words[: frames * width * kind.itemsize].view(kind).reshape(frames, width)[:, : 4 * count]
    points = table.astype(np.float64).reshape(frames, count, 4)
    points[points[..., 3] < 0] = np.nan
    names = [name for i in ("", *range(2, 9)) for name in parameters.get(f"LABELS{i}", [])]
    unit, vertical = ("".join(parameters.get(name, [""])[:1]) for name in ("UNITS", "Y_SCREEN"))
    positions = points[..., :3] * (1.0 if scale < 0 else scale)
    return C3d(names[:count], positions[:, : len(names)], float(rate), unit.lower(), vertical.upper().lstrip("+"))


def _parameters(section: bytes, order: str) -> dict[str, list[str]]:
    """Texts of the group POINT by name."""
    texts: dict[str, tuple[int, list[str]]] = {}
    point, place = 0, 4
    while place + 2 <= len(section):
        length, group = struct.unpack_from("bb", section, place)
        if not length or not group:
            break
        begin = place + 2 + abs(length)
        name = section[place + 2 : begin].decode("latin1").upper()
        step = struct.unpack_from(f"{order}h", section, begin)[0]
        if group < 0 and name == "POINT":
            point = -group
        elif group > 0 and struct.unpack_from("b", section, begin + 2)[0] == _TEXT:
            texts[f"{group}:{name}"] = (group, _texts(section[begin + 3 :]))
        if step <= 0:
            break
        place = begin + step
    return {name.split(":", 1)[1]: values for name, (group, values) in texts.items() if group == point}


def _texts(data: bytes) -> list[str]:
    """The texts of a parameter: number of dimensions, their sizes, characters; the first size is that of a text."""
    sizes = list(data[1 : 1 + data[0]]) or [1]
    width, count = sizes[0], int(np.prod(sizes[1:], dtype=np.int64))
    body = data[1 + data[0] :][: width * min(count, len(data))]
    return [body[at : at + width].decode("latin1").strip() for at in range(0, len(body), width)] if width else []
