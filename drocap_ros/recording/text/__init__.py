"""Text and tables of other programs: in UTF-8 or UTF-16, with commas, semicolons or tabs, and with decimal commas."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

#: Characters of a line: keypoints of whole bodies have some thousands.
LINE = 1 << 16
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")


def open_text(path: Path) -> TextIO:
    """A text file, whose first bytes say how it is encoded."""
    with path.open("rb") as file:
        wide = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    return path.open("r", encoding="utf-16" if wide else "utf-8-sig", errors="replace", newline="")


def with_point(text: str) -> str:
    """A number with its comma as a point, any other text as it is."""
    return text.replace(",", ".") if "," in text and _DECIMAL_COMMA.fullmatch(text) else text


def rows_of(path: Path) -> Iterator[list[str]]:
    """Cells of the rows of a table, from the first that is neither empty nor a remark (``#``, ``sep=;``)."""
    with open_text(path) as file:
        lines = iter(lambda: file.readline(LINE), "")
        first = next((line for line in lines if not re.match(r'\s*(#|"?sep=|$)', line, re.IGNORECASE)), "")
        for row in csv.reader(itertools.chain([first], lines), delimiter=max(",;\t", key=first.count)):
            if row:
                yield [with_point(cell.strip()) for cell in row]
