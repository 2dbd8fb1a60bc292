"""The camera's field of view from what a file says of its lens."""

from __future__ import annotations

import math
from typing import NamedTuple

#: Width in mm of a 4:3 sensor with the diagonal of 35 mm film, to which equivalent focal lengths refer.
_EQUIVALENT_WIDTH_MM = 0.8 * math.hypot(36.0, 24.0)
#: 35 mm equivalent of the main camera of most DJI drones.
_USUAL_MM = 24.0


class Lens(NamedTuple):
    """A lens as a file describes it.

    focal_35mm_mm : focal length, 35 mm equivalent (of the sensor's diagonal)
    origin : text, where it comes from and what is assumed
    zoom : digital zoom
    """

    focal_35mm_mm: float
    origin: str
    zoom: float = 1.0

    def __str__(self) -> str:
        return self.origin if self.zoom == 1.0 else f"{self.origin}, digital zoom {self.zoom:g}"

    def horizontal_fov_deg(self, size: tuple[int, int]) -> float:
        """Field of view across images of ``size`` (width, height) that use the longer side of a 4:3 sensor in full."""
        focal_px = max(size) * self.focal_35mm_mm / _EQUIVALENT_WIDTH_MM * self.zoom
        return math.degrees(2 * math.atan(0.5 * size[0] / focal_px))


def assumed_lens(zoom: float = 1.0) -> Lens:
    """The lens of an unknown model: that of most main cameras."""
    return Lens(_USUAL_MM, f"{_USUAL_MM:g} mm equivalent assumed, as of most DJI main cameras", zoom)
