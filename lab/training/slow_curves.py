"""Random curves over time that the training's motions, cameras and keypoints share."""

from __future__ import annotations

import numpy as np


def slow(rng: np.random.Generator, windows: int, frames: int, shape: tuple[int, ...]) -> np.ndarray:
    """(B, T, *shape) float32 of about unit variance: a constant plus a slow oscillation of random period."""
    tail = (1,) * len(shape)
    period = rng.uniform(24, 240, (windows, 1, *shape))
    phase = rng.uniform(0, 2 * np.pi, (windows, 1, *shape))
    time = np.arange(frames).reshape(1, frames, *tail)
    wave = np.sin(2 * np.pi * time / period + phase)
    constant = rng.standard_normal((windows, 1, *shape))
    return (0.8 * constant + 0.8 * wave).astype(np.float32)


def runs(rng: np.random.Generator, shape: tuple[int, ...], frames: int, share: np.ndarray, longest: int) -> np.ndarray:
    """(B, T, *rest) bool: for a ``share`` of (B, *rest), one run of up to ``longest`` frames is True."""
    tail = (1,) * (len(shape) - 1)
    chosen = (rng.random(shape) < share.reshape(-1, *tail))[:, None]
    begin = rng.integers(0, max(frames, 1), shape)[:, None]
    length = rng.integers(1, longest + 1, shape)[:, None]
    time = np.arange(frames).reshape(1, frames, *tail)
    return chosen & (time >= begin) & (time < begin + length)
