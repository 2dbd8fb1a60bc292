"""Where a clip goes on in another shot, by the fixed points it sees."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drocap_ros.background import Background
from drocap_ros.tracks import Tracks

#: Points with which an image tells.
_LEAST_POINTS = 12
#: Share of the points that goes on over a cut, at most: some corners of the new image look like those of the old one.
_GOES_ON = 0.05
#: Longest time (s) without points that counts as a cut: a fade; later no point could go on anyway.
_FADE_S = 0.5
#: Logarithm of the factor by which an image grows or shrinks at once where a cut leads to a nearer or farther view of
#: the same scene, and how many times that between the images beside: clips of drones and hands, with 5 to 60 images a
#: second, have up to 0.04, and that steadily.
_GROWS = 0.05
_AT_ONCE = 4.0
#: Distance (px) of points from their middle below which they tell no growth: errors of tracks are as large.
_SAME_PX = 1.0


def cut_times(tracks: Tracks) -> list[float]:
    """Times (s) of the cuts in a clip without telemetry, by its fixed points."""
    if tracks.background is None or tracks.camera_rotation is not None:
        return []
    time_s = (tracks.stamp_ns - tracks.stamp_ns[0]) * 1e-9
    return [float(time_s[image]) for image in cuts(tracks.background, time_s)]


def cuts(points: Background, time_s: np.ndarray) -> list[int]:
    """First images of further shots: hardly a point goes on there, or the picture is larger or smaller at once.

    time_s : (F,) of the images
    """
    order = np.argsort(points.frame, kind="stable")
    rows = np.split(order, np.searchsorted(points.frame[order], np.arange(1, len(time_s))))
    pairs = list(pairwise(image for image, seen in enumerate(rows) if len(seen) >= _LEAST_POINTS))
    compared = [_compared(points, rows[before], rows[after]) for before, after in pairs]
    growth = np.array([0.0, *(grown for _, grown in compared), 0.0])
    beside = np.maximum(growth[:-2], growth[2:])
    jumps = growth[1:-1] > np.maximum(_GROWS, _AT_ONCE * beside)
    return [
        before + 1
        for (before, after), (share, _), jump in zip(pairs, compared, jumps, strict=True)
        if (share < _GOES_ON or jump) and time_s[after] - time_s[before] <= _FADE_S
    ]


def _compared(points: Background, before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Share of the points that two images have in common, and the size of the logarithm by which most grow apart."""
    common, *places = np.intersect1d(points.track[before], points.track[after], return_indices=True)
    share = len(common) / min(len(before), len(after))
    if len(common) < _LEAST_POINTS:
        return share, 0.0
    first, second = (
        np.maximum(np.linalg.norm(seen - np.median(seen, axis=0), axis=1), _SAME_PX)
        for seen in (points.point[rows[place]] for rows, place in zip((before, after), places, strict=True))
    )
    return share, float(np.abs(np.median(np.log(second / first))))
