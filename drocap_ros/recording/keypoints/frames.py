"""Frames and persons of a file of keypoints: whose points are whose, in which frames, and how many a second."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError

#: A frame's name or number, or a person's; None = not stated.
Label = str | int | float | None
#: Seconds of a unit by the end of a time's name; without one the first that gives a video's rate.
_UNITS = {"_s": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9}
_RATES_HZ = (2.0, 1000.0)


def one_person(
    people: list[tuple[int, Label, np.ndarray]], subject: int | None = None
) -> tuple[dict[int, np.ndarray], str]:
    """Points by frame of the person with most frames by its number, or of the ``subject``th; words on others.

    Of several with one number, or without, the largest, then the nearest to it.
    """
    people = followed(people)
    counted = Counter(who for _, who, _ in people).most_common()
    several = len({frame for frame, _, _ in people}) < len(people) or len(counted) > 1
    if subject is not None and not 1 <= subject <= len(counted):
        raise InputError(f"--subject {subject}: expected a person of the file, 1 to {len(counted)}; choose another")
    most = counted[(subject or 1) - 1][0]
    named = ", ".join(f"{i} ({'person' if who is None else who}: {n} frames)" for i, (who, n) in enumerate(counted, 1))
    words = f"several persons, {named}: {subject or 1} is reconstructed, --subject N is another" if several else ""
    if several and len(counted) == 1:
        words = "several persons without numbers: the largest is reconstructed, and the nearest to it"
    by_frame: dict[int, list[np.ndarray]] = {}
    for frame, who, points in people:
        if who == most:
            by_frame.setdefault(frame, []).append(points)
    chosen: dict[int, np.ndarray] = {}
    last: np.ndarray | None = None
    for frame in sorted(by_frame):
        sizes = [-np.ptp(p[np.isfinite(p[:, 0]), :2], axis=0).sum() for p in by_frame[frame]]
        steps = sizes if last is None else [np.nanmedian(np.abs(p - last)[:, :2]) for p in by_frame[frame]]
        last = chosen[frame] = by_frame[frame][int(np.argmin(np.nan_to_num(steps, nan=np.inf)))]
    return chosen, words


def numbers_of(labels: list[Label]) -> dict[Label, int]:
    """Number of each frame: the last one in its name where that tells frames apart, else its place."""
    names = list(dict.fromkeys(labels))
    whole = [int(n) if isinstance(n, float) and n.is_integer() else n for n in names]
    found = [re.findall(r"\d+", Path(n).stem if isinstance(n, str) else str(n))[-1:] for n in whole]
    # Digits of a frame's number; longer ones are times or sums.
    numbers = [int(digits[0]) for digits in found if digits and len(digits[0]) < 10]
    return dict(zip(names, numbers if len(set(numbers)) == len(names) else range(len(names)), strict=True))


def seconds_of(times: Mapping[Label, tuple[str, float]], frames: np.ndarray) -> np.ndarray | None:
    """(F,) s since the first of the frames' numbers, by the times of frames, each with its key; None where they are
    those of no video.
    """
    numbers = numbers_of(list(times))
    rows = sorted((numbers[frame], time) for frame, (_, time) in times.items())
    if len(rows) < 2 or not rows[0][0] <= frames[0] <= frames[-1] <= rows[-1][0]:
        return None
    count, seconds = np.array(rows, np.float64).T
    key = next(iter(times.values()))[0]
    units = [factor for end, factor in _UNITS.items() if key.endswith(end)] or list(_UNITS.values())
    step = float(np.median(np.diff(seconds) / np.diff(count)))
    unit = next((u for u in units if step > 0 and _RATES_HZ[0] <= 1 / (step * u) <= _RATES_HZ[1]), None)
    at_s = None if unit is None else np.interp(frames, count, (seconds - seconds[0]) * unit)
    return None if at_s is None or (np.diff(at_s) <= 0).any() else at_s - at_s[0]


#: Shares of a person's size by which he moves from one frame to the next at most, and how many frames he may be lost.
_OWN_STEP, _OTHER_STEP, _LOST = 0.5, 0.25, 30


def followed(people: list[tuple[int, Label, np.ndarray]]) -> list[tuple[int, Label, np.ndarray]]:
    """The same persons, each with one number: trackers give a new one after a loss, and exchange those of two.

    A person keeps its number as long as it is near; else the nearest one goes on, then the one with its number.
    """
    if any(who is None for _, who, _ in people):
        return people
    last: dict[Label, tuple[int, Label, np.ndarray]] = {}  # by our number: frame, number in the file, points
    by_frame: dict[int, list[tuple[Label, np.ndarray]]] = {}
    for frame, who, points in people:
        by_frame.setdefault(frame, []).append((who, points))
    found: list[tuple[int, Label, np.ndarray]] = []
    for frame in sorted(by_frame):
        pairs, here = [], {who for who, _ in by_frame[frame]}
        known = {own: was for own, was in last.items() if frame - was[0] - 1 <= _LOST or was[1] in here}
        for i, (who, points) in enumerate(by_frame[frame]):
            for own, (before, theirs, old) in sorted(known.items(), key=lambda item: item[1][1] != who):
                step, missed = _step(old, points), frame - before - 1
                near = step <= (_OWN_STEP if who == theirs else _OTHER_STEP) * (1 + 0.1 * missed) and missed <= _LOST
                rank = 0 if who == theirs and near else 1 if near else 2
                pairs += [(rank, step, i, own)] * (near or who == theirs)
                if rank == 0:
                    break
        chosen: dict[int, Label] = {}
        for _, _, i, own in sorted(pairs, key=lambda pair: pair[:3]):
            if i not in chosen and own not in chosen.values():
                chosen[i] = own
        for i, (who, points) in enumerate(by_frame[frame]):
            own = chosen.get(i, who if who not in last else f"{who} from {frame}")
            last[own] = frame, who, points
            found.append((frame, own, points))
    return found


def _step(old: np.ndarray, new: np.ndarray) -> float:
    """Median way of the points that both frames show, as a share of the person's size; infinite without any."""
    both = np.isfinite(old[:, 0]) & np.isfinite(new[:, 0])
    size = float(np.ptp(old[np.isfinite(old[:, 0]), :2], axis=0).max(initial=0.0))
    return float(np.median(np.abs(new - old)[both, :2].max(axis=1))) / max(size, 1e-9) if both.any() else np.inf
