"""Small SVG plots: lines over time, bars, ranges.  Colours and fonts come from the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

#: Sizes in units of the SVG, px at its natural size: the plot, its margins, a row of bars and its label.
WIDTH = 420
_LEFT = 44  # px: the widest tick's label
_RIGHT = 10  # px
_TOP = 8  # px
_BOTTOM = 24  # px: a line of ticks' labels
_ROW = 19  # px: a line of text
_LABEL = 92  # px: the longest joint's name
#: Points of one line, more than its px on a screen; longer series are averaged.
_POINTS = 700


def line_plot(times_s: np.ndarray, values: np.ndarray, *, unit: str, series: str, from_zero: bool = True) -> str:
    """SVG of one series (F,) over time (F,); ``series`` is its name in the page's data."""
    height = 170
    t, v = _thinned(np.asarray(times_s), np.asarray(values, float))
    ticks = _ticks(0.0 if from_zero else float(np.nanmin(v, initial=math.inf)), float(np.nanmax(v, initial=-math.inf)))
    last = max(float(times_s[-1]), 1e-9)
    x = _LEFT + t / last * (WIDTH - _LEFT - _RIGHT)
    floor, ceiling = height - _BOTTOM, _TOP
    y = floor - (v - ticks[0]) / (ticks[-1] - ticks[0]) * (floor - ceiling)
    parts = []
    for tick in ticks:
        level = floor - (tick - ticks[0]) / (ticks[-1] - ticks[0]) * (floor - ceiling)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{level:.1f}" y2="{level:.1f}"/>')
        parts.append(f'<text class="tick end" x="{_LEFT - 6}" y="{level + 4:.1f}">{tick:g}</text>')
    for tick in _ticks(0.0, last):
        if tick <= last * 1.0001:
            place = _LEFT + tick / last * (WIDTH - _LEFT - _RIGHT)
            parts.append(f'<text class="tick middle" x="{place:.1f}" y="{height - 7}">{tick:g} s</text>')
    parts.append(f'<path class="line" d="{_path(x, y)}"/>')
    if len(t) == 1 and np.isfinite(y).all():
        parts.append(f'<circle class="dot" cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="3"/>')
    parts.append(f'<line class="cursor" x1="{_LEFT}" x2="{_LEFT}" y1="{ceiling}" y2="{floor}"/>')
    data = f'data-series="{escape(series)}" data-unit="{escape(unit)}" data-x0="{_LEFT}" data-x1="{WIDTH - _RIGHT}"'
    return f'<svg class="plot time" viewBox="0 0 {WIDTH} {height}" {data}>{"".join(parts)}</svg>'


def bar_plot(
    names: Sequence[str], values: np.ndarray, *, form: str, classes: Sequence[str] = (), limit: float | None = None
) -> str:
    """SVG of horizontal bars with their values at the end, formatted by ``form``."""
    values = np.asarray(values, float)
    top = limit or max(float(np.nanmax(values, initial=0.0)), 1e-9)
    span = WIDTH - _LABEL - 64
    parts = []
    for row, (name, value) in enumerate(zip(names, values, strict=True)):
        y = 4 + row * _ROW
        kind = classes[row] if classes else "middle-body"
        parts.append(f'<text class="label end" x="{_LABEL - 8}" y="{y + 12}">{escape(name)}</text>')
        parts.append(f'<rect class="track" x="{_LABEL}" y="{y + 3}" width="{span}" height="11" rx="2"/>')
        if math.isfinite(value):
            length = max(0.0, min(1.0, value / top)) * span
            parts.append(f'<rect class="bar {kind}" x="{_LABEL}" y="{y + 3}" width="{length:.1f}" height="11" rx="2"/>')
        text = form.format(value) if math.isfinite(value) else "none"
        parts.append(f'<text class="tick" x="{_LABEL + span + 8}" y="{y + 12}">{text}</text>')
    return f'<svg class="plot" viewBox="0 0 {WIDTH} {len(names) * _ROW + 8}">{"".join(parts)}</svg>'


def range_plot(names: Sequence[str], samples: np.ndarray, *, unit: str, classes: Sequence[str] = ()) -> str:
    """SVG of the spread of each column of ``samples`` (F, B): 5th to 95th percentile, and the median as a dot."""
    bands = [column[np.isfinite(column)] for column in samples.T]
    quantiles = [np.quantile(band, (0.05, 0.5, 0.95)) if band.size else None for band in bands]
    top = max(max((float(q[2]) for q in quantiles if q is not None), default=1.0), 1e-9) * 1.05
    long_label = 140
    span = WIDTH - long_label - 64
    parts = []
    for row, (name, band) in enumerate(zip(names, quantiles, strict=True)):
        y = 4 + row * _ROW + 8
        kind = classes[row] if classes else "middle-body"
        parts.append(f'<text class="label end" x="{long_label - 8}" y="{y + 4}">{escape(name)}</text>')
        parts.append(f'<rect class="track" x="{long_label}" y="{y - 1}" width="{span}" height="2"/>')
        if band is None:
            continue
        low, middle, high = (long_label + float(q) / top * span for q in band)
        width = max(high - low, 1.0)
        parts.append(
            f'<rect class="bar {kind} soft" x="{low:.1f}" y="{y - 5}" width="{width:.1f}" height="10" rx="2"/>'
        )
        parts.append(f'<circle class="bar {kind}" cx="{middle:.1f}" cy="{y}" r="4"/>')
        parts.append(f'<text class="tick" x="{long_label + span + 8}" y="{y + 4}">{band[1]:.1f} {escape(unit)}</text>')
    return f'<svg class="plot" viewBox="0 0 {WIDTH} {len(names) * _ROW + 8}">{"".join(parts)}</svg>'


def _thinned(t: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if len(t) <= _POINTS:
        return t, v
    size = math.ceil(len(t) / _POINTS)
    pad = -len(t) % size
    blocks = np.pad(v, (0, pad), constant_values=np.nan).reshape(-1, size)
    known = np.isfinite(blocks).sum(axis=1)
    mean = np.where(known > 0, np.nansum(blocks, axis=1) / np.maximum(known, 1), np.nan)
    return np.pad(t, (0, pad), mode="edge").reshape(-1, size).mean(axis=1), mean


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Path data that is broken where y is unknown."""
    known = np.isfinite(y)
    starts = known & ~np.concatenate([[False], known[:-1]])
    letters = np.where(starts, "M", "L")
    return "".join(f"{c}{a:.1f} {b:.1f}" for c, a, b in zip(letters[known], x[known], y[known], strict=True))


def _ticks(low: float, high: float) -> np.ndarray:
    """Three to six round values that enclose low and high."""
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = 0.0, 1.0
    span = max(high - low, 1e-6 * max(abs(high), 1.0), 1e-6)
    rough = span / 4.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return np.round(np.arange(first, max(last, first + 1) + 1) * step, 9)
