"""Learning of the pose dictionary (Zhou et al. 2016, section 3; Mairal et al. 2009)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.paper.dictionary import Dictionary, sparse_code
from drocap_ros.skeleton import BODY_15


def mirror_poses(s: np.ndarray) -> np.ndarray:
    """Poses (..., 15, 3) of the torso frame with left and right exchanged."""
    mirrored: np.ndarray = s[..., BODY_15.mirror, :] * np.array([1.0, -1.0, 1.0])
    return mirrored


@dataclass(frozen=True)
class Learning:
    """Options of :func:`learn`.

    atoms : size K; components : principal directions D
    sparsity : weight of the L1 norm, m; larger means fewer active atoms
    rounds : alternations, of ``batch`` poses each
    """

    atoms: int = 128
    sparsity: float = 0.03
    components: int = 20
    rounds: int = 40
    batch: int = 4096
    seed: int = 0


def learn(
    poses: np.ndarray,
    how: Learning = Learning(),
    metadata: dict[str, object] | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Dictionary:
    """Learn a dictionary by alternating sparse coding and atom updates over batches (Mairal et al. 2009).

    Parameters
    ----------
    poses : (N, 15, 3) of :func:`normalize_poses`; their mirror images are added
    progress : called with the fraction done
    """
    atoms, sparsity, batch = how.atoms, how.sparsity, how.batch
    if len(poses) < atoms:
        raise InputError(f"poses: expected at least as many as atoms ({atoms}), got {len(poses)}; add files")
    rng = np.random.default_rng(how.seed)
    both = np.concatenate([poses, mirror_poses(poses)])
    mean = both.mean(0)
    flat = (both - mean).reshape(len(both), -1).astype(np.float32)
    values, vectors = np.linalg.eigh(np.cov(flat.astype(np.float64), rowvar=False))
    order = np.argsort(values)[::-1][: how.components]
    d = flat[rng.choice(len(flat), atoms, replace=False)]
    d /= np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6)
    gram = np.zeros((atoms, atoms), np.float32)
    cross = np.zeros((atoms, flat.shape[1]), np.float32)
    for i in range(how.rounds):
        x = flat[rng.choice(len(flat), min(batch, len(flat)), replace=False)]
        c = sparse_code(x, d, sparsity)
        forget = np.float32(1.0 - 1.0 / (1.0 + 0.5 * i))
        gram, cross = forget * gram + c.T @ c / len(x), forget * cross + c.T @ x / len(x)
        d = _update_atoms(d, gram, cross, x, c, rng)
        progress((i + 1) / how.rounds)
    d = _canonical(d, sparse_code(flat[rng.permutation(len(flat))[: 4 * batch]], d, sparsity))
    dictionary = Dictionary(
        atoms=d.reshape(atoms, -1, 3).astype(np.float64),
        mean=mean,
        joints=BODY_15.joints,
        sparsity=sparsity,
        components=vectors[:, order].T.reshape(how.components, -1, 3),
        component_std=np.sqrt(np.maximum(values[order], 0.0)),
        metadata=dict(metadata or {}),
    )
    dictionary.metadata.update(quality(dictionary, poses), poses=len(poses), seed=how.seed)
    return dictionary


def _update_atoms(
    d: np.ndarray, gram: np.ndarray, cross: np.ndarray, x: np.ndarray, c: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Block coordinate descent on the atoms; unused atoms are replaced by the worst coded poses of the batch."""
    d = d.copy()
    for k in range(len(d)):
        if gram[k, k] < 1e-8:
            worst = np.argsort(np.sum((x - c @ d) ** 2, axis=1))[-64:]
            atom = x[rng.choice(worst)]
        else:
            atom = d[k] + (cross[k] - gram[k] @ d) / gram[k, k]
        d[k] = atom / max(float(np.linalg.norm(atom)), 1e-6)
    return d


def _canonical(d: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Atoms in the order of their use, signed so that the sum of their coefficients is positive."""
    signed: np.ndarray = d * np.where(c.sum(0) < 0, -1, 1)[:, None]
    return signed[np.argsort(-np.abs(c).sum(0), kind="stable")]


def quality(dictionary: Dictionary, poses: np.ndarray) -> dict[str, float]:
    """Reconstruction error (mean distance per joint, mm) and mean number of active atoms on poses (N, 15, 3)."""
    total, active = 0.0, 0
    atoms = dictionary.atoms.reshape(len(dictionary.atoms), -1).astype(np.float32)
    for first in range(0, len(poses), 8192):
        flat = (poses[first : first + 8192] - dictionary.mean).reshape(-1, atoms.shape[1]).astype(np.float32)
        c = sparse_code(flat, atoms, dictionary.sparsity, iterations=200)
        total += float(np.linalg.norm((flat - c @ atoms).reshape(len(flat), -1, 3), axis=-1).mean(-1).sum())
        active += int(np.count_nonzero(np.abs(c) > 1e-6))
    return {
        "reconstruction_error_mm": round(1000.0 * total / len(poses), 3),
        "mean_active_atoms": round(active / len(poses), 3),
    }


def save_dictionary(path: str | Path, dictionary: Dictionary) -> None:
    """Write a dictionary ``.npz`` (float32: a hundredth of a millimetre)."""
    np.savez_compressed(
        path,
        atoms=dictionary.atoms.astype(np.float32),
        mean=dictionary.mean.astype(np.float32),
        joints=np.array(dictionary.joints),
        sparsity=np.array(dictionary.sparsity),
        components=dictionary.components.astype(np.float32),
        component_std=dictionary.component_std.astype(np.float32),
        metadata=np.array(json.dumps(dictionary.metadata, sort_keys=True)),
    )
