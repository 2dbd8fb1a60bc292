"""The reprojection term: scaled orthographic projection, per-joint information, translation eliminated."""

from __future__ import annotations

import numpy as np


def information_from(
    w: np.ndarray, weights: np.ndarray | None, covariance: np.ndarray | None, *, largest: float = 4.0
) -> np.ndarray:
    """(F, P, 3) information xx, xy, yy per joint; 1, 0, 1 is an ordinary joint, 0 a missing one.

    Parameters
    ----------
    w : (F, P, 2), NaN where not seen
    weights : (F, P) >= 0, or None
    covariance : (F, P, 3) xx, xy, yy in units of w squared; the median variance counts as ordinary
    largest : bound on the gain of a joint that claims to be exact
    """
    seen = np.isfinite(w).all(-1)
    base = seen.astype(np.float64) if weights is None else np.where(seen, weights, 0.0)
    if covariance is None:
        return np.stack([base, np.zeros_like(base), base], axis=-1)
    use = base > 0.0
    xx, xy, yy = (np.where(use, covariance[..., i], 1.0 - (i == 1)) for i in range(3))
    ordinary = float(np.median(0.5 * (xx + yy)[use])) if use.any() else 1.0
    # Adding a floor to both axes bounds the information and keeps it positive definite.
    floor = ordinary / largest
    xx, yy = xx + floor, yy + floor
    scale = base * (ordinary + floor) / (xx * yy - xy * xy)
    return np.stack([scale * yy, -scale * xy, scale * xx], axis=-1)


def apply_information(information: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Information (..., 3) times residuals (..., 2)."""
    x, y = r[..., 0], r[..., 1]
    return np.stack(
        [information[..., 0] * x + information[..., 1] * y, information[..., 1] * x + information[..., 2] * y], -1
    )


class Projection:
    """``W - R S - T`` with the translation T of each frame at its optimum.

    w : (F, P, 2), anything where the information is 0
    information : (F, P, 3)
    """

    def __init__(self, w: np.ndarray, information: np.ndarray) -> None:
        self.w = np.where(np.isfinite(w), w, 0.0)
        self.information = information
        xx, xy, yy = np.moveaxis(information.sum(1), -1, 0)
        det = xx * yy - xy * xy
        safe = np.where(det > 1e-12, det, 1.0)
        inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / safe[:, None, None]
        self._inverse = np.where((det > 1e-12)[:, None, None], inverse, 0.0)
        self.isotropic = bool(np.all(information[..., 1] == 0.0) and np.all(information[..., 0] == information[..., 2]))
        self._weights = np.ascontiguousarray(information[..., 0])
        self._share = self._weights / np.maximum(self._weights.sum(1, keepdims=True), 1e-12)

    def translation(self, projected: np.ndarray) -> np.ndarray:
        """Best translation (F, 2) for projected joints (F, P, 2)."""
        gap = self.w - projected
        if self.isotropic:
            return (self._share[:, None] @ gap)[:, 0]
        return (self._inverse @ apply_information(self.information, gap).sum(1)[..., None])[..., 0]

    def residual(self, s: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals ``R S + T - W`` (F, P, 2) and their product with the information, for R (F, 2 or 3, 3)."""
        projected = s @ np.swapaxes(r[:, :2], 1, 2)
        gap = projected + self.translation(projected)[:, None] - self.w
        weighted = gap * self._weights[..., None] if self.isotropic else apply_information(self.information, gap)
        return gap, weighted

    def value_and_gradient(self, s: np.ndarray, r: np.ndarray) -> tuple[float, np.ndarray]:
        """Reprojection cost and its gradient (F, P, 3) by S."""
        gap, weighted = self.residual(s, r)
        return float(np.sum(gap * weighted)), 2.0 * weighted @ r[:, :2]

    def per_frame(self, s: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Reprojection cost (F,) of each frame."""
        gap, weighted = self.residual(s, r)
        return np.sum(gap * weighted, axis=(1, 2))
