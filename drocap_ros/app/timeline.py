"""The timeline of corrections: images with the range, and a row of rests for each foot, as SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drocap_ros.app.skeleton_svg import rgb
from drocap_ros.skeleton import COLOURS

#: Width of the timeline and height of each of its three rows, px.
WIDTH, ROW = 1000.0, 28.0
HEIGHT = 3 * ROW
FEET = ("left", "right")
#: Of a foot that rests by hand, or does not.
_RESTS, _RESTS_NOT = 'fill="#2a2" stroke="white"', 'fill="#888" stroke="#c33" stroke-width="2" stroke-dasharray="6"'


class TimeAxis:
    """Images at seconds (F,) since the first one, side by side."""

    def __init__(self, seconds: np.ndarray) -> None:
        self._seconds = seconds

    def time(self, image: int) -> float:
        """Seconds of an image, as a file of corrections has them."""
        return round(float(self._seconds[image]), 4)

    def image(self, seconds: float) -> int:
        """The image nearest to a time."""
        return int(np.argmin(np.abs(self._seconds - seconds)))

    def span(self, entry: Mapping[str, Any]) -> tuple[int, int]:
        """First and last image of a correction, which may leave out either end."""
        if "time" in entry:
            return (self.image(entry["time"]),) * 2
        return self.image(entry.get("from", 0.0)), self.image(entry.get("to", self._seconds[-1]))

    def x(self, image: int) -> float:
        """Place of an image, px."""
        return WIDTH * image / max(len(self._seconds) - 1, 1)

    def at(self, x: float) -> int:
        """The image at a place."""
        last = len(self._seconds) - 1
        return int(np.clip(round(x / WIDTH * last), 0, last))


def bars_svg(
    axis: TimeAxis,
    shown: int,
    chosen: tuple[int, int] | None,
    rests: Sequence[Sequence[tuple[int, int]]],
    corrections: Mapping[str, Sequence[Mapping[str, Any]]],
) -> str:
    """Elements of the timeline.

    shown : image in the picture; chosen : first and last image of the range
    rests : of the left and of the right foot, first image and end
    corrections : entries of a file
    """

    def bar(first: int, last: int, y: float, height: float, style: str) -> str:
        a, b = axis.x(first), axis.x(last)
        return f'<rect x="{a:.1f}" y="{y}" width="{max(b - a, 3):.1f}" height="{height}" {style}/>'

    out = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#8882"/>']
    if chosen is not None:
        out.append(bar(*chosen, 0, ROW, 'fill="#fc08"'))
    out += [
        bar(*axis.span(entry), ROW - 6, 6, 'fill="#e80"')
        for kind, entries in corrections.items()
        if kind != "feet"
        for entry in entries
    ]
    for row, (foot, spans) in enumerate(zip(FEET, rests, strict=True), start=1):
        y, style = ROW * row + 4, f'fill="{rgb(COLOURS[foot])}" fill-opacity="0.6"'
        out += [bar(a, b - 1, y, ROW - 8, style) for a, b in spans]
        out += [
            bar(*axis.span(entry), y, ROW - 8, _RESTS if entry["rests"] else _RESTS_NOT)
            for entry in corrections.get("feet", ())
            if entry["foot"] == foot
        ]
    out += [
        f'<text x="4" y="{ROW * (row + 0.7)}" font-size="13" fill="currentColor">{words}</text>'
        for row, words in enumerate(("range", *(f"{foot} foot" for foot in FEET)))
    ]
    x = axis.x(shown)
    out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT}" stroke="currentColor" stroke-width="2"/>')
    return "".join(out)
