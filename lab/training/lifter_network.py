"""The lifter's network: pairs of frames are tokens, dilated convolutions span 8 s to either side, and means over the
window carry the body's proportions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES
from drocap_ros.skeleton import BODY_17
from lab.training.torch_extra import pytorch

if TYPE_CHECKING:
    import torch

_JOINTS = len(BODY_17)
#: Modules that stay in single precision: of all, integers there change the joints most (``lab/experiments.csv``).
EXACT = ("embed", "body.0", "body.18", "head", "signs")


def build_network(width: int) -> torch.nn.Module:
    """Network of features (B, T, 143), T even.

    Its outputs are joints (B, T, 17, 3), log sigma (B, T, 17, 2) of x, y and of depth, and logits: (B, T, 16) that a
    bone's child lies behind its parent, (B, T, 2) that the right and the left foot stand still.
    """
    torch = pytorch()
    nn, functional = torch.nn, torch.nn.functional
    module: Any = nn.Module

    class Block(module):
        def __init__(self, dilation: int) -> None:
            super().__init__()
            self.dilation = dilation
            self.norm = nn.LayerNorm(width)
            self.mix = nn.Linear(3 * width, width)
            self.out = nn.Linear(width, width)
            nn.init.zeros_(self.out.bias)
            self.out.weight.data.mul_(0.3)

        def forward(self, x: Any) -> Any:
            d = self.dilation
            y = functional.pad(self.norm(x), (0, 0, d, d))
            length = x.shape[1]
            y = torch.cat([y[:, :length], y[:, d : d + length], y[:, 2 * d : 2 * d + length]], dim=2)
            return x + self.out(functional.relu(self.mix(y)))

    class Pool(module):
        def __init__(self) -> None:
            super().__init__()
            self.norm = nn.LayerNorm(width)
            self.into = nn.Linear(width, width // 2)
            self.out = nn.Linear(width // 2, width)

        def forward(self, x: Any) -> Any:
            return x + self.out(functional.relu(self.into(self.norm(x))).mean(dim=1, keepdim=True))

    class Lifting(module):
        def __init__(self) -> None:
            super().__init__()
            self.embed = nn.Linear(2 * FEATURES, width)
            self.body = nn.Sequential(
                Block(1), Block(2), Pool(), Block(4), Block(8), Pool(), Block(16), Block(1), Pool(), Block(2),
                Block(4), Block(32), Pool(), Block(8), Block(1), Block(2), Block(16), Block(4), Block(1),
            )  # fmt: skip
            self.norm = nn.LayerNorm(width)
            self.head = nn.Linear(width, 2 * _JOINTS * 5)
            self.signs = nn.Linear(width, 2 * (len(BONES) + 2))

        def forward(self, x: Any) -> tuple[Any, Any, Any, Any]:
            batch, frames = x.shape[0], x.shape[1]
            y = self.embed(x.reshape(batch, frames // 2, 2 * FEATURES))
            y = self.norm(self.body(y))
            place = self.head(y).float().reshape(batch, frames, _JOINTS, 5)
            sign = self.signs(y).float().reshape(batch, frames, len(BONES) + 2)
            return place[..., :3], place[..., 3:], sign[..., :-2], sign[..., -2:]

    return Lifting()
