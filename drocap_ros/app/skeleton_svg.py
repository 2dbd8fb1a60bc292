"""Bones and joints over a picture, as SVG."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

import numpy as np

from drocap_ros.skeleton import COLOURS, side_of


def rgb(colour: tuple[int, int, int]) -> str:
    """A colour as SVG writes it."""
    return "rgb({},{},{})".format(*colour)


def skeleton_svg(
    joints: tuple[str, ...],
    bones: Iterable[tuple[int, int]],
    at: np.ndarray,
    radius: float,
    rings: Mapping[int, str] | None = None,
) -> str:
    """Elements of joints at (P, 2) px of the picture, NaN = none, by the colours of the body's sides.

    bones : pairs of joints; rings : colour about some of the joints
    """
    seen = np.isfinite(at).all(axis=1)
    colours = [rgb(COLOURS[side_of(name, joints)]) for name in joints]
    lines = [
        f'<line x1="{at[a][0]:.1f}" y1="{at[a][1]:.1f}" x2="{at[b][0]:.1f}" y2="{at[b][1]:.1f}" stroke="{colours[b]}"'
        f' stroke-width="{0.5 * radius:.1f}" stroke-opacity="0.8" stroke-linecap="round"/>'
        for a, b in bones
        if seen[a] and seen[b]
    ]
    dots = [
        f'<circle data-joint="{escape(joints[i])}" cx="{at[i][0]:.1f}" cy="{at[i][1]:.1f}" r="{radius:.1f}"'
        f' fill="{colours[i]}" stroke="{(rings or {}).get(i, "none")}" stroke-width="{0.5 * radius:.1f}">'
        f"<title>{escape(joints[i])}</title></circle>"
        for i in np.flatnonzero(seen)
    ]
    return "".join((*lines, *dots))
