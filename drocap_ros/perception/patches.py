"""Places of known patches in an image: flow from image to image drifts, a patch of the first image does not.

Inverse compositional alignment (Baker and Matthews 2004) of all patches at once: a patch keeps the look of the image in
which it was taken, and six numbers say where it is now and how it is turned, stretched and sheared.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_REACH = 5  # px from a patch's centre to its edge
_STEPS = 2  # of the alignment: the flow ends within half a px, and a third changes nothing
_RIDGE = 0.05  # of the Hessian's mean that holds the shape where the patch does not show it
_FLAT = 1e-3  # least deviation of a patch's grey values

_AXIS = np.arange(-_REACH - 1, _REACH + 2, dtype=np.float32)
_WIDE = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1)  # (13, 13, 2) px, with a margin for the gradient
_GRID = _WIDE[1:-1, 1:-1].reshape(-1, 2)  # (121, 2) px


@dataclass
class Patches:
    """N patches.

    look : (N, 121) grey values, mean 0, deviation 1
    step : (N, 6, 121) change of place, px of the patch, and of shape, for a difference of the looks
    shape : (N, 2, 2) px of the image per px of the patch
    """

    look: np.ndarray
    step: np.ndarray
    shape: np.ndarray

    def __len__(self) -> int:
        return len(self.look)

    def __getitem__(self, kept: np.ndarray) -> Patches:
        """Those of a mask (N,)."""
        return Patches(self.look[kept], self.step[kept], self.shape[kept])

    def __add__(self, more: Patches) -> Patches:
        """These and more."""
        return Patches(*(np.concatenate([getattr(self, n), getattr(more, n)]) for n in ("look", "step", "shape")))

    def replace(self, which: np.ndarray, others: Patches) -> None:
        """Put others in the places (N,) bool of some."""
        self.look[which], self.step[which], self.shape[which] = others.look, others.step, others.shape

    def align(self, grey: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 2) px in an image (H, W) from places near them, and (N,) correlation of the looks there."""
        place, shape = points.astype(np.float32), self.shape
        for _ in range(_STEPS):
            look = _look(_sampled(grey, place, shape))
            alike = np.einsum("np,np->n", look, self.look) / len(_GRID)
            change = np.einsum("nkp,np->nk", self.step, look - self.look)
            shape = shape @ np.linalg.inv(np.eye(2, dtype=np.float32) + change[:, 2:].reshape(-1, 2, 2))
            place = place - np.einsum("nij,nj->ni", shape, change[:, :2])
        self.shape = shape
        return place, alike


def patches_at(grey: np.ndarray, points: np.ndarray) -> Patches:
    """The patches of an image (H, W) around points (N, 2) px."""
    count, side = len(points), len(_AXIS)
    eye = np.broadcast_to(np.eye(2, dtype=np.float32), (count, 2, 2)).copy()
    wide = _sampled(grey, points, eye, _WIDE.reshape(-1, 2)).reshape(count, side, side)
    inner = wide[:, 1:-1, 1:-1].reshape(count, len(_GRID))
    deviation = np.maximum(inner.std(axis=1), _FLAT)[:, None]
    x = ((wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2).reshape(count, len(_GRID)) / deviation
    y = ((wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2).reshape(count, len(_GRID)) / deviation
    gx, gy = _GRID.T
    slope = np.stack([x, y, x * gx, x * gy, y * gx, y * gy], axis=1)
    hessian = slope @ slope.transpose(0, 2, 1)
    ridge = _RIDGE * np.einsum("nkk->nk", hessian) * np.array([0, 0, 1, 1, 1, 1], np.float32)
    hessian = hessian + (ridge + _FLAT)[:, :, None] * np.eye(6, dtype=np.float32)
    return Patches(_look(inner), np.linalg.solve(hessian, slope).astype(np.float32), eye)


def _sampled(grey: np.ndarray, place: np.ndarray, shape: np.ndarray, grid: np.ndarray = _GRID) -> np.ndarray:
    """(N, P) grey values at a grid (P, 2) of each patch."""
    if not len(place):
        return np.empty((0, len(grid)), np.float32)
    at = place[:, None].astype(np.float32) + grid @ shape.transpose(0, 2, 1)
    values = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.astype(np.float32)


def _look(values: np.ndarray) -> np.ndarray:
    """Grey values (N, P) with mean 0 and deviation 1: exposure does not matter."""
    centred = values - values.mean(axis=1, keepdims=True)
    deviation = np.sqrt(np.einsum("np,np->n", centred, centred) / values.shape[1])
    return np.asarray(centred / np.maximum(deviation, _FLAT)[:, None])
