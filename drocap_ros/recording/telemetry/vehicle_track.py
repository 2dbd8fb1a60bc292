"""States of a vehicle over time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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
