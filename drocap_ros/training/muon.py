"""Muon, in bfloat16 where the processor has it: PyTorch's own emulates it elsewhere, many times slower."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from drocap_ros.training.torch_extra import pytorch, reduced

if TYPE_CHECKING:
    import torch

_MOMENTUM = 0.95
#: Odd polynomial of the fifth degree whose iteration drives all singular values to about one.
_POLYNOMIAL = (3.4445, -4.7750, 2.0315)
_ITERATIONS = 5


def orthogonalised(matrix: torch.Tensor) -> torch.Tensor:
    """The matrix (M, N) with all its singular values near one (0.7 to 1.2), by Newton-Schulz iterations.

    K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024.
    """
    a, b, c = _POLYNOMIAL
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = reduced(x / x.norm().clamp(min=1e-7))
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * (gram @ gram)) @ x
    return (x.T if tall else x).float()


def muon(matrices: list[torch.nn.Parameter], weight_decay: float) -> Any:
    """Optimiser of matrices (M, N) along the orthogonalised Nesterov momentum; the caller sets its rate."""
    torch = pytorch()
    optimiser: Any = torch.optim.Optimizer

    class Muon(optimiser):
        @torch.no_grad()
        def step(self) -> None:
            for group in self.param_groups:
                for weight in group["params"]:
                    state = self.state[weight]
                    if not state:
                        state["momentum"] = torch.zeros_like(weight)
                    momentum = state["momentum"]
                    momentum.lerp_(weight.grad, 1 - _MOMENTUM)
                    update = orthogonalised(weight.grad.lerp(momentum, _MOMENTUM))
                    rate = group["lr"] * math.sqrt(max(1.0, weight.shape[0] / weight.shape[1]))
                    weight.mul_(1 - group["lr"] * weight_decay).add_(update, alpha=-rate)

    return Muon(matrices, {"lr": 0.0})
