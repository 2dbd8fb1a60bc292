"""What the index of an MP4 or MOV file (ISO/IEC 14496-12) says that OpenCV does not."""

from __future__ import annotations

import contextlib
import io
import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

#: Bounds against damaged files: boxes at one level, and the bytes of an index of hours.
_MAX_BOXES, _MAX_INDEX = 4096, 1 << 26
#: Bytes of a box, of which a thousand times the boxes are a place in a file still (63 bits): beyond it is no MP4.
_MAX_BOX = 1 << 50


def movie_s(path: Path) -> float | None:
    """Seconds that a file shows, None where it does not state them."""
    _, index = _index(path)
    if index[4:8] != b"mvhd" or len(index) < 40:
        return None
    scale, duration = struct.unpack_from(">IQ" if index[8] == 1 else ">II", index, 28 if index[8] == 1 else 20)
    return duration / scale if scale and duration else None


def formats(path: Path) -> str:
    """Codes of the tracks' formats behind a colon, nothing where there are none."""
    found = re.findall(rb"stsd.{12}([\w ]{4})", _index(path)[1], re.DOTALL)
    return f": {', '.join(code.decode() for code in found)}" if found else ""


@contextlib.contextmanager
def largest_alone(path: Path) -> Iterator[str]:
    """A name by which FFmpeg opens a file without its other video tracks, where the largest one is not the first.

    OpenCV reads the first one.  The names of the others' boxes are read from a file of four bytes, as free space.
    """
    name, others = str(path.absolute()), _smaller_tracks(path)  # an absolute path is never taken for a protocol
    if not others or "|" in name:
        yield name
        return
    with tempfile.NamedTemporaryFile(prefix="drocap_") as free:
        free.write(b"free")
        free.flush()
        parts, begin = list[str](), 0
        for place in others:
            parts += [f"subfile,,start,{begin},end,{place},,:{name}", free.name]
            begin = place + 4
        yield "concat:" + "|".join([*parts, f"subfile,,start,{begin},end,{path.stat().st_size},,:{name}"])


def _smaller_tracks(path: Path) -> list[int]:
    """Places of the names of all video tracks but the largest one, none where that is the first."""
    place, index = _index(path)
    areas: dict[int, int] = {}
    for at, name, end in _boxes(io.BytesIO(index)):
        body = index[at:end]
        header = body.find(b"tkhd")
        if name == b"trak" and header >= 4 and re.search(rb"hdlr.{8}vide", body, re.DOTALL):
            last = header - 4 + int.from_bytes(body[header - 4 : header], "big")
            sides = body[last - 8 : last]  # 16.16 px
            areas[place + at - 4] = int.from_bytes(sides[:2], "big") * int.from_bytes(sides[4:6], "big")
    largest = max(areas, key=lambda key: areas[key], default=0)
    return [at for at in areas if at != largest] if areas and areas[largest] > next(iter(areas.values())) else []


def _index(path: Path) -> tuple[int, bytes]:
    """Where the content of the index begins, and the content."""
    with path.open("rb") as file:
        for begin, name, end in _boxes(file):
            if name == b"moov" and end - begin <= _MAX_INDEX:
                file.seek(begin)
                return begin, file.read(end - begin)
    return 0, b""


def _boxes(file: IO[bytes]) -> Iterator[tuple[int, bytes, int]]:
    """Begin of the content, name and end of the boxes of one level."""
    place = 0
    for _ in range(_MAX_BOXES):
        file.seek(place)
        head = file.read(16)
        if len(head) < 8:
            return
        size, begin = int.from_bytes(head[:4], "big"), place + 8
        if size == 1:
            size, begin = int.from_bytes(head[8:], "big"), place + 16
        if size < begin - place or size > _MAX_BOX:
            return
        yield begin, head[4:8], place + size
        place += size
