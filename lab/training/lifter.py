"""Training of the temporal lifter (needs PyTorch, the optional extra ``train``)."""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.errors import DrocapError
from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES
from drocap_ros.tracks import read_npz
from lab.training.lifter_loss import lifting_loss
from lab.training.lifter_network import EXACT, build_network
from lab.training.lifter_samples import sample_batch
from lab.training.mocap_bank import MocapBank
from lab.training.muon import muon
from lab.training.torch_extra import best_device, mixed_precision, pytorch, write_onnx

if TYPE_CHECKING:
    import torch

#: Frames of the training windows, and how often each length is drawn.
_LENGTHS, _SHARES = (16, 64, 160, 240), (0.05, 0.1, 0.45, 0.4)
#: Batches among which the repeated ones are drawn.
_POOL = 256


@dataclass(frozen=True)
class LifterTraining(Parameters):
    """Parameters of the lifter's training."""

    minutes: float = param(80.0, "wall-clock time of the training", unit="min", minimum=0.01, maximum=10000.0)
    steps: int = param(0, "batches instead of minutes: the same seed gives the same weights", minimum=0)
    width: int = param(336, "channels of the network", minimum=8, maximum=2048)
    frames_per_batch: int = param(
        4800, "frames of a batch, all windows together", minimum=max(_LENGTHS), maximum=1_000_000
    )
    steps_per_batch: int = param(1, "uses of each batch, where steps are faster than samples", minimum=1, maximum=100)
    workers: int = param(1, "processes that draw samples; 0: the training itself does", minimum=0, maximum=256)
    learning_rate: float = param(2e-3, "peak of the schedule, AdamW", minimum=1e-6, maximum=1.0)
    matrix_learning_rate: float = param(
        0.02, "peak of the schedule, Muon, for the matrices of the body", minimum=1e-6, maximum=1.0
    )
    weight_decay: float = param(0.02, "decoupled weight decay", minimum=0.0, maximum=1.0)
    seed: int = param(0, "of the samples and of the first weights", minimum=0)

    def command(self, include: str) -> str:
        """The command line of this training."""
        length = f"--steps {self.steps}" if self.steps else f"--minutes {self.minutes:g}"
        return (
            f"python -m lab train-lifter MOCAP_DIR --include '{include}' {length} --width {self.width}"
            f" --frames-per-batch {self.frames_per_batch} --steps-per-batch {self.steps_per_batch}"
            f" --seed {self.seed} --out ONNX"
        )


def describe_training(files: list[Path], include: str, options: LifterTraining) -> dict[str, str]:
    """Metadata of the ONNX file: training data, licence and command."""
    arrays = [read_npz(path, ("X",)) for path in files]
    return {
        "origin": "; ".join(sorted({str(a["source"]) for a in arrays if "source" in a})),
        "licence": "; ".join(sorted({str(a["licence"]) for a in arrays if "licence" in a})),
        "files": str(len(files)),
        "mocap_frames": str(sum(len(a["X"]) for a in arrays)),
        "command": options.command(include),
    }


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


def _batches(bank: MocapBank, options: LifterTraining, device: Any) -> Iterator[tuple[torch.Tensor, ...]]:
    """Endless features (B, T, 143), targets and still feet on the device; batch k has random numbers of its own."""
    torch = pytorch()

    class Samples(torch.utils.data.Dataset):  # type: ignore[name-defined]
        def __getitem__(self, k: int) -> tuple[Any, ...]:
            rng = np.random.default_rng((options.seed, k))
            frames = int(rng.choice(_LENGTHS, p=_SHARES))
            batch = sample_batch(bank, rng, max(options.frames_per_batch // frames, 1), frames)
            return batch.features, batch.target, batch.still

    # Without pinned memory: the thread that allocates it spoils the recording of a graph.  Arrays pass through pipes:
    # tensors would need shared memory, of which a container has 64 MB.
    loader = torch.utils.data.DataLoader(
        Samples(),
        batch_size=None,
        sampler=itertools.count(),
        num_workers=options.workers,
        collate_fn=tuple,
        prefetch_factor=4 if options.workers else None,
    )
    pool: list[Any] = []
    again = np.random.default_rng(options.seed)
    for batch in loader:
        newest = tuple(torch.from_numpy(part).to(device) for part in batch)
        yield newest
        if options.steps_per_batch > 1:
            pool = [*pool[1 - _POOL :], newest]
            for _ in range(options.steps_per_batch - 1):
                yield pool[again.integers(len(pool))]


def _losses(network: torch.nn.Module, device: Any) -> Callable[..., Any]:
    """Function (features, target, still) -> loss and mean distance; on a GPU one recorded graph per shape."""
    torch = pytorch()
    module: Any = torch.nn.Module

    class Loss(module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network
            self.of_outputs = lifting_loss(device)

        def forward(self, features: Any, target: Any, still: Any) -> Any:
            with mixed_precision(device):
                outputs = self.network(features)
            return self.of_outputs(outputs, target, still)

    if device.type != "cuda":
        return Loss()
    graphs: dict[Any, Any] = {}

    def loss(*batch: Any) -> Any:
        shape = batch[0].shape
        if shape not in graphs:
            graphs[shape] = torch.cuda.make_graphed_callables(Loss(), tuple(part.clone() for part in batch))
        return graphs[shape](*batch)

    return loss


def train(
    bank: MocapBank,
    options: LifterTraining,
    report: Callable[[str], None],
    checkpoint: Callable[[torch.nn.Module, dict[str, Any]], None],
    checkpoint_minutes: float = 5.0,
) -> tuple[torch.nn.Module, dict[str, Any]]:
    """Train on virtual views, on a GPU where PyTorch finds one; returns averaged weights and the counts of frames.

    ``checkpoint(network, facts)`` is called every ``checkpoint_minutes`` with the averaged weights.  ``frames_seen``
    counts a repeated batch each time.

    Raises
    ------
    DrocapError
        When the error is no longer finite.
    """
    torch = pytorch()
    torch.manual_seed(options.seed)
    device = best_device()
    network = build_network(options.width).to(device)
    average = copy.deepcopy(network)
    loss_of = _losses(network, device)
    optimisers = _optimisers(network, options)
    peaks = [options.learning_rate, options.matrix_learning_rate]
    begin = time.monotonic()
    step, frames_seen, reported, saved = 0, 0, 0.0, 0.0
    smooth = torch.zeros((), device=device)
    for batch in _batches(bank, options, device):
        elapsed = (time.monotonic() - begin) / 60
        progress = step / options.steps if options.steps else elapsed / options.minutes
        if progress >= 1:
            break
        for optimiser, peak in zip(optimisers, peaks, strict=True):
            for group in optimiser.param_groups:
                group["lr"] = peak * _rate(progress)
        loss, distance = loss_of(*batch)
        network.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        for optimiser in optimisers:
            optimiser.step()
        step += 1
        frames_seen += batch[0].shape[0] * batch[0].shape[1]
        with torch.no_grad():
            keep = min(0.9995, step / (step + 10))
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - keep)
            smooth.lerp_(distance, 1.0 if step == 1 else 0.01)
        if elapsed - reported > 0.1:
            reported = elapsed
            millions = frames_seen / 1e6
            report(f"{elapsed:6.1f} min  step {step}  frames {millions:.2f} M  error {float(smooth):.4f} of the size")
        if elapsed - saved > checkpoint_minutes:
            saved = elapsed
            _check_finite(smooth)
            checkpoint(average, {"steps": step, "frames_seen": frames_seen})
    _check_finite(smooth)
    return average, {"steps": step, "frames_seen": frames_seen, "device": device.type}


def _check_finite(error: torch.Tensor) -> None:
    if not math.isfinite(float(error)):
        raise DrocapError("training diverged: expected a finite error; check the MoCap, or try another --seed")


def export_onnx(network: torch.nn.Module, path: Path, facts: dict[str, str]) -> None:
    """Write the lifter as ONNX, and a second one for live poses with products of integers, all but at its ends."""
    torch = pytorch()
    names = (["features"], ["joints", "log_sigma", "deeper", "still"])
    axes = {name: {0: "windows", 1: "frames"} for name in (*names[0], *names[1])}
    write_onnx(network, torch.zeros(2, 16, FEATURES), path, *names, axes, facts, exact=EXACT)
