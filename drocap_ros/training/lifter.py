"""Training of the temporal lifter (needs PyTorch, the optional extra ``train``).

The network maps 2D joints of a window to 3D joints in each frame's own camera: pairs of frames are tokens, dilated
convolutions span about 3 s to either side, and means over the window carry the body's proportions.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.errors import DrocapError
from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES
from drocap_ros.skeleton import BODY_15, LIMB_JOINTS, indices
from drocap_ros.tracks import read_npz
from drocap_ros.training.lifter_samples import MocapBank, sample_batch
from drocap_ros.training.torch_extra import pytorch, write_onnx

if TYPE_CHECKING:
    import torch

_JOINTS = len(BODY_15)
_BONES = BODY_15.bones


@dataclass(frozen=True)
class LifterTraining(Parameters):
    """Parameters of the lifter's training."""

    minutes: float = param(80.0, "wall-clock time of the training", unit="min", minimum=0.01, maximum=10000.0)
    width: int = param(240, "channels of the network", minimum=8, maximum=2048)
    frames_per_batch: int = param(4800, "frames of a batch, all windows together", minimum=64, maximum=1_000_000)
    learning_rate: float = param(2e-3, "peak of the schedule, AdamW", minimum=1e-6, maximum=1.0)
    matrix_learning_rate: float = param(
        0.02, "peak of the schedule, Muon, for the matrices of the body", minimum=1e-6, maximum=1.0
    )
    weight_decay: float = param(0.02, "decoupled weight decay", minimum=0.0, maximum=1.0)
    seed: int = param(0, "of the samples and of the first weights", minimum=0)


def describe_training(
    files: list[Path], include: str, options: LifterTraining, facts: dict[str, Any]
) -> dict[str, str]:
    """Metadata of the ONNX file: training data, licence and command."""
    arrays = [read_npz(path, ("X",)) for path in files]
    return {
        "origin": "; ".join(sorted({str(a["source"]) for a in arrays if "source" in a})),
        "licence": "; ".join(sorted({str(a["licence"]) for a in arrays if "licence" in a})),
        "files": str(len(files)),
        "mocap_frames": str(sum(len(a["X"]) for a in arrays)),
        "command": f"drocap train-lifter MOCAP_DIR --include '{include}' --minutes {options.minutes:g}"
        f" --width {options.width} --seed {options.seed} --out ONNX",
        **{name: str(value) for name, value in facts.items()},
    }


def build_network(width: int) -> torch.nn.Module:
    """Network (B, T, 73) -> joints (B, T, 15, 3), log sigma (B, T, 15, 2) of x, y and of depth; T even."""
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
                Block(1), Block(2), Pool(), Block(4), Block(8), Pool(), Block(16), Block(1), Pool(), Block(2)
            )
            self.norm = nn.LayerNorm(width)
            self.head = nn.Linear(width, 2 * _JOINTS * 5)

        def forward(self, x: Any) -> tuple[Any, Any]:
            batch, frames = x.shape[0], x.shape[1]
            y = self.embed(x.reshape(batch, frames // 2, 2 * FEATURES))
            y = self.head(self.norm(self.body(y))).float()
            y = y.reshape(batch, frames, _JOINTS, 5)
            return y[..., :3], y[..., 3:]

    return Lifting()


def lifting_loss(joints: torch.Tensor, log_sigma: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Loss of a batch and, for the log, the mean joint distance of the twelve limb joints.

    Distances of the joints, of their displacements over one frame and of bone lengths, and the Laplace likelihood of
    the residuals, whose gradient reaches the uncertainties only.
    """
    torch = pytorch()
    error = joints - target
    distance = torch.sqrt(error.square().sum(dim=-1) + 1e-8)
    weight = torch.full((_JOINTS,), 0.6)
    weight[torch.as_tensor(indices(BODY_15.joints, LIMB_JOINTS))] = 1.0
    place = (distance * weight).mean() / weight.mean()
    motion = torch.sqrt((error[:, 1:] - error[:, :-1]).square().sum(dim=-1) + 1e-8).mean()
    child, parent = torch.as_tensor(_BONES[:, 1]), torch.as_tensor(_BONES[:, 0])
    length = torch.linalg.norm(joints[:, :, child] - joints[:, :, parent] + 1e-6, dim=-1)
    true_length = torch.linalg.norm(target[:, :, child] - target[:, :, parent] + 1e-6, dim=-1)
    bones = (length - true_length).abs().mean()
    size = error.detach().abs()
    residual = torch.stack([size[..., :2].mean(dim=-1), size[..., 2]], dim=-1)
    likelihood = (residual * torch.exp(-log_sigma) + log_sigma).mean()
    loss = place + motion + 0.3 * bones + 0.02 * likelihood
    return loss, float(distance.detach()[:, :, weight > 0.9].mean())


def _rate(progress: float) -> float:
    """Share of the peak learning rate: a short warm-up, then half a cosine."""
    return min(progress / 0.02, 1.0) * (0.5 + 0.5 * math.cos(math.pi * min(progress, 1.0))) + 1e-4


def _optimisers(network: torch.nn.Module, options: LifterTraining) -> list[Any]:
    """AdamW for embedding, head, norms and biases; Muon for the rest (half the steps in a trial)."""
    torch = pytorch()
    matrices: list[Any] = []
    others: list[Any] = []
    for name, weight in network.named_parameters():
        (matrices if weight.ndim == 2 and name.startswith("body") else others).append(weight)
    return [
        torch.optim.AdamW(others, lr=options.learning_rate, weight_decay=options.weight_decay, betas=(0.9, 0.98)),
        torch.optim.Muon(matrices, lr=options.matrix_learning_rate, weight_decay=options.weight_decay),
    ]


def train(
    bank: MocapBank,
    options: LifterTraining,
    report: Callable[[str], None],
    checkpoint: Callable[[torch.nn.Module, dict[str, Any]], None],
    checkpoint_minutes: float = 5.0,
    initial: dict[str, Any] | None = None,
) -> tuple[torch.nn.Module, dict[str, Any]]:
    """Train on virtual views for ``options.minutes``; returns averaged weights and the counts of steps and frames.

    ``checkpoint(network, facts)`` is called every ``checkpoint_minutes`` with the averaged weights.
    """
    torch = pytorch()
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    network = build_network(options.width)
    if initial is not None:
        network.load_state_dict(initial)
    average = copy.deepcopy(network)
    optimisers = _optimisers(network, options)
    peaks = [options.learning_rate, options.matrix_learning_rate]
    begin = time.monotonic()
    step, frames_seen, reported, saved, smooth = 0, 0, 0.0, 0.0, math.nan
    while (elapsed := (time.monotonic() - begin) / 60) < options.minutes:
        frames = int(rng.choice([16, 64, 160, 240], p=[0.05, 0.1, 0.45, 0.4]))
        batch = sample_batch(bank, rng, max(options.frames_per_batch // frames, 1), frames)
        for optimiser, peak in zip(optimisers, peaks, strict=True):
            optimiser.param_groups[0]["lr"] = peak * _rate(elapsed / options.minutes)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            joints, log_sigma = network(torch.from_numpy(batch.features))
        loss, distance = lifting_loss(joints, log_sigma, torch.from_numpy(batch.target))
        network.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        for optimiser in optimisers:
            optimiser.step()
        step += 1
        frames_seen += batch.features.shape[0] * frames
        keep = min(0.9995, step / (step + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - keep)
        smooth = distance if math.isnan(smooth) else 0.99 * smooth + 0.01 * distance
        if elapsed - reported > 0.5:
            reported = elapsed
            report(f"{elapsed:6.1f} min  step {step}  frames {frames_seen / 1e6:.2f} M  error {smooth:.4f} of the size")
        if elapsed - saved > checkpoint_minutes:
            saved = elapsed
            checkpoint(average, {"steps": step, "frames_seen": frames_seen})
    if not math.isfinite(smooth):
        raise DrocapError("training diverged: the error is not finite; lower learning_rate")
    return average, {"steps": step, "frames_seen": frames_seen}


def export_onnx(network: torch.nn.Module, path: Path, facts: dict[str, str]) -> None:
    """Write the lifter as ONNX, with :func:`drocap_ros.training.torch_extra.write_onnx`."""
    torch = pytorch()
    names = (["features"], ["joints", "log_sigma"])
    axes = {name: {0: "windows", 1: "frames"} for name in (*names[0], *names[1])}
    write_onnx(network, torch.zeros(2, 16, FEATURES), path, *names, axes, facts)
