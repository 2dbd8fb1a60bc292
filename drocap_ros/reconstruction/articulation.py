"""The paper's articulation term: squared limb lengths over time form a matrix of rank 1 (equation 3)."""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, RIGID_BONES

#: (L, 2) int, ends of the limbs whose length ratios stay constant.
LIMBS = np.array([[BODY_15.index(a), BODY_15.index(b)] for a, b in RIGID_BONES])

_INCIDENCE = np.zeros((len(BODY_15), len(LIMBS)))
_INCIDENCE[LIMBS[:, 0], np.arange(len(LIMBS))] = -1.0
_INCIDENCE[LIMBS[:, 1], np.arange(len(LIMBS))] = 1.0


def squared_limb_lengths(s: np.ndarray) -> np.ndarray:
    """l(S) as (F, L) for shapes (F, 15, 3)."""
    limbs = s[:, LIMBS[:, 1]] - s[:, LIMBS[:, 0]]
    return np.sum(limbs * limbs, axis=-1)


def best_rank_one(lengths: np.ndarray) -> np.ndarray:
    """The auxiliary matrix L (F, L): the closest matrix of rank 1, by SVD (of the L x L Gram matrix)."""
    v = np.linalg.eigh(lengths.T @ lengths)[1][:, -1]
    return (lengths @ v)[:, None] * v


def articulation_term(s: np.ndarray, rank_one: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Value and gradient (F, 15, 3) of ``|l(S) - L|_F^2``.

    With ``rank_one`` None, L is the best one for S; as L minimizes the term, the gradient is the same with L held.
    """
    limbs = s[:, LIMBS[:, 1]] - s[:, LIMBS[:, 0]]
    lengths = np.sum(limbs * limbs, axis=-1)
    excess = lengths - (best_rank_one(lengths) if rank_one is None else rank_one)
    return float(np.sum(excess * excess)), _INCIDENCE @ (4.0 * excess[..., None] * limbs)
