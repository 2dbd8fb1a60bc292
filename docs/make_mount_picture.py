"""Write docs/mounts.svg: ``python docs/make_mount_picture.py``.  The three mounts on a body that leans nose down.

In each panel the camera looks down by 20 degrees; the angle that a configuration, a command or a report holds is drawn.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

LEAN_DEG, SIGHT_DEG = -8.0, -20.0
WIDTH, HEIGHT, PANEL = 960, 300, 320
INK, BODY, SIGHT, ANGLE = "#57606a", "#2e86de", "#e4572e", "#3fb56f"
BACK = "#ffffff"


class Panel(NamedTuple):
    """Title, the line against which the pitch counts (degrees above the horizon), and two lines below."""

    title: str
    against_deg: float
    lines: tuple[str, str]


PANELS = (
    Panel("gimbal", 0.0, ("against the horizon: pitch -20", "commanded and reported so")),
    Panel("servo", LEAN_DEG, ("against the body: pitch -12", "reported so; commanded -20 against the horizon")),
    Panel("fixed", LEAN_DEG, ("against the body: camera_pitch_deg -12", "leans with the body: -20 now")),
)


def end(x: float, y: float, angle_deg: float, length: float) -> tuple[float, float]:
    """End of a line at an angle above the horizon; the picture's y points down."""
    return x + length * math.cos(math.radians(angle_deg)), y - length * math.sin(math.radians(angle_deg))


def line(x: float, y: float, angle_deg: float, length: float, colour: str, style: str = "") -> str:
    """One line of the picture."""
    x2, y2 = end(x, y, angle_deg, length)
    return f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" {style}/>'


def text(x: float, y: float, words: str, colour: str = INK, size: int = 14, anchor: str = "start") -> str:
    """Words at a place."""
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="{size}" text-anchor="{anchor}">{words}</text>'


def draw(panel: Panel, left: float) -> list[str]:
    """One panel: body, camera, line of sight, and the angle."""
    x, y, radius = left + 100.0, 110.0, 130.0
    thin, dashed, thick = 'stroke-width="1"', 'stroke-width="1" stroke-dasharray="5 4"', 'stroke-width="5"'
    x1, y1 = end(x, y, panel.against_deg, radius)
    x2, y2 = end(x, y, SIGHT_DEG, radius)
    middle = 0.5 * (panel.against_deg + SIGHT_DEG)
    label = end(x, y, middle, radius + 8)
    return [
        text(left + PANEL / 2, 30, f"mount: {panel.title}", size=18, anchor="middle"),
        line(x, y, 0.0, 200.0, INK, dashed),
        text(x + 200, y - 6, "horizon", size=12, anchor="end"),
        line(x, y, LEAN_DEG, radius + 2, BODY, thin),
        line(x, y, LEAN_DEG, 55.0, BODY, thick),
        line(x, y, LEAN_DEG + 180, 55.0, BODY, thick),
        text(x - 75, y - 28, "body, nose down: -8", BODY, 12),
        line(x, y, SIGHT_DEG, 200.0, SIGHT, 'stroke-width="2"'),
        f'<circle cx="{x}" cy="{y}" r="7" fill="{SIGHT}"/>',
        f'<path d="M {x1:.1f} {y1:.1f} A {radius} {radius} 0 0 1 {x2:.1f} {y2:.1f}" fill="none" stroke="{ANGLE}" '
        'stroke-width="4"/>',
        text(label[0], label[1] + 5, f"{SIGHT_DEG - panel.against_deg:.0f}", ANGLE, 17),
        text(left + PANEL / 2, 215, panel.lines[0], anchor="middle"),
        text(left + PANEL / 2, 236, panel.lines[1], size=12, anchor="middle"),
    ]


def main() -> None:
    """Write the picture."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="{BACK}"/>',
    ]
    for i, panel in enumerate(PANELS):
        parts += draw(panel, i * PANEL)
    rule = "Pitch in degrees, as in MAVLink: positive = up, negative = the camera looks down. Everywhere."
    parts += [text(WIDTH / 2, 278, rule, size=16, anchor="middle"), "</svg>"]
    path = Path(__file__).with_name("mounts.svg")
    path.write_text("\n".join(parts) + "\n", encoding="utf-8")
    print(f"written: {path}")


if __name__ == "__main__":
    main()
