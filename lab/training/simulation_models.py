"""Training of the simulation's person detector and 2D pose network on rendered images (extra ``train``)."""

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
from drocap_ros.skeleton import BODY_15
from lab.training.rendered_samples import (
    DETECTOR_SIZE,
    POSE_SIZE,
    World,
    detector_sample,
    make_world,
    pose_sample,
)
from lab.training.sigma_scale import sigma_scale
from lab.training.simulation_networks import build_detector, build_pose_network, detector_loss, pose_loss
from lab.training.torch_extra import pytorch, write_onnx

if TYPE_CHECKING:
    import torch

#: Normalisation of RGB images, that of the public pose networks.
_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_STD = np.array([58.395, 57.12, 57.375], np.float32)
_FRESH_SHARE = 0.34  # of each batch is newly rendered
_RENEW_EVERY = 25  # rounds between two new sceneries


@dataclass(frozen=True)
class SimulationTraining(Parameters):
    """Parameters of the training of the simulation's networks."""

    minutes: float = param(40.0, "wall-clock time of the training", unit="min", minimum=0.01, maximum=10000.0)
    steps: int = param(0, "end after this many rounds instead; the result then depends on the seed alone", minimum=0)
    only: str = param("both", "which networks to train", choices=("both", "detector", "pose"))
    batch: int = param(32, "images of a batch", minimum=2, maximum=1024)
    pose_batches: int = param(2, "batches of the pose network to one of the detector", minimum=1, maximum=16)
    pool: int = param(4096, "rendered images kept for further batches", minimum=8, maximum=100_000)
    learning_rate: float = param(2.5e-3, "peak of the schedule, AdamW", minimum=1e-6, maximum=1.0)
    weight_decay: float = param(0.02, "decoupled weight decay", minimum=0.0, maximum=1.0)
    seed: int = param(0, "of the samples and of the initial weights", minimum=0)


class _Pool:
    """Samples of one kind; each batch mixes new and earlier ones."""

    def __init__(self, sample: Callable[[World, np.random.Generator], Any], size: int) -> None:
        self._sample, self._size, self._next = sample, size, 0
        self._kept: list[Any] = []

    def batch(self, world: World, rng: np.random.Generator, count: int) -> list[Any]:
        """``count`` samples, a third of them new; all of them while the pool is small."""
        fresh = math.ceil(count * (_FRESH_SHARE if len(self._kept) >= 8 * count else 1.0))
        new = [self._sample(world, rng) for _ in range(fresh)]
        chosen = [self._kept[i] for i in rng.integers(0, len(self._kept), count - fresh)] if fresh < count else []
        for sample in new:
            if len(self._kept) < self._size:
                self._kept.append(sample)
            else:
                self._kept[self._next] = sample
                self._next = (self._next + 1) % self._size
        return new + chosen


def _varied(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Images (B, H, W, 3) uint8 as float32, each with a random gain per colour, which varies repeated samples."""
    gain = np.exp(rng.normal(0, 0.1, (len(images), 1, 1, 3))).astype(np.float32)
    return np.asarray(np.clip(images * gain, 0, 255), np.float32)


def detector_batch(samples: list[Any], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Images (B, 3, 192, 320) BGR 0-255 and boxes (B, 4) px, NaN without a person; half of the batch mirrored."""
    images = _varied(np.stack([s.image for s in samples]), rng)
    boxes = np.stack([s.box for s in samples])
    for i in np.flatnonzero(rng.random(len(samples)) < 0.5):
        images[i] = images[i, :, ::-1]
        boxes[i, [0, 2]] = DETECTOR_SIZE[0] - boxes[i, [2, 0]]
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2)), boxes


def pose_batch(samples: list[Any], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Images (B, 3, 128, 96) normalised RGB, joints (B, 15, 2) px, seen (B, 15), box sides (B,); half mirrored."""
    images = _varied(np.stack([s.image for s in samples]), rng)
    joints, seen = np.stack([s.joints for s in samples]), np.stack([s.seen for s in samples])
    for i in np.flatnonzero(rng.random(len(samples)) < 0.5):
        images[i] = images[i, :, ::-1]
        joints[i] = joints[i, BODY_15.mirror]
        joints[i, :, 0] = POSE_SIZE[0] - 1 - joints[i, :, 0]
        seen[i] = seen[i, BODY_15.mirror]
    rgb = (images[..., ::-1] - _MEAN) / _STD
    sides = np.array([s.box_px for s in samples], np.float32)
    return np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)), joints, seen, sides


class _Learner:
    """A network with its optimiser and the running mean of its weights."""

    def __init__(self, network: Any, options: SimulationTraining) -> None:
        torch = pytorch()
        self.network = network.to(memory_format=torch.channels_last).train()
        self.average = copy.deepcopy(network)
        self._peak = options.learning_rate
        self._optimiser = torch.optim.AdamW(network.parameters(), lr=self._peak, weight_decay=options.weight_decay)
        self.steps, self.mean_measure = 0, math.nan

    def step(self, loss: torch.Tensor, measure: float, progress: float) -> None:
        """Take one step; ``measure`` is averaged for the log."""
        torch = pytorch()
        warm = min(self.steps / 60, 1.0)
        self._optimiser.param_groups[0]["lr"] = self._peak * warm * (0.5 + 0.5 * math.cos(math.pi * progress)) + 1e-6
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self._optimiser.step()
        self.steps += 1
        keep = min(0.998, self.steps / (self.steps + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1 - keep)
            for mean, now in zip(self.average.buffers(), self.network.buffers(), strict=True):
                mean.copy_(now) if not mean.is_floating_point() else mean.lerp_(now, 1 - keep)
        if math.isfinite(measure):
            last = self.mean_measure
            self.mean_measure = measure if math.isnan(last) else 0.98 * last + 0.02 * measure


def train(
    options: SimulationTraining,
    report: Callable[[str], None],
    checkpoint: Callable[[torch.nn.Module, torch.nn.Module, dict[str, Any]], None],
    checkpoint_minutes: float = 4.0,
) -> tuple[torch.nn.Module, torch.nn.Module, dict[str, Any]]:
    """Train both networks on rendered samples.

    ``checkpoint(detector, pose, facts)`` is called every ``checkpoint_minutes``.

    Returns
    -------
    Detector and pose network with averaged weights, and the facts: steps of each, batch size.  A network excluded by
    ``options.only`` keeps its initial weights and has no steps.

    Raises
    ------
    DrocapError
        When the training diverged, or PyTorch is missing.
    """
    torch = pytorch()
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    world = make_world(rng)
    detector, pose = _Learner(build_detector(), options), _Learner(build_pose_network(), options)
    pools = _Pool(detector_sample, options.pool), _Pool(pose_sample, options.pool)
    begin = time.monotonic()
    shown = saved = 0.0
    rounds = 0

    def facts() -> dict[str, Any]:
        return {"detector_steps": detector.steps, "pose_steps": pose.steps, "batch": options.batch}

    while True:
        elapsed = (time.monotonic() - begin) / 60
        progress = rounds / options.steps if options.steps else elapsed / options.minutes
        if progress >= 1:
            break
        if options.only != "pose":
            images, boxes = detector_batch(pools[0].batch(world, rng, options.batch), rng)
            detector.step(*detector_loss(detector.network, _tensor(images), boxes), progress)
        for _ in range(options.pose_batches if options.only != "detector" else 0):
            crops, *truth = pose_batch(pools[1].batch(world, rng, options.batch), rng)
            pose.step(*pose_loss(pose.network, _tensor(crops), *truth), progress)
        rounds += 1
        if rounds % _RENEW_EVERY == 0:
            world.renew()
        if elapsed - shown > 0.5:
            shown = elapsed
            report(
                f"{elapsed:6.1f} min  detector step {detector.steps} overlap {detector.mean_measure:.3f}"
                f"  pose step {pose.steps} error {pose.mean_measure:.4f} of the box"
            )
        if elapsed - saved > checkpoint_minutes:
            saved = elapsed
            checkpoint(detector.average, pose.average, facts())
    if not all(bool(torch.isfinite(w).all()) for n in (detector, pose) for w in n.average.parameters()):
        raise DrocapError("training diverged: weights are not finite; lower learning_rate")
    return detector.average, pose.average, facts()


def _tensor(images: np.ndarray) -> torch.Tensor:
    library = pytorch()
    tensor: torch.Tensor = library.from_numpy(images).contiguous(memory_format=library.channels_last)
    return tensor


def export(detector: torch.nn.Module, pose: torch.nn.Module, folder: Path, facts: dict[str, str]) -> None:
    """Write the networks that have steps as ONNX files, with weights in half precision and ``facts`` as metadata.

    The pose network's standard deviations are measured on new samples, and written beside it.
    """
    torch = pytorch()
    if int(facts["detector_steps"]):
        write_onnx(
            detector, torch.zeros(1, 3, DETECTOR_SIZE[1], DETECTOR_SIZE[0]), folder / "person_detector.onnx",
            ["image"], ["grid"], {}, facts,
        )  # fmt: skip
    if int(facts["pose_steps"]):
        write_onnx(
            pose, torch.zeros(1, 3, POSE_SIZE[1], POSE_SIZE[0]), folder / "person_pose.onnx",
            ["image"], ["columns", "rows"], {}, facts,
        )  # fmt: skip
        beside = folder / "person_pose.yaml"
        beside.write_text("skeleton: body15\n", encoding="utf-8")
        with beside.open("a", encoding="utf-8") as file:
            file.write(f"sigma_scale: {sigma_scale(folder / 'person_pose.onnx'):.2f}\n")
