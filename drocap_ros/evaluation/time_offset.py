"""The offset of two recordings of one motion, by how the distances between its joints change: no camera, no world."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.together.timing import ShownMotion, time_offsets


def find_offset(
    estimate: np.ndarray, estimate_s: np.ndarray, truth: np.ndarray, truth_s: np.ndarray
) -> tuple[float, float] | None:
    """Seconds to add to the estimate's times, and the likeness there; None where no offset is clearly the best.

    estimate, truth : (F, P, 3) and (T, P, 3), BODY_15 first, NaN unknown; times (F,) and (T,) s increase
    """
    shown = []
    for joints, time_s in ((truth, truth_s), (estimate, estimate_s)):
        known = np.isfinite(joints[:, :15]).all(axis=(1, 2))
        if known.sum() < 2:
            return None
        shown.append(ShownMotion(joints[known], time_s[known], np.ones(known.sum(), bool)))
    found = time_offsets(shown[0], shown[1], level=False)
    # Clear is an offset with half the likeness of equal motions whose second best has at most 0.9 of its own.
    if not found or found[0].likeness < 0.5 or (len(found) > 1 and found[1].likeness > 0.9 * found[0].likeness):
        return None
    return round(found[0].seconds, 2), found[0].likeness  # as it is said
