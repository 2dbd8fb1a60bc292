"""The paper's articulation term: squared limb lengths over time form a matrix of rank 1 (equation 3).

Shapes are (3, 15, F), frames last.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, RIGID_BONES

#: (L, 15) differences of joints: row l subtracts the upper end of limb l from its lower end.
LIMBS = np.zeros((len(RIGID_BONES), len(BODY_15)))
for _row, (_upper, _lower) in enumerate(RIGID_BONES):
    LIMBS[_row, BODY_15.index(_upper)], LIMBS[_row, BODY_15.index(_lower)] = -1.0, 1.0


def best_rank_one(lengths: np.ndarray) -> np.ndarray:
    """The auxiliary matrix L (L, F): the closest matrix of rank 1, by SVD (of the L x L Gram matrix)."""
    u = np.linalg.eigh(lengths @ lengths.T)[1][:, -1]
    closest: np.ndarray = u[:, None] * (u @ lengths)
    return closest


def articulation_value(s: np.ndarray) -> float:
    """``|l(S) - L|_F^2`` with L at its optimum: l(S) without its largest singular value."""
    limbs = LIMBS @ s
    lengths = np.einsum("ilf,ilf->lf", limbs, limbs)
    excess = lengths - best_rank_one(lengths)
    return float(np.vdot(excess, excess))


def articulation_term(s: np.ndarray) -> tuple[float, np.ndarray]:
    """Value and gradient (3, 15, F) of ``|l(S) - L|_F^2``; as L minimizes the term, it adds nothing to the gradient."""
    limbs = LIMBS @ s
    lengths = np.einsum("ilf,ilf->lf", limbs, limbs)
    excess = lengths - best_rank_one(lengths)
    limbs *= 4.0 * excess
    return float(np.vdot(excess, excess)), LIMBS.T @ limbs
