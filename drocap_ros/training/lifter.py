"""Training of the temporal lifter (needs PyTorch, the optional extra ``train``).

The network maps 2D joints of a window to 3D joints in each frame's own camera: pairs of frames are tokens, dilated
convolutions span about 3 s to either side, and means over the window carry the body's proportions.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.errors import DrocapError
from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES
from drocap_ros.skeleton import BODY_17, LIMB_JOINTS, indices
from drocap_ros.tracks import read_npz
from drocap_ros.training.initial_weights import origin_of, start_from
from drocap_ros.training.lifter_samples import Batch, sample_batch
from drocap_ros.training.mocap_bank import MocapBank
from drocap_ros.training.muon import muon
from drocap_ros.training.torch_extra import mixed_precision, pytorch, write_onnx

if TYPE_CHECKING:
    import torch

_JOINTS = len(BODY_17)


@dataclass(frozen=True)
class LifterTraining(Parameters):
    """Parameters of the lifter's training."""

    minutes: float = param(80.0, "wall-clock time of the training", unit="min", minimum=0.01, maximum=10000.0)
    steps: int = param(0, "batches instead of minutes: the same seed gives the same weights", minimum=0)
    width: int = param(240, "channels of the network", minimum=8, maximum=2048)
    frames_per_batch: int = param(4800, "frames of a batch, all windows together", minimum=64, maximum=1_000_000)
    learning_rate: float = param(2e-3, "peak of the schedule, AdamW", minimum=1e-6, maximum=1.0)
    matrix_learning_rate: float = param(
        0.02, "peak of the schedule, Muon, for the matrices of the body", minimum=1e-6, maximum=1.0
    )
    rate: float = param(
        1.0, "share of both peaks: trained weights are forgotten at the full one", minimum=1e-4, maximum=1.0
    )
    weight_decay: float = param(0.02, "decoupled weight decay", minimum=0.0, maximum=1.0)
    seed: int = param(0, "of the samples and of the first weights", minimum=0)

    def length(self) -> str:
        """The option that ends the training."""
        return f"--steps {self.steps}" if self.steps else f"--minutes {self.minutes:g}"


def describe_training(
    files: list[Path], include: str, options: LifterTraining, facts: dict[str, Any], initial: Path | None = None
) -> dict[str, str]:
    """Metadata of the ONNX file: training data, licence and command."""
    arrays = [read_npz(path, ("X",)) for path in files]
    begun = {"initial": origin_of(initial)} if initial else {}
    return {
        "origin": "; ".join(sorted({str(a["source"]) for a in arrays if "source" in a})),
        "licence": "; ".join(sorted({str(a["licence"]) for a in arrays if "licence" in a})),
        "files": str(len(files)),
        "mocap_frames": str(sum(len(a["X"]) for a in arrays)),
        "command": f"drocap train-lifter MOCAP_DIR --include '{include}' {options.length()}"
        f" --rate {options.rate:g} --width {options.width} --seed {options.seed}"
        f"{' --initial ONNX' if initial else ''} --out ONNX",
        **begun,
        **{name: str(value) for name, value in facts.items()},
    }


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


def lifting_loss(outputs: tuple[torch.Tensor, ...], batch: Batch) -> tuple[torch.Tensor, float]:
    """Loss of the network's outputs and, for the log, the mean joint distance of the twelve limb joints.

    Distances of the joints, of their displacements over one frame and of bone lengths; the Laplace likelihood of the
    residuals, whose gradient reaches the uncertainties only; the cross-entropies of the depth signs, weighted by the
    depth differences, and of the still feet.
    """
    torch = pytorch()
    joints, log_sigma, deeper, still = outputs
    target = torch.from_numpy(batch.target)
    known = torch.isfinite(target[..., 0])
    target = torch.nan_to_num(target)
    error = (joints - target) * known[..., None]
    distance = torch.sqrt(error.square().sum(dim=-1) + 1e-8)
    limb = torch.zeros(_JOINTS, dtype=torch.bool)
    limb[torch.as_tensor(indices(BODY_17.joints, LIMB_JOINTS))] = True
    weight = torch.where(limb, 1.0, 0.6)
    place = (distance * weight).mean() / weight.mean()
    motion = torch.sqrt((error[:, 1:] - error[:, :-1]).square().sum(dim=-1) + 1e-8).mean()
    child, parent = torch.as_tensor(BONES[:, 1]), torch.as_tensor(BONES[:, 0])
    bone, true_bone = joints[:, :, child] - joints[:, :, parent], target[:, :, child] - target[:, :, parent]
    there = known[:, :, child]
    length, true_length = (torch.linalg.norm(b + 1e-6, dim=-1) for b in (bone, true_bone))
    bones = ((length - true_length).abs() * there).mean()
    size = error.detach().abs()
    residual = torch.stack([size[..., :2].mean(dim=-1), size[..., 2]], dim=-1)
    likelihood = ((residual * torch.exp(-log_sigma) + log_sigma) * known[..., None]).mean()
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    depth = true_bone[..., 2]
    signs = entropy(deeper, (depth > 0).float(), weight=torch.clamp(depth.abs(), max=1.0) * there)
    foot = torch.from_numpy(batch.still)
    feet = entropy(still, torch.nan_to_num(foot), weight=torch.isfinite(foot).float())
    loss = place + motion + 0.3 * bones + 0.02 * likelihood + 0.05 * signs + 0.02 * feet
    return loss, float(distance.detach()[:, :, limb].mean())


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
        muon(matrices, options.weight_decay),
    ]


def _batches(bank: MocapBank, rng: np.random.Generator, frames_per_batch: int) -> Iterator[Batch]:
    """Endless batches; each is drawn while the one before it is used."""

    def draw() -> Batch:
        frames = int(rng.choice([16, 64, 160, 240], p=[0.05, 0.1, 0.45, 0.4]))
        return sample_batch(bank, rng, max(frames_per_batch // frames, 1), frames)

    with ThreadPoolExecutor(1) as ahead:
        coming = ahead.submit(draw)
        while True:
            batch = coming.result()
            coming = ahead.submit(draw)
            yield batch


def train(
    bank: MocapBank,
    options: LifterTraining,
    report: Callable[[str], None],
    checkpoint: Callable[[torch.nn.Module, dict[str, Any]], None],
    checkpoint_minutes: float = 5.0,
    initial: Path | None = None,
) -> tuple[torch.nn.Module, dict[str, Any]]:
    """Train on virtual views; returns averaged weights and the counts of steps and frames.

    ``initial`` is a lifter whose weights begin the training.

    ``checkpoint(network, facts)`` is called every ``checkpoint_minutes`` with the averaged weights.
    """
    torch = pytorch()
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    network = build_network(options.width)
    if initial is not None:
        start_from(network, initial)
    average = copy.deepcopy(network)
    optimisers = _optimisers(network, options)
    peaks = [options.rate * options.learning_rate, options.rate * options.matrix_learning_rate]
    begin = time.monotonic()
    step, frames_seen, reported, saved, smooth = 0, 0, 0.0, 0.0, math.nan
    for batch in _batches(bank, rng, options.frames_per_batch):
        elapsed = (time.monotonic() - begin) / 60
        progress = step / options.steps if options.steps else elapsed / options.minutes
        if progress >= 1:
            break
        for optimiser, peak in zip(optimisers, peaks, strict=True):
            for group in optimiser.param_groups:
                group["lr"] = peak * _rate(progress)
        with mixed_precision():
            outputs = network(torch.from_numpy(batch.features))
        loss, distance = lifting_loss(outputs, batch)
        network.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        for optimiser in optimisers:
            optimiser.step()
        step += 1
        frames_seen += batch.features.shape[0] * batch.features.shape[1]
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
    names = (["features"], ["joints", "log_sigma", "deeper", "still"])
    axes = {name: {0: "windows", 1: "frames"} for name in (*names[0], *names[1])}
    write_onnx(network, torch.zeros(2, 16, FEATURES), path, *names, axes, facts)
