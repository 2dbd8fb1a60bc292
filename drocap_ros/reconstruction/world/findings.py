"""What adjustments found out about scale, misalignment and latencies: the prior of a later window.

In information form (precision matrix, and its product with the mean) independent findings add up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Relative standard deviation of the scale below which it counts as measured: half of that among people.
MEASURED = 0.03
#: Time (s) after which findings count a third: telemetry drifts, and errors of the poses do not average out.
_MEMORY_S = 60.0


class Findings(NamedTuple):
    """Of the measurements alone: precision (6, 6) and vector (6,); zeros = nothing is known.

    The unknowns are the logarithm of the scale, the misalignment (3) rad, the latencies of attitude and position s.
    """

    precision: np.ndarray
    vector: np.ndarray

    @staticmethod
    def unknown() -> Findings:
        """Nothing is known."""
        return Findings(np.zeros((6, 6)), np.zeros(6))

    def later(self, found: Findings, share: float, passed_s: float) -> Findings:
        """Findings ``passed_s`` later, with a share of those of a window: its frames that the next one has not."""
        decay = float(np.exp(-passed_s / _MEMORY_S))
        return Findings(
            decay * (self.precision + share * found.precision), decay * (self.vector + share * found.vector)
        )
