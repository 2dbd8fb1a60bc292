"""States of a vehicle over time, and their interpolation at other times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import slerp

_NS = 1e-9
#: Longest time between two states over which values are interpolated.
MAX_GAP_S = 2.0
#: Time beyond the first and last state for which these still hold; at 25 deg/s it is 2.5 deg.
HOLD_S = 0.1


class VehicleTrack(NamedTuple):
    """States of a vehicle at N times.

    stamp_ns : (N,) int64, strictly increasing
    position : (N, 3) m ENU, NaN unknown
    orientation : (N, 4) x y z w body FLU -> ENU, NaN unknown
    gimbal : (N, 4) x y z w camera FLU -> ENU, NaN without a mount
    """

    stamp_ns: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    gimbal: np.ndarray


def interpolate(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool, max_gap_s: float = MAX_GAP_S
) -> tuple[np.ndarray, np.ndarray]:
    """Values (F, C) at the stamps (F,), NaN where unknown, and the time (F,) s to or between the states used.

    A stamp between two states more than ``max_gap_s`` apart, or more than ``HOLD_S`` outside all states, has no value.
    Known values (N, C) with NaN are ignored; ``spherical`` interpolates quaternions.
    """
    good = np.isfinite(values).all(axis=1)
    if not good.any():
        return np.full((len(stamp_ns), values.shape[1]), np.nan), np.full(len(stamp_ns), np.inf)
    known_ns, values = known_ns[good], values[good]
    after = np.clip(np.searchsorted(known_ns, stamp_ns), 1, max(len(known_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(known_ns) - 1)
    inside = np.clip(stamp_ns, known_ns[0], known_ns[-1])
    span = known_ns[after] - known_ns[before]
    between = (inside == stamp_ns) & (stamp_ns != known_ns[before]) & (stamp_ns != known_ns[after])
    gap_s = np.where(between, span, 0) * _NS
    outside_s = np.abs(inside - stamp_ns) * _NS
    part = np.where(span > 0, (inside - known_ns[before]) / np.maximum(span, 1), 0.0)
    if spherical:
        found = slerp(values[before], values[after], part)
    else:
        found = values[before] + part[:, None] * (values[after] - values[before])
    unknown = (gap_s > max_gap_s) | (outside_s > HOLD_S)
    return np.where(unknown[:, None], np.nan, found), np.maximum(gap_s, outside_s)
