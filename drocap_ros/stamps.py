"""Stamps of images in ns: checks of those of a file, and of a stream in the nodes and when it is repeated offline."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError

NS = 10**9  # nanoseconds of a second
_LEAST_STEP_NS = 400_000  # 2,500 images per second, and in microseconds 2.5
#: Longest time from the first to the last frame, ns: a year. More is no recording, and overflows.
_LONGEST_NS = 365 * 86_400 * NS
#: Successive stamps of another time after which the stream has moved there: a replay began, a clock was set.
CONFIRMED_AFTER = 5


class StampValidator:
    """Refuses stamps that lie an hour or more from the previous ones, such as one image of 1970.

    Smaller steps, forward or back, are for the algorithms to judge.  No clock is read: simulated time and replays
    are as good as today.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._other_ns: int | None = None
        self._others = 0

    def check(self, sec: int, nanosec: int) -> None:
        """Take the next stamp."""
        if sec < 0 or nanosec >= NS:
            raise InputError(f"stamp: expected a time after 1970, got {sec} s {nanosec} ns; set the sender's clock")
        stamp_ns = sec * NS + nanosec
        if self._last_ns is not None and _far(stamp_ns, self._last_ns):
            agrees = self._other_ns is not None and not _far(stamp_ns, self._other_ns)
            self._others = self._others + 1 if agrees else 1
            self._other_ns = stamp_ns
            if self._others < CONFIRMED_AFTER:
                away_s = (stamp_ns - self._last_ns) * 1e-9
                raise InputError(
                    f"stamp: expected a time near the last one, got one {away_s:+.0f} s away; check the sender's clock"
                )
        self._last_ns, self._other_ns, self._others = stamp_ns, None, 0


def _far(a_ns: int, b_ns: int) -> bool:
    # A stamp this far from the previous one belongs to another time.
    return abs(a_ns - b_ns) > 3600.0 * 1e9


def check_stamps(stamp_ns: np.ndarray) -> None:
    """Refuse stamps (F,) that do not increase, last longer than a year, or are of no camera: of another unit."""
    first, last = int(stamp_ns[0]), int(stamp_ns[-1])
    if last - first > _LONGEST_NS:
        raise InputError(f"stamp_ns: expected nanoseconds within a year, got {first} to {last}; is the unit right?")
    if np.any(stamp_ns[1:] <= stamp_ns[:-1]):
        raise InputError("stamp_ns: expected strictly increasing times, got a repeated or earlier one; sort the frames")
    if len(stamp_ns) > 1 and (step := float(np.median(np.diff(stamp_ns)))) < _LEAST_STEP_NS:
        raise InputError(f"stamp_ns: expected nanoseconds, got steps of {step:g}, {1e9 / step:.3g} images per second;"
                         " multiply microseconds by 1000, milliseconds by 1000000")  # fmt: skip


def as_stamps(array: np.ndarray) -> np.ndarray:
    """int64 stamps of a file's array."""
    if array.dtype.kind not in "iu":
        raise InputError(f"stamp_ns: expected int64 nanoseconds, got {array.dtype}")
    if array.size and array.max() > np.iinfo(np.int64).max:
        raise InputError(f"stamp_ns: expected int64 nanoseconds, got {array.max()}; is the unit right?")
    return array.astype(np.int64)
