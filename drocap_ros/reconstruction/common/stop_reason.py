"""Reasons for which a solver stops."""

from __future__ import annotations

CONVERGED = "converged"
#: The configured number of steps is done.
ITERATIONS = "iterations"
#: No damping gives a lower cost.
NO_DESCENT = "no descent"
#: The caller cancelled the solve.
DEADLINE = "deadline"
#: The window has too few frames for an adjustment.
TOO_SHORT = "too short"
#: The method has no adjustment.
NO_ADJUSTMENT = "no adjustment"
#: The recording is shorter than the live method's first window.
NO_WINDOW = "no window was due"
