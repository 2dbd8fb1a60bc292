"""The simulation's two networks as PyTorch modules, with their losses (extra ``train``)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.skeleton import BODY_15
from lab.training.rendered_samples import DETECTOR_SIZE, POSE_SIZE
from lab.training.torch_extra import mixed_precision, pytorch

if TYPE_CHECKING:
    import torch

STRIDES = (8, 16, 32)
#: Range of the longer box side (px of the input) assigned to each stride; the ranges overlap.
_SIZES = ((0.0, 56.0), (40.0, 112.0), (88.0, math.inf))
_JOINTS = len(BODY_15)
#: Width of the target 1-D Gaussians of the pose network, px, as the SimCC decoder expects it.
_SIGMA = tuple(math.sqrt(side / 8) for side in POSE_SIZE)


def _conv(into: int, out: int, stride: int = 1) -> Any:
    nn = pytorch().nn
    return nn.Sequential(
        nn.Conv2d(into, out, 3, stride, 1, bias=False), nn.BatchNorm2d(out), nn.ReLU(inplace=True)
    )  # fmt: skip


def _residual(channels: int) -> Any:
    torch = pytorch()
    nn = torch.nn
    module: Any = nn.Module

    class Residual(module):
        def __init__(self) -> None:
            super().__init__()
            self.first = _conv(channels, channels)
            self.second = nn.Sequential(
                nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels)
            )  # fmt: skip

        def forward(self, x: Any) -> Any:
            return torch.relu(x + self.second(self.first(x)))

    return Residual()


def build_detector() -> torch.nn.Module:
    """Images (B, 3, 192, 320) BGR 0-255 -> YOLOX's grid (B, 1260, 6): cx cy w h, objectness, class (always 1).

    Centres in cells from the cell's corner, sizes as logarithms in cells, objectness in [0, 1].
    """
    torch = pytorch()
    nn = torch.nn
    module: Any = nn.Module
    up = torch.nn.functional.interpolate

    class PersonDetector(module):
        def __init__(self) -> None:
            super().__init__()
            self.stem = nn.Sequential(_conv(3, 16, stride=2), _conv(16, 32, stride=2))
            self.fine = nn.Sequential(_conv(32, 48, stride=2), _residual(48))
            self.middle = nn.Sequential(_conv(48, 80, stride=2), _residual(80))
            self.coarse = nn.Sequential(_conv(80, 96, stride=2), _residual(96))
            self.side = nn.ModuleList([nn.Conv2d(c, 48, 1) for c in (48, 80, 96)])
            self.merge = nn.ModuleList([_conv(48, 48) for _ in STRIDES])
            self.head = nn.Conv2d(48, 5, 1)
            nn.init.constant_(self.head.bias, 0.0)
            with torch.no_grad():
                self.head.bias[2:4] = 1.2
                self.head.bias[4] = -4.5

        def raw(self, x: Any) -> Any:
            """(B, 1260, 5) with objectness as a logit."""
            fine = self.fine(self.stem((x - 118.0) / 60.0))
            middle = self.middle(fine)
            coarse = self.side[2](self.coarse(middle))
            middle = self.side[1](middle) + up(coarse, scale_factor=2.0)
            fine = self.side[0](fine) + up(middle, scale_factor=2.0)
            levels = [self.head(merge(v)) for merge, v in zip(self.merge, (fine, middle, coarse), strict=True)]
            return torch.cat([v.flatten(2) for v in levels], dim=2).transpose(1, 2)

        def forward(self, x: Any) -> Any:
            raw = self.raw(x)
            score = torch.sigmoid(raw[..., 4:5])
            return torch.cat([raw[..., :4], score, torch.ones_like(score)], dim=2)

    return PersonDetector()


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Corners (1260, 2) px of the detector's cells and their strides (1260,)."""
    from drocap_ros.perception.models.spec import grid_centres

    return grid_centres(DETECTOR_SIZE, STRIDES)


def detector_targets(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells that must detect a box (B, 1260) bool, and cells without a target (B, 1260) bool.

    boxes (B, 4) px, NaN without a person
    """
    corner, stride = grid()
    middle = corner + 0.5 * stride[:, None]
    there = np.isfinite(boxes).all(axis=1)
    box = np.nan_to_num(boxes)
    size = (box[:, 2:] - box[:, :2]).max(axis=1)[:, None]
    least, most = np.array([_SIZES[STRIDES.index(int(s))] for s in stride]).T
    of_size = (size >= least) & (size < most) & there[:, None]
    centre = 0.5 * (box[:, :2] + box[:, 2:])
    off = np.abs(middle - centre[:, None]) / stride[:, None]
    inside = ((middle > box[:, None, :2]) & (middle < box[:, None, 2:])).all(axis=2)
    central = (off < 1.25).all(axis=2) & (inside | (off < 0.51).all(axis=2))
    positive = of_size & central
    # Cells of another stride predict no box of this size: their score would be a second person.
    free = of_size & inside & ~positive & (off < 2.5).all(axis=2)
    return positive, free


def detector_loss(network: Any, images: torch.Tensor, boxes: np.ndarray) -> tuple[torch.Tensor, float]:
    """Loss of a batch and, for the log, the mean overlap (IoU) of the positive cells."""
    torch = pytorch()
    with mixed_precision():
        raw = network.raw(images)
    raw = raw.float()
    positive, free = (torch.from_numpy(v) for v in detector_targets(boxes))
    corner, stride = (torch.from_numpy(v) for v in grid())
    count = positive.sum().clamp(min=1)
    objectness = torch.nn.functional.binary_cross_entropy_with_logits(
        raw[..., 4], positive.float(), reduction="none"
    )  # fmt: skip
    loss = (objectness * (~free)).sum() / count
    row, cell = positive.nonzero(as_tuple=True)
    if not len(row):
        return loss, math.nan
    s = stride[cell, None]
    centre = raw[row, cell, :2] * s + corner[cell]
    half = 0.5 * torch.exp(raw[row, cell, 2:4].clamp(-6, 6)) * s
    found = torch.cat([centre - half, centre + half], dim=1)
    truth = torch.from_numpy(boxes)[row]
    overlap = _overlap(found, truth)
    extent = (truth[:, 2:] - truth[:, :2]).max(dim=1, keepdim=True).values
    edges = ((found - truth).abs() / extent).mean()
    return loss + 2.0 * (1 - overlap).mean() + 2.0 * edges, float(overlap.detach().mean())


def _overlap(a: Any, b: Any) -> Any:
    torch = pytorch()
    width = (torch.minimum(a[:, 2:], b[:, 2:]) - torch.maximum(a[:, :2], b[:, :2])).clamp(min=0)
    both = width.prod(dim=1)
    areas = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1)
    return both / (areas - both + 1e-6)


def build_pose_network() -> torch.nn.Module:
    """Crops (B, 3, 128, 96) normalised RGB -> SimCC responses x (B, 15, 96), y (B, 15, 128).

    A response is a distribution over the crop's columns or rows; its peak is 1 for a certain joint.
    """
    torch = pytorch()
    nn = torch.nn
    module: Any = nn.Module
    up = torch.nn.functional.interpolate

    class PersonPose(module):
        def __init__(self) -> None:
            super().__init__()
            self.stem = nn.Sequential(_conv(3, 24, stride=2), _conv(24, 40, stride=2), _residual(40), _residual(40))
            self.middle = nn.Sequential(_conv(40, 80, stride=2), _residual(80), _residual(80))
            self.coarse = nn.Sequential(_conv(80, 104, stride=2), _residual(104), _residual(104))
            self.down = nn.ModuleList([nn.Conv2d(104, 80, 1), nn.Conv2d(80, 40, 1)])
            self.merge = nn.ModuleList([_conv(80, 80), _conv(40, 48)])
            self.heat = nn.Conv2d(48, _JOINTS, 1)
            self.finer = nn.ConvTranspose1d(1, 1, 16, 4, 6, bias=False)
            with torch.no_grad():  # initially a smooth interpolation, about a triangle twice as wide as a step
                t = (torch.arange(16) - 7.5) / 4
                self.finer.weight[0, 0] = torch.exp(-0.5 * (t / 0.5) ** 2) / (0.5 * math.sqrt(2 * math.pi))
            self.certain = nn.Linear(104, _JOINTS)

        def raw(self, x: Any) -> tuple[Any, Any, Any]:
            """Logits over columns (B, 15, 96), rows (B, 15, 128), and of the certainty of each joint (B, 15)."""
            fine = self.stem(x)
            middle = self.middle(fine)
            coarse = self.coarse(middle)
            middle = self.merge[0](middle + up(self.down[0](coarse), scale_factor=2.0))
            fine = self.merge[1](fine + up(self.down[1](middle), scale_factor=2.0))
            heat = self.heat(fine).float()
            return self._profile(heat, 2), self._profile(heat, 3), self.certain(coarse.mean(dim=(2, 3))).float()

        def _profile(self, heat: Any, axis: int) -> Any:
            profile = torch.logsumexp(heat, dim=axis)
            length = profile.shape[2]
            return self.finer(profile.reshape(-1, 1, length)).reshape(-1, _JOINTS, 4 * length)

        def forward(self, x: Any) -> tuple[Any, Any]:
            columns, rows, certain = self.raw(x)
            peak = torch.sigmoid(certain)[..., None] * math.sqrt(2 * math.pi)
            return (
                torch.softmax(columns, dim=2) * peak * _SIGMA[0],
                torch.softmax(rows, dim=2) * peak * _SIGMA[1],
            )

    return PersonPose()


def pose_loss(
    network: Any, images: torch.Tensor, joints: np.ndarray, seen: np.ndarray, box_px: np.ndarray
) -> tuple[torch.Tensor, float]:
    """Loss of a batch and, for the log, the mean error of the visible joints as a share of the box's longer side.

    joints (B, 15, 2) px of the crop, seen (B, 15) bool, box_px (B,)
    """
    torch = pytorch()
    with mixed_precision():
        columns, rows, certain = network.raw(images)
    at, there = torch.from_numpy(joints), torch.from_numpy(seen)
    loss = torch.zeros(())
    found = []
    for axis, logits in enumerate((columns, rows)):
        bins = torch.arange(logits.shape[2], dtype=torch.float32)
        target = torch.exp(-0.5 * ((bins - at[..., axis, None]) / _SIGMA[axis]) ** 2)
        target = target / target.sum(dim=2, keepdim=True).clamp(min=1e-6)
        cross = -(target * torch.log_softmax(logits, dim=2)).sum(dim=2)
        loss = loss + (cross * there).sum() / there.sum().clamp(min=1)
        found.append(logits.detach().argmax(dim=2).float())
    off = torch.linalg.norm(torch.stack(found, dim=-1) - at, dim=-1) / torch.from_numpy(box_px)[:, None]
    right = (there & (off < 0.1)).float()
    doubt = torch.nn.functional.binary_cross_entropy_with_logits(certain, right)
    return loss + 0.5 * doubt, float(off[there].mean())
