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

    The unknowns are the logarithm of the scale, the misalignment (3) rad, the latencies of attitude and position s; of
    points the latter five first, then the logarithm of the focal length.
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

    def of_scale(self) -> Findings:
        """What they tell of the scale alone, where the camera's reports have other errors than until now."""
        rest = self.precision[1:, 0] @ np.linalg.pinv(self.precision[1:, 1:])
        alone = Findings.unknown()
        alone.precision[0, 0] = self.precision[0, 0] - rest @ self.precision[1:, 0]
        alone.vector[0] = self.vector[0] - rest @ self.vector[1:]
        return alone

    def after(self, found: Findings, its_ns: np.ndarray, stamp_ns: np.ndarray) -> Findings:
        """Findings before a window of ``stamp_ns``, with those of the window of ``its_ns`` that it has not itself."""
        begin, end = int(its_ns[0]), int(its_ns[-1])
        share = float(np.clip((int(stamp_ns[0]) - begin) / max(end - begin, 1), 0.0, 1.0))
        return self.later(found, share, max(int(stamp_ns[-1]) - end, 0) * 1e-9)
