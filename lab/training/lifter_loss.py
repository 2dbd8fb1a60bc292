"""Loss of the lifter's outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from drocap_ros.reconstruction.lifted.lifter_input import BONES
from drocap_ros.skeleton import BODY_17, LIMB_JOINTS, indices
from lab.training.torch_extra import pytorch

if TYPE_CHECKING:
    import torch


def lifting_loss(device: Any) -> Callable[..., tuple[torch.Tensor, torch.Tensor]]:
    """Function (outputs, target (B, T, 17, 3), still (B, T, 2)) -> loss and mean distance of the twelve limb joints.

    Distances of the joints, of their displacements over one frame and of bone lengths; the Laplace likelihood of the
    residuals, whose gradient reaches the uncertainties only; the cross-entropies of the depth signs, weighted by the
    depth differences, and of the still feet.  The indices lie on the device: a recorded graph copies nothing to it.
    """
    torch = pytorch()
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    limbs = torch.as_tensor(indices(BODY_17.joints, LIMB_JOINTS), device=device)
    weight = torch.full((len(BODY_17),), 0.6, device=device).index_fill(0, limbs, 1.0)
    child, parent = (torch.as_tensor(BONES[:, k].copy(), device=device) for k in (1, 0))

    def loss(outputs: tuple[Any, ...], target: Any, still: Any) -> tuple[Any, Any]:
        joints, log_sigma, deeper, rest = outputs
        known = torch.isfinite(target[..., 0])
        target = torch.nan_to_num(target)
        error = (joints - target) * known[..., None]
        distance = torch.sqrt(error.square().sum(dim=-1) + 1e-8)
        place = (distance * weight).mean() / weight.mean()
        motion = torch.sqrt((error[:, 1:] - error[:, :-1]).square().sum(dim=-1) + 1e-8).mean()
        bone = joints.index_select(2, child) - joints.index_select(2, parent)
        true_bone = target.index_select(2, child) - target.index_select(2, parent)
        there = known.index_select(2, child)
        length, true_length = (torch.linalg.norm(b + 1e-6, dim=-1) for b in (bone, true_bone))
        bones = ((length - true_length).abs() * there).mean()
        size = error.detach().abs()
        residual = torch.stack([size[..., :2].mean(dim=-1), size[..., 2]], dim=-1)
        likelihood = ((residual * torch.exp(-log_sigma) + log_sigma) * known[..., None]).mean()
        depth = true_bone[..., 2]
        signs = entropy(deeper, (depth > 0).float(), weight=torch.clamp(depth.abs(), max=1.0) * there)
        feet = entropy(rest, torch.nan_to_num(still), weight=torch.isfinite(still).float())
        total = place + motion + 0.3 * bones + 0.02 * likelihood + 0.05 * signs + 0.02 * feet
        return total, distance.detach().index_select(2, limbs).mean()

    return loss
