"""The paper's articulation term: squared limb lengths over time form a matrix of rank 1 (equation 3).

Shapes are (3, 15, F), frames last.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, RIGID_BONES

#: (L, 15) differences of joints: row l takes the upper end of limb l from its lower end.
LIMBS = np.zeros((len(RIGID_BONES), len(BODY_15)))
for _row, (_upper, _lower) in enumerate(RIGID_BONES):
    LIMBS[_row, BODY_15.index(_upper)], LIMBS[_row, BODY_15.index(_lower)] = -1.0, 1.0


def squared_limb_lengths(s: np.ndarray) -> np.ndarray:
    """l(S), (L, F), for shapes (3, 15, F)."""
    limbs = LIMBS @ s
    return np.einsum("ilf,ilf->lf", limbs, limbs)


def best_rank_one(lengths: np.ndarray) -> np.ndarray:
    """The auxiliary matrix L (L, F): the closest matrix of rank 1, by SVD (of the L x L Gram matrix)."""
    u = np.linalg.eigh(lengths @ lengths.T)[1][:, -1]
    return u[:, None] * (u @ lengths)


def articulation_value(s: np.ndarray) -> float:
    """``|l(S) - L|_F^2`` with L at its optimum: what the largest singular value leaves of l(S)."""
    lengths = squared_limb_lengths(s)
    excess = lengths - best_rank_one(lengths)
    return float(np.vdot(excess, excess))


def articulation_term(s: np.ndarray, rank_one: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Value and gradient (3, 15, F) of ``|l(S) - L|_F^2``.

    With ``rank_one`` None, L is the best one for S; as L minimizes the term, the gradient is the same with L held.
    """
    limbs = LIMBS @ s
    lengths = np.einsum("ilf,ilf->lf", limbs, limbs)
    excess = lengths - (best_rank_one(lengths) if rank_one is None else rank_one)
    limbs *= 4.0 * excess
    return float(np.vdot(excess, excess)), LIMBS.T @ limbs
