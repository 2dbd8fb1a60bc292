"""The scale of the measured ranges, from the vehicle's own way about a subject who stands.

The range by body size errs by what the subject's bones differ from those of his height, the range by the ground by an
error of the vehicle's height: both for minutes.  One who stands is seen from every place of the orbit at one place of
the map if the ranges are right, and on a circle about it if they are not: the radius of that circle is the error.
"""

from __future__ import annotations

import math

import numpy as np

#: s; older pictures count less.  An orbit of 11 deg/s takes 33 s; the height of the worse autopilot wanders for longer.
_MEMORY_S = 30.0
#: s, for which errors of the vehicle's position last: recorded ones of both autopilots halve within 2 s.
_LASTS_S = 5.0
_LEAST_RESIDUAL_M2 = 0.05**2  # a body that stands sways: residuals that are smaller are chance
#: Spread of the directions, as of an arc of 45 degrees (a whole circle has 1), below which they show nothing: the noise
#: of bearings looks like a small arc, and a range that changes before a vehicle that hovers like any scale.
_LEAST_SPREAD = 0.05
_MOST = 2.0  # standard deviations of the range by body size, by which the scale is corrected at most


class Parallax:
    """Sums over pictures of one subject who stands; ``scale`` multiplies a measured range.

    Parameters
    ----------
    size_error : standard deviation of the range by body size, as a share: what is believed before the vehicle moves
    """

    def __init__(self, size_error: float) -> None:
        self._size_error = size_error
        self.scale = 1.0
        self.forget()

    def forget(self) -> None:
        """Begin anew, as where the subject walks; the scale stays what it was."""
        self._prior = self.scale
        self._seconds = 0.0
        self._sums: np.ndarray = np.zeros(7)  # place (2), direction (2), place.place, place.direction, range: by time

    def take(self, place: np.ndarray, sight: np.ndarray, seconds: float) -> None:
        """Take a picture.

        Parameters
        ----------
        place : (2,) m, of the camera in the map frame
        sight : (2,) m, from there to the subject as measured, without this scale
        seconds : since the picture before
        """
        fade = math.exp(-seconds / _MEMORY_S)
        self._seconds = fade * self._seconds + seconds
        distance = float(np.hypot(*sight))
        toward = sight / max(distance, 1e-3)
        news = np.concatenate([place, toward, [place @ place, place @ toward, distance]])
        self._sums = fade * self._sums + seconds * news
        mean = self._sums / self._seconds
        places, both = mean[4:6] - mean[:2] @ np.stack([mean[:2], mean[2:4]], axis=1)
        spread = 1.0 - float(mean[2:4] @ mean[2:4])
        # place + radius * direction = the subject's place: least squares with his place free.
        radius = -both / max(spread, _LEAST_SPREAD)
        residual = max(places - radius**2 * spread, _LEAST_RESIDUAL_M2)
        known, measured = self._size_error**-2, float(mean[6])
        shown = self._seconds / _LASTS_S * measured**2 * max(spread - _LEAST_SPREAD, 0.0) / residual
        scale = (known * self._prior + shown * radius / max(measured, 1e-3)) / (known + shown)
        most = _MOST * self._size_error
        self.scale = float(min(max(scale, 1.0 - most), 1.0 + most))
