"""Angles between rotations."""

from __future__ import annotations

import numpy as np


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (...) in rad of the rotation from ``a`` to ``b``, both (..., 3, 3)."""
    # Chordal distance |a - b|_F = 2 sqrt(2) sin(angle / 2) is precise near zero; the trace is not.
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / (2.0 * np.sqrt(2.0))
    return 2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))
