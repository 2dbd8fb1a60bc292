"""Pose dictionary: atoms whose sparse combinations make human poses (Zhou et al. 2016, section 3)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.geometry.bones import LIMBS_PER_STATURE, limb_lengths
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import read_npz

#: The dictionary that ships with the package.
SHIPPED = Path(__file__).resolve().parents[2] / "data" / "dictionary_cmu.npz"

#: Poses are scaled to a person of this stature, m.
REFERENCE_STATURE_M = 1.70


@dataclass(frozen=True)
class Dictionary:
    """Poses are ``mean + sum_k c_k atoms_k`` with sparse c, in the torso frame, m at a stature of 1.70 m.

    atoms : (K, P, 3) B in the paper's reference; unit Frobenius norm
    mean : (P, 3), centred
    joints : P names
    sparsity : weight of the L1 norm that the atoms were learned with, m
    components, component_std : (D, P, 3) orthonormal and (D,) m; principal directions of the same poses, the
        dense few-parameter model of the viewpoint search
    metadata : origin, licence, counts, command, and the fit's quality
    """

    atoms: np.ndarray
    mean: np.ndarray
    joints: tuple[str, ...]
    sparsity: float
    components: np.ndarray
    component_std: np.ndarray
    metadata: dict[str, object] = field(default_factory=dict)

    @cached_property
    def basis(self) -> np.ndarray:
        """(1 + K, 3P): the mean pose and the atoms, flattened coordinate by coordinate."""
        poses = np.concatenate([self.mean[None], self.atoms])
        return np.ascontiguousarray(np.swapaxes(poses, 1, 2)).reshape(len(poses), -1)

    @cached_property
    def curvature(self) -> float:
        """Largest eigenvalue of ``basis basis^T``."""
        return float(np.linalg.norm(self.basis, 2) ** 2)


def normalize_poses(x: np.ndarray) -> np.ndarray:
    """MoCap poses in the dictionary's frame and scale.

    Parameters
    ----------
    x : (N, 15, 3) joints of BODY_15, any right-handed frame and unit

    Returns
    -------
    (N, 15, 3) m, torso frame, centred, limb lengths of a person of 1.70 m
    """
    scale = REFERENCE_STATURE_M * LIMBS_PER_STATURE / limb_lengths(x).sum(-1)
    shape, _ = to_torso_frame(x * scale[:, None, None])
    centred: np.ndarray = shape - shape.mean(axis=1, keepdims=True)
    return centred


def mirror_poses(s: np.ndarray) -> np.ndarray:
    """Poses (..., 15, 3) of the torso frame with left and right exchanged."""
    mirrored: np.ndarray = s[..., BODY_15.mirror, :] * np.array([1.0, -1.0, 1.0])
    return mirrored


def soft_threshold(x: np.ndarray, tau: float | np.floating | np.ndarray) -> np.ndarray:
    """Proximal step of ``tau * sum |x|``."""
    nearer: np.ndarray = np.sign(x) * np.maximum(np.abs(x) - tau, 0.0)
    return nearer


def sparse_code(poses: np.ndarray, atoms: np.ndarray, sparsity: float, *, iterations: int = 60) -> np.ndarray:
    """Coefficients (N, K) of flattened, mean-free poses (N, 3P): lasso by accelerated proximal gradient.

    Minimizes ``0.5 |poses - C atoms|^2 + sparsity |C|_1`` for atoms (K, 3P).
    """
    gram, target = atoms @ atoms.T, poses @ atoms.T
    step = 1.0 / np.linalg.norm(atoms, 2) ** 2
    c: np.ndarray = np.zeros_like(target)
    ahead, t = c, 1.0
    for _ in range(iterations):
        new = soft_threshold(ahead - step * (ahead @ gram - target), np.float32(step * sparsity))
        t_new = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        ahead = new + np.float32((t - 1.0) / t_new) * (new - c)
        c, t = new, t_new
    return c


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


_ARRAYS = ("atoms", "mean", "joints", "sparsity", "components", "component_std", "metadata")


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


def load_dictionary(path: str | Path | None = None) -> Dictionary:
    """Read a dictionary; None reads the shipped one."""
    path = SHIPPED if path is None else Path(path)
    a = read_npz(path, _ARRAYS)
    joints = tuple(str(j) for j in a["joints"])
    k, d, p = len(np.atleast_1d(a["atoms"])), len(np.atleast_1d(a["components"])), len(BODY_15)
    if joints != BODY_15.joints:
        raise InputError(f"{path}: joints: expected those of body15 in order, got {', '.join(joints[:4])}, ...")
    for name, shape in {"atoms": (k, p, 3), "mean": (p, 3), "components": (d, p, 3), "component_std": (d,)}.items():
        if a[name].shape != shape or a[name].dtype.kind != "f" or not np.isfinite(a[name]).all():
            raise InputError(f"{path}: {name}: expected finite floats of shape {shape}, got {a[name].shape}")
    try:
        metadata = json.loads(str(a["metadata"]))
        sparsity = float(a["sparsity"])
    except (ValueError, TypeError):
        raise InputError(f"{path}: expected JSON metadata and a number as sparsity; learn it again") from None
    floats = {name: a[name].astype(np.float64) for name in ("atoms", "mean", "components", "component_std")}
    return Dictionary(joints=joints, sparsity=sparsity, metadata=metadata, **floats)
