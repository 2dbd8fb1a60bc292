"""The reprojection term: scaled orthographic projection, per-joint information, translation eliminated.

Within the solvers frames come last: shapes (3, P, F), image points (2, P, F), rotations (3, 3, F).
"""

from __future__ import annotations

import numpy as np


def information_from(w: np.ndarray, weights: np.ndarray | None, covariance: np.ndarray | None) -> np.ndarray:
    """(F, P, 3) information xx, xy, yy per joint; 1, 0, 1 is an ordinary joint, 0 a missing one.

    w : (F, P, 2), NaN where not seen
    weights : (F, P) >= 0, or None
    covariance : (F, P, 3) xx, xy, yy in units of w squared; the median variance counts as ordinary
    """
    seen = np.isfinite(w).all(-1)
    base = seen.astype(np.float64) if weights is None else np.where(seen, weights, 0.0)
    if covariance is None:
        return np.stack([base, np.zeros_like(base), base], axis=-1)
    use = base > 0.0
    xx, xy, yy = (np.where(use, covariance[..., i], 1.0 - (i == 1)) for i in range(3))
    ordinary = float(np.median(0.5 * (xx + yy)[use])) if use.any() else 1.0
    # Adding a floor to both axes bounds the information and keeps it positive definite.
    # Bound on the gain of a joint of vanishing variance.
    floor = ordinary / 4.0
    xx, yy = xx + floor, yy + floor
    scale = base * (ordinary + floor) / (xx * yy - xy * xy)
    return np.stack([scale * yy, -scale * xy, scale * xx], axis=-1)


def noise_std(w: np.ndarray, information: np.ndarray) -> float:
    """Standard deviation of white noise on the joints (F, P, 2), from their third differences in time.

    A body's motion is smooth over four images, noise is not: clean MoCap at 24 fps gives 0.2 % of the unit.  Medians
    over time and the lower quartile of the joints exclude gross outliers and fast hands.
    """
    if len(w) < 8:
        return 0.0
    seen = information[..., 0] > 0.0
    whole = seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3]
    use = whole.sum(0) >= 4
    if not use.any():
        return 0.0
    third = np.abs(w[3:] - 3.0 * w[2:-1] + 3.0 * w[1:-2] - w[:-3])[:, use]
    median = np.nanmedian(np.where(whole[:, use, None], third, np.nan), axis=(0, 2))
    # 1.4826: median to standard deviation; 20 = 1 + 9 + 9 + 1.
    return float(np.percentile(median, 25) * 1.4826 / np.sqrt(20.0))


def frames_last(a: np.ndarray) -> np.ndarray:
    """(F, A, B) to contiguous (B, A, F): poses to the solvers' layout.  Transpose rotations first."""
    return np.ascontiguousarray(np.swapaxes(a, 0, 2))


def frames_first(a: np.ndarray) -> np.ndarray:
    """(B, A, F) to contiguous (F, A, B), the inverse of :func:`frames_last`."""
    return np.ascontiguousarray(np.swapaxes(a, 0, 2))


def rotate(r: np.ndarray, s: np.ndarray, rows: int = 3) -> np.ndarray:
    """The first rows of R S: (rows, P, F) for rotations (3, 3, F) and shapes (3, P, F)."""
    return np.stack([r[i, 0] * s[0] + r[i, 1] * s[1] + r[i, 2] * s[2] for i in range(rows)])


def rotate_back(r: np.ndarray, x: np.ndarray) -> np.ndarray:
    """R^T X: (3, P, F) for rotations (3, 3, F) and the first rows X (2 or 3, P, F)."""
    return np.stack([sum(r[i, j] * x[i] for i in range(len(x))) for j in range(3)])


class Projection:
    """``R S + T - W`` with the translation T of each frame at its optimum.

    w : (F, P, 2), any value where the information is 0
    information : (F, P, 3)
    """

    def __init__(self, w: np.ndarray, information: np.ndarray) -> None:
        self.w = frames_last(np.where(np.isfinite(w), w, 0.0))
        self.information = frames_last(information)
        xx, xy, yy = self.information.sum(1)
        det = xx * yy - xy * xy
        good = det > 1e-12
        self._inverse = np.stack([yy, -xy, xx]) * np.where(good, 1.0 / np.where(good, det, 1.0), 0.0)
        self.isotropic = bool(np.all(self.information[1] == 0.0) and np.all(self.information[0] == self.information[2]))
        self.weights: np.ndarray = self.information[0]
        self.share = self.weights / np.maximum(self.weights.sum(0), 1e-12)

    def inform(self, gap: np.ndarray) -> np.ndarray:
        """Information times residuals (2, P, F)."""
        if self.isotropic:
            informed: np.ndarray = self.weights * gap
            return informed
        xx, xy, yy = self.information
        return np.stack([xx * gap[0] + xy * gap[1], xy * gap[0] + yy * gap[1]])

    def translation(self, projected: np.ndarray) -> np.ndarray:
        """Best translation (2, F) for projected joints (2, P, F)."""
        gap = self.w - projected
        if self.isotropic:
            mean: np.ndarray = np.einsum("pf,ipf->if", self.share, gap)
            return mean
        x, y = self.inform(gap).sum(1)
        return np.stack([self._inverse[0] * x + self._inverse[1] * y, self._inverse[1] * x + self._inverse[2] * y])

    def placed(self, poses: np.ndarray) -> np.ndarray:
        """Poses (F, P, 3) translated in the image to fit the joints best."""
        moved = poses.copy()
        moved[..., :2] += self.translation(frames_last(poses[..., :2])).T[:, None]
        return moved

    def residual(self, s: np.ndarray, r: np.ndarray) -> np.ndarray:
        """``R S + T - W`` (2, P, F)."""
        projected = rotate(r, s, 2)
        translation = self.translation(projected)
        projected -= self.w
        projected += translation[:, None]
        return projected

    def value(self, s: np.ndarray, r: np.ndarray) -> float:
        """Reprojection cost."""
        gap = self.residual(s, r)
        return float(np.vdot(gap, self.inform(gap)))

    def value_and_gradient(self, s: np.ndarray, r: np.ndarray) -> tuple[float, np.ndarray]:
        """Reprojection cost and its gradient (3, P, F) by S."""
        gap = self.residual(s, r)
        weighted = self.inform(gap)
        return float(np.vdot(gap, weighted)), rotate_back(2.0 * r, weighted)

    def per_frame(self, s: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Reprojection cost (F,) of each frame."""
        gap = self.residual(s, r)
        cost: np.ndarray = np.einsum("ipf,ipf->f", gap, self.inform(gap))
        return cost
