"""Muon, in bfloat16 where the processor has it: PyTorch's own emulates it elsewhere, many times slower."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from lab.training.torch_extra import pytorch, reduced

if TYPE_CHECKING:
    import torch

_MOMENTUM = 0.95
#: Odd polynomial of the fifth degree whose iteration drives all singular values to about one.
_POLYNOMIAL = (3.4445, -4.7750, 2.0315)
_ITERATIONS = 5


def orthogonalised(matrices: torch.Tensor) -> torch.Tensor:
    """The matrices (..., M, N) with all their singular values near one (0.7 to 1.2), by Newton-Schulz iterations.

    K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024.
    """
    a, b, c = _POLYNOMIAL
    tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.mT if tall else matrices
    x = reduced(x / x.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-7))
    for _ in range(_ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * (gram @ gram)) @ x
    return (x.mT if tall else x).float()


def muon(matrices: list[torch.nn.Parameter], weight_decay: float) -> Any:
    """Optimiser of matrices (M, N) along the orthogonalised Nesterov momentum; the caller sets its rate.

    Matrices of one shape are stepped together.
    """
    torch = pytorch()
    optimiser: Any = torch.optim.Optimizer
    shapes = sorted({tuple(weight.shape) for weight in matrices})

    class Muon(optimiser):
        @torch.no_grad()
        def step(self) -> None:
            for group in self.param_groups:
                weights = group["params"]
                gradient = torch.stack([weight.grad for weight in weights])
                momentum = self.state[weights[0]].setdefault("momentum", torch.zeros_like(gradient))
                momentum.lerp_(gradient, 1 - _MOMENTUM)
                update = orthogonalised(gradient.lerp(momentum, _MOMENTUM))
                rate = group["lr"] * math.sqrt(max(1.0, gradient.shape[1] / gradient.shape[2]))
                torch._foreach_mul_(weights, 1 - group["lr"] * weight_decay)
                torch._foreach_add_(weights, list(update.unbind()), alpha=-rate)

    groups = [{"params": [weight for weight in matrices if tuple(weight.shape) == shape]} for shape in shapes]
    return Muon(groups, {"lr": 0.0})
