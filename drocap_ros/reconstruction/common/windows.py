"""Recordings of any length in overlapping windows: linear time, bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput, Report

#: Frame rate of the network; other rates are resampled.
LIFTER_FPS = 24.0


def even_slots(stamp_ns: np.ndarray) -> tuple[np.ndarray, float]:
    """Slot (F,) of each frame on an even grid of the median frame time, and the frames per second.

    A pause counts as at most a second, and the grid has at most four slots per frame.
    """
    if len(stamp_ns) < 2:
        return np.zeros(len(stamp_ns), np.intp), LIFTER_FPS
    step = np.diff(stamp_ns).astype(np.float64)
    usual = float(np.median(step))
    fps = float(np.clip(1e9 / usual, 1.0, 1000.0))
    places = np.clip(np.round(step / usual), 1, max(round(fps), 1)).astype(np.intp)
    if places.sum() > 4 * len(stamp_ns):
        places[:] = 1
    return np.concatenate([[0], np.cumsum(places)]), fps


def spread_keypoints(keypoints: Keypoints2D, slot: np.ndarray) -> Keypoints2D:
    """Keypoints at their slots of the even grid; empty slots have no seen joint."""
    confidence, covariance = keypoints.confidence, keypoints.covariance
    return Keypoints2D(
        spread(keypoints.xy, slot, np.nan),
        None if confidence is None else spread(confidence, slot, 0.0),
        None if covariance is None else spread(covariance, slot, np.nan),
    )


def spread(values: np.ndarray, slot: np.ndarray, empty: float) -> np.ndarray:
    """Values (F, ...) at their slots of the even grid, ``empty`` between them."""
    out = np.full((slot[-1] + 1, *values.shape[1:]), empty)
    out[slot] = values
    return out


def over_windows(data: MethodInput, solve: Callable[[slice], ImagePoses]) -> ImagePoses:
    """Solve window by window and cross-fade the results where windows overlap."""
    frames, overlap = len(data.keypoints), data.adjuster.overlap_frames
    rows_of = windows(frames, data.adjuster.window_frames, overlap)
    faded, reports = Faded(frames), []
    for rows in rows_of:
        found = solve(rows)
        fade = fade_weights(rows, frames, overlap)
        faded.add(rows, fade, in_image=found.in_image, sigma_px=found.sigma_px, still=found.still)
        reports.append(found.report)
        data.progress("ba", rows.stop / frames)
    return replace(ImagePoses.centred(**faded.mean()), spread=found.spread, report=_together(reports))


class Faded:
    """Values of windows by name, faded into each other; ``weight`` : (F,), 0 = no window has the frame."""

    def __init__(self, frames: int) -> None:
        self.weight = np.zeros(frames)
        self._sums: dict[str, np.ndarray] = {}

    def add(self, rows: slice, fade: np.ndarray, **values: np.ndarray | None) -> None:
        """Add those (R, ...) of a window with the weights (R,) of its frames; None is left out."""
        self.weight[rows] += fade
        for name, value in values.items():
            if value is not None:
                total = self._sums.setdefault(name, np.zeros((len(self.weight), *value.shape[1:])))
                total[rows] += _along(fade, value) * value

    def mean(self) -> dict[str, np.ndarray]:
        """Those of all frames, 0 where there are none."""
        weight = np.where(self.weight == 0.0, 1.0, self.weight)
        return {name: total / _along(weight, total) for name, total in self._sums.items()}


def _along(per_frame: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(F,) with as many axes as the values (F, ...)."""
    return per_frame.reshape(-1, *(1,) * (values.ndim - 1))


def _together(reports: list[Report]) -> Report:
    """Sums over the windows; the stop reasons of all."""
    terms: dict[str, float] = {}
    seconds: dict[str, float] = {}
    for report in reports:
        for total, values in ((terms, report.cost_terms), (seconds, report.seconds)):
            for name, value in values.items():
                total[name] = total.get(name, 0.0) + value
    stops = ", ".join(sorted({report.stop_reason for report in reports}))
    return Report(sum(report.iterations for report in reports), stops, terms, seconds, reports[0].origin)


def windows(frames: int, length: int, overlap: int) -> list[slice]:
    """Windows of equal length, at most ``length``; neighbours share about ``overlap`` frames."""
    if frames <= length:
        return [slice(0, frames)]
    overlap = min(overlap, length // 2)
    count = int(np.ceil((frames - overlap) / (length - overlap)))
    # The shortest windows with this overlap: 1000 frames take three windows of 374, not of 480.
    length = int(np.ceil((frames + (count - 1) * overlap) / count))
    begins = np.round(np.linspace(0, frames - length, count)).astype(int)
    return [slice(int(begin), int(begin) + length) for begin in begins]


def fade_weights(rows: slice, frames: int, overlap: int) -> np.ndarray:
    """Weights of a window's frames that rise over the overlap with the one before and fall over that with the next."""
    count = rows.stop - rows.start
    ramp = np.minimum(np.arange(1, count + 1) / (overlap + 1.0), 1.0)
    return (ramp if rows.start > 0 else np.ones(count)) * (ramp[::-1] if rows.stop < frames else np.ones(count))
