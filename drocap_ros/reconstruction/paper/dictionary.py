"""Pose dictionary: atoms whose sparse combinations make human poses (Zhou et al. 2016, section 3)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import LIMBS_PER_STATURE, limb_lengths, to_torso_frame
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

    x : (N, 15, 3) joints of BODY_15, any right-handed frame and unit
    returns : (N, 15, 3) m, torso frame, centred, limb lengths of a person of 1.70 m
    """
    scale = REFERENCE_STATURE_M * LIMBS_PER_STATURE / limb_lengths(x).sum(-1)
    shape, _ = to_torso_frame(x * scale[:, None, None])
    centred: np.ndarray = shape - shape.mean(axis=1, keepdims=True)
    return centred


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


_ARRAYS = ("atoms", "mean", "joints", "sparsity", "components", "component_std", "metadata")


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
