"""Covariance of poses about their pelvis, in the axes of a camera: errors of joints, and of the whole body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Spread(NamedTuple):
    """Standard deviations of a method's poses.

    across, along : of a joint over its expected absolute error, across and along the ray
    size : of the body's size in the image, share: limbs that the method puts too deep are taken for longer ones
    lean : rad, of the whole body about either axis of the image: a single view does not show it
    """

    across: float = 1.0
    along: float = 1.0
    size: float = 0.0
    lean: float = 0.0

    def covariance(self, joints: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """(F, P, 3, 3) of joints (F, P, 3) in a camera's axes with expected errors (F, P, 2) in the same unit."""
        about = joints - joints[:, :1]
        x, y, z = np.moveaxis(about, -1, 0)
        by_lean = self.lean * np.stack([[0 * x, -z, y], [z, 0 * x, -x]])
        ways = np.concatenate([self.size * about[None], np.moveaxis(by_lean, 1, -1)])
        full: np.ndarray = np.einsum("nfpi,nfpj->fpij", ways, ways)
        axes = np.arange(3)
        full[..., axes, axes] += np.square(sigma * (self.across, self.along))[..., [0, 0, 1]]
        return np.asarray(full)


def packed(full: np.ndarray) -> np.ndarray:
    """xx, xy, xz, yy, yz, zz (..., 6) of symmetric matrices (..., 3, 3)."""
    return np.asarray(full[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
