"""The E-step over uncertain 2D joints (Zhou et al. 2016, section 4): Gaussians, mixtures and heatmaps.

Given where the model projects a joint, each kind of evidence says what the M-step should believe: an expected
position and the information (inverse covariance) that it deserves.  All are in the solvers' normalized units and in
units of ``keypoint_std``: information 1, 0, 1 is an ordinary joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drocap_ros.errors import InputError

#: Area that a gross outlier may fall in, squared 2D std: about that of the person's box.
OUTLIER_AREA = 12.0


class UncertainJoints(Protocol):
    """Evidence on the joints of F images."""

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """First guess without a model: positions (F, P, 2), 0 where unknown, and information (F, P, 3)."""

    def expect(self, projected: np.ndarray, std: float) -> tuple[np.ndarray, np.ndarray]:
        """E-step.

        Parameters
        ----------
        projected : (F, P, 2) the model's joints in the image
        std : standard deviation of an ordinary joint about the model

        Returns
        -------
        positions (F, P, 2) and information (F, P, 3)
        """


@dataclass(frozen=True)
class GaussianJoints:
    """One Gaussian per joint and a share of gross outliers.

    w : (F, P, 2), 0 where not seen
    information : (F, P, 3), 0 where not seen
    outlier_share : prior probability that a joint is not where it was found
    """

    w: np.ndarray
    information: np.ndarray
    outlier_share: float = 0.05

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Every joint at its face value."""
        return self.w, self.information

    def expect(self, projected: np.ndarray, std: float) -> tuple[np.ndarray, np.ndarray]:
        """Information falls with the probability that the joint is an outlier."""
        fit = _log_density(projected - self.w, self.information / std**2)
        inlier = _share(fit + np.log1p(-self.outlier_share), np.log(self.outlier_share / OUTLIER_AREA))
        return self.w, self.information * inlier[..., None]


@dataclass(frozen=True)
class MixtureJoints:
    """Several candidate peaks per joint.

    means : (F, P, M, 2); NaN for candidates that do not exist
    covariances : (F, P, M, 3) xx, xy, yy, squared 2D std
    shares : (F, P, M) >= 0; what they lack to 1 is the share of gross outliers, at least ``outlier_share``
    """

    means: np.ndarray
    covariances: np.ndarray
    shares: np.ndarray
    outlier_share: float = 0.05

    def __post_init__(self) -> None:
        shape = self.means.shape
        if (
            len(shape) != 4
            or shape[3] != 2
            or self.covariances.shape != (*shape[:3], 3)
            or self.shares.shape != shape[:3]
        ):
            raise InputError(
                f"candidates: expected means (F, P, M, 2), covariances (F, P, M, 3) and shares (F, P, M), got"
                f" {shape}, {self.covariances.shape} and {self.shares.shape}; make the axes agree"
            )
        xx, xy, yy = np.moveaxis(self.covariances, -1, 0)
        with np.errstate(invalid="ignore"):
            good = np.isfinite(self.covariances).all(-1) & (xx > 0) & (yy > 0) & (xx * yy - xy * xy > 0)
        if (self._exists & ~good).any():
            raise InputError("covariances: expected positive definite ones where a candidate exists; drop the others")

    @property
    def _exists(self) -> np.ndarray:
        return np.isfinite(self.means).all(-1) & (np.nan_to_num(self.shares) > 0.0)

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """The candidate of the largest share."""
        shares = np.where(self._exists, self.shares, -1.0)
        best = np.argmax(shares, axis=2)[..., None]
        known = np.take_along_axis(shares, best, axis=2)[..., 0] > 0.0
        w = np.take_along_axis(self.means, best[..., None], axis=2)[:, :, 0]
        information = np.take_along_axis(self._information(1.0), best[..., None], axis=2)[:, :, 0]
        return np.where(known[..., None], w, 0.0), np.where(known[..., None], information, 0.0)

    def expect(self, projected: np.ndarray, std: float) -> tuple[np.ndarray, np.ndarray]:
        """Information-weighted mean of the candidates, each as probable as it is near the model."""
        exists = self._exists
        information = self._information(std)
        means = np.where(exists[..., None], self.means, 0.0)
        total = np.maximum(np.sum(np.where(exists, self.shares, 0.0), axis=2, keepdims=True), 1e-12)
        prior = np.where(exists, self.shares, 0.0) / np.maximum(total, 1.0) * (1.0 - self.outlier_share)
        fit = _log_density(projected[:, :, None] - means, information / std**2)
        weight = np.where(exists, prior * np.exp(np.minimum(fit, 50.0)), 0.0)
        weight = weight / (weight.sum(2, keepdims=True) + self.outlier_share / OUTLIER_AREA)
        summed = np.sum(weight[..., None] * information, axis=2)
        moment = np.sum(weight[..., None] * _times(information, means), axis=2)
        return _solve(summed, moment), summed

    def _information(self, std: float) -> np.ndarray:
        """(F, P, M, 3) relative to an ordinary joint, whose own scatter about the model every candidate shares."""
        xx, xy, yy = np.moveaxis(np.where(self._exists[..., None], self.covariances, [1.0, 0.0, 1.0]), -1, 0)
        xx, yy = xx / std**2 + 1.0, yy / std**2 + 1.0
        xy = xy / std**2
        return np.stack([yy, -xy, xx], axis=-1) / (xx * yy - xy * xy)[..., None]


@dataclass(frozen=True)
class HeatmapJoints:
    """A heatmap per joint, as the paper's detector gives it.

    heatmaps : (F, P, H, W) >= 0
    corner : (F, 2) normalized position of the centre of cell 0, 0
    cell : normalized size of a cell
    """

    heatmaps: np.ndarray
    corner: np.ndarray
    cell: float

    def __post_init__(self) -> None:
        if self.heatmaps.ndim != 4 or self.corner.shape != (len(self.heatmaps), 2) or not self.cell > 0.0:
            raise InputError(
                f"heatmaps: expected (F, P, H, W), corners (F, 2) and a positive cell, got {self.heatmaps.shape},"
                f" {self.corner.shape} and {self.cell:g}; make the axes agree"
            )
        if not np.isfinite(self.heatmaps).all() or self.heatmaps.min() < 0.0:
            raise InputError("heatmaps: expected finite values >= 0, got others; clip them")

    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        height, width = self.heatmaps.shape[2:]
        return self.corner[:, :1] + self.cell * np.arange(width), self.corner[:, 1:] + self.cell * np.arange(height)

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """The highest cell; heatmaps of zeros show nothing."""
        frames, p, _, width = self.heatmaps.shape
        best = np.argmax(self.heatmaps.reshape(frames, p, -1), axis=2)
        x, y = self._axes()
        w = np.stack([np.take_along_axis(x, best % width, 1), np.take_along_axis(y, best // width, 1)], axis=-1)
        known = self.heatmaps.max(axis=(2, 3)) > 0.0
        return np.where(known[..., None], w, 0.0), known[..., None] * np.array([1.0, 0.0, 1.0])

    def expect(self, projected: np.ndarray, std: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the heatmap times a Gaussian about the model; the heat that is left is the joint's credit."""
        x, y = self._axes()
        near_x = np.exp(-0.5 * ((x[:, None] - projected[..., :1]) / std) ** 2)
        near_y = np.exp(-0.5 * ((y[:, None] - projected[..., 1:]) / std) ** 2)
        # Separable: no (F, P, H, W) product is ever stored.
        rows = np.einsum("fphw,fpw->fph", self.heatmaps, near_x)
        rows_x = np.einsum("fphw,fpw,fw->fph", self.heatmaps, near_x, x)
        mass = np.einsum("fph,fph->fp", rows, near_y)
        total = self.heatmaps.sum(axis=(2, 3))
        some = mass > 1e-12 * np.maximum(total, 1e-300)
        safe = np.where(some, mass, 1.0)
        w = np.stack([np.einsum("fph,fph->fp", rows_x, near_y), np.einsum("fph,fph,fh->fp", rows, near_y, y)], -1)
        credit = np.where(some, mass / np.where(total > 0.0, total, 1.0), 0.0)
        # Half of the heat within reach is full credit: a clean peak has it, a wrong one far away has nothing.
        credit = np.minimum(2.0 * credit, 1.0)
        return np.where(some[..., None], w / safe[..., None], 0.0), credit[..., None] * np.array([1.0, 0.0, 1.0])


def _log_density(gap: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Log of the Gaussian density of gaps (..., 2) under information (..., 3)."""
    xx, xy, yy = np.moveaxis(information, -1, 0)
    det = np.maximum(xx * yy - xy * xy, 1e-300)
    x, y = gap[..., 0], gap[..., 1]
    return 0.5 * np.log(det) - np.log(2.0 * np.pi) - 0.5 * (xx * x * x + 2.0 * xy * x * y + yy * y * y)


def _share(log_a: np.ndarray, log_b: float) -> np.ndarray:
    """``a / (a + b)`` from logarithms."""
    return 1.0 / (1.0 + np.exp(np.clip(log_b - log_a, -700.0, 700.0)))


def _times(information: np.ndarray, v: np.ndarray) -> np.ndarray:
    xx, xy, yy = np.moveaxis(information, -1, 0)
    return np.stack([xx * v[..., 0] + xy * v[..., 1], xy * v[..., 0] + yy * v[..., 1]], axis=-1)


def _solve(information: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``information^-1 v``, 0 where there is no information."""
    xx, xy, yy = np.moveaxis(information, -1, 0)
    det = xx * yy - xy * xy
    good = det > 1e-18
    inverse = np.where(good, 1.0 / np.where(good, det, 1.0), 0.0)
    return inverse[..., None] * np.stack([yy * v[..., 0] - xy * v[..., 1], xx * v[..., 1] - xy * v[..., 0]], axis=-1)
