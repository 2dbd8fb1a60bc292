"""Multi-frame bundle adjustment: the paper's equations (2) to (4).

    min over S, R, L of  f(S, R, L) + alpha |S#|_*                                        (2)
    f = sum_t |W_t - R_t S_t|_F^2 + gamma |l(S) - L|_F^2                                  (3)
    S <- prox_{alpha / mu}(S - grad f / mu)                                               (4)

S is updated by the accelerated proximal gradient method with backtracking and restart, L by SVD, R on SO(3).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import torso_frame
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import CONVERGED, ITERATIONS
from drocap_ros.reconstruction.paper.reprojection import (
    Projection,
    frames_first,
    frames_last,
    noise_std,
    rotate,
)
from drocap_ros.reconstruction.paper.rotations import update_rotations
from drocap_ros.skeleton import BODY_15, RIGID_BONES


def nuclear_norm(s: np.ndarray) -> float:
    """Sum of the singular values of S#, for shapes (..., F)."""
    return float(_singular(s.reshape(-1, s.shape[-1]))[0].sum())


def singular_value_threshold(s: np.ndarray, tau: float) -> tuple[np.ndarray, float]:
    """Proximal step of ``tau * nuclear norm`` (Cai, Candes and Shen 2010) on shapes (..., F).

    returns : shapes (..., F) and the nuclear norm of the result
    """
    m = s.reshape(-1, s.shape[-1])
    sigma, u, wide = _singular(m)
    kept = np.maximum(sigma - tau, 0.0)
    shrink = (u * (kept / np.where(sigma > 0.0, sigma, 1.0))) @ u.T
    return (shrink @ m if wide else m @ shrink).reshape(s.shape), float(kept.sum())


def _singular(m: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Singular values and the vectors of the short side, from the Gram matrix: 3P is tens, F is hundreds."""
    wide = m.shape[0] <= m.shape[1]
    values, vectors = np.linalg.eigh(m @ m.T if wide else m.T @ m)
    return np.sqrt(np.maximum(values, 0.0)), vectors, wide


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


#: Windows of fewer frames are not adjusted: their views are too similar.
MIN_WINDOW = 4


@dataclass(frozen=True)
class AdjustmentResult:
    """Poses, cost and stop reason of one window.

    shape : (F, P, 3) S, torso frame, centred, in the unit of W
    rotation : (F, 3, 3) R, torso -> camera; its first two rows are the paper's R_t
    translation : (F, 2) in the unit of W; ``W ~ shape @ rotation[:, :2]^T + translation``
    cost : total; cost_terms : per term (reprojection, articulation, nuclear_norm)
    history : (iterations + 1,) cost after each step
    stop_reason : CONVERGED or ITERATIONS
    """

    shape: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    cost: float
    cost_terms: dict[str, float]
    iterations: int
    stop_reason: str
    history: np.ndarray = field(repr=False)

    @property
    def camera_shape(self) -> np.ndarray:
        """(F, P, 3) poses in camera axes, in the unit of W."""
        turned: np.ndarray = self.shape @ np.swapaxes(self.rotation, 1, 2)
        return turned


class Objective:
    """Equations (2) and (3) for fixed measurements, shapes (3, P, F); :meth:`update_rotation` updates R.

    rotation : (3, 3, F)
    """

    def __init__(self, projection: Projection, rotation: np.ndarray, config: BundleAdjusterConfig) -> None:
        self.projection, self.rotation, self.config = projection, rotation, config
        self.alpha = effective_alpha(projection, config)

    def value(self, s: np.ndarray) -> float:
        """F of equation (3), L at its optimum."""
        value = self.projection.value(s, self.rotation)
        if self.config.gamma > 0.0:
            value += self.config.gamma * articulation_value(s)
        return value

    def value_and_gradient(self, s: np.ndarray) -> tuple[float, np.ndarray]:
        """F of equation (3), and its gradient (3, P, F) by centred S."""
        value, gradient = self.projection.value_and_gradient(s, self.rotation)
        if self.config.gamma > 0.0:
            articulation, slope = articulation_term(s)
            value += self.config.gamma * articulation
            gradient += self.config.gamma * slope
        # S stays centred: its centroid is the translation's.
        gradient -= gradient.mean(axis=1, keepdims=True)
        return value, gradient

    def update_rotation(self, s: np.ndarray) -> None:
        """One downhill step of every rotation."""
        self.rotation = update_rotations(self.projection, s, self.rotation)

    def terms(self, s: np.ndarray) -> dict[str, float]:
        """Cost per term of equation (2), weighted."""
        return {
            "reprojection": self.projection.value(s, self.rotation),
            "articulation": self.config.gamma * articulation_value(s),
            "nuclear_norm": self.alpha * nuclear_norm(s),
        }


def effective_alpha(projection: Projection, config: BundleAdjusterConfig) -> float:
    """Weight of the nuclear norm: ``config.alpha`` for the window's length, more where the 2D joints are noisy.

    Noise of standard deviation sigma alone has singular values up to sigma (sqrt F + sqrt 2P); a threshold of that
    size removes it (the reprojection term has no factor 1/2, hence the 2).  The upper bound, a tenth of the joints'
    largest singular value, keeps the body in a window of pure noise.
    """
    w, information = frames_first(projection.w), frames_first(projection.information)
    frames, p = w.shape[:2]
    hiding = 2.0 * noise_std(w, information) * (np.sqrt(frames) + np.sqrt(2.0 * p)) if config.noise_alpha > 0.0 else 0.0
    most = 0.1 * float(np.linalg.norm(projection.w.reshape(-1, frames), 2))
    # Window length for which alpha is given: the protocol's 10 s at 24 fps.
    return float(max(config.alpha * np.sqrt(frames / 240), min(config.noise_alpha * hiding, most)))


def bundle_adjust(
    w: np.ndarray, information: np.ndarray, s0: np.ndarray, config: BundleAdjusterConfig | None = None
) -> AdjustmentResult:
    """Refine poses over one window of frames.

    w : (F, P, 2) 2D joints of BODY_15, centred about the person, in units of their standard deviation
    information : (F, P, 3) of :func:`~drocap_ros.reconstruction.paper.reprojection.information_from`, 0 where not seen
    s0 : (F, P, 3) initial poses in camera axes (x right, y down, z forward), in the unit of w
    config : weights of the terms and limits of the solver
    """
    config = config or BundleAdjusterConfig()
    if w.ndim != 3 or w.shape[2] != 2:
        raise InputError(f"w: expected shape (F, P, 2), got {w.shape}; add or move the axes")
    if s0.shape != (*w.shape[:2], 3) or not np.isfinite(s0).all():
        raise InputError(f"s0: expected finite values of shape {(*w.shape[:2], 3)}, got {s0.shape}; fill the gaps in")
    # Low rank holds in a body-fixed frame only: in the camera's or the world's, a turning body is of high rank.
    body = torso_frame(s0)
    shape = (s0 - s0.mean(axis=1, keepdims=True)) @ body
    projection = Projection(w, information)
    objective = Objective(projection, np.ascontiguousarray(np.moveaxis(body, 0, -1)), config)
    s, history, stop = minimize(objective, frames_last(shape))
    terms = objective.terms(s)
    return AdjustmentResult(
        shape=frames_first(s),
        rotation=np.ascontiguousarray(np.moveaxis(objective.rotation, -1, 0)),
        translation=projection.translation(rotate(objective.rotation, s, 2)).T,
        cost=sum(terms.values()),
        cost_terms=terms,
        iterations=len(history) - 1,
        stop_reason=stop,
        history=history,
    )


def minimize(objective: Objective, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """Accelerated proximal gradient steps (4) with backtracking; momentum restarts when the cost would rise.

    s : (3, P, F) initial shapes
    returns : shapes (3, P, F), the cost (iterations + 1,) after each step, and why the solver stopped
    """
    config, alpha = objective.config, objective.alpha
    cost = objective.value(s) + alpha * nuclear_norm(s)
    history = [cost]
    ahead, t, mu, stop = s, 1.0, 4.0, ITERATIONS
    for k in range(config.iterations):
        if k % config.rotation_every == 0:
            before = objective.value(s)
            objective.update_rotation(s)
            cost += objective.value(s) - before
        new, new_cost, mu = _proximal_step(objective, ahead, mu)
        if new_cost > cost and ahead is not s:
            t = 1.0
            new, new_cost, mu = _proximal_step(objective, s, mu)
        t_new = 0.5 * (1.0 + float(np.sqrt(1.0 + 4.0 * t * t)))
        ahead = new + ((t - 1.0) / t_new) * (new - s)
        s, t, cost = new, t_new, new_cost
        # The step grows again where the surface has become flatter.
        mu *= 0.9
        history.append(cost)
        if k >= 20 and history[-11] - cost <= config.tolerance * abs(cost):
            stop = CONVERGED
            break
    return s, np.array(history), stop


def _proximal_step(objective: Objective, at: np.ndarray, mu: float) -> tuple[np.ndarray, float, float]:
    """Equation (4) from ``at``; mu doubles until the quadratic model bounds f from above.

    returns : new shapes, their cost (2), mu
    """
    value, gradient = objective.value_and_gradient(at)
    while True:
        new, norm = singular_value_threshold(at - gradient / mu, objective.alpha / mu)
        new_value = objective.value(new)
        move = new - at
        bound = value + float(np.vdot(gradient, move)) + 0.5 * mu * float(np.vdot(move, move))
        if new_value <= bound + 1e-9 * abs(bound) or mu > 1e12:
            return new, new_value + objective.alpha * norm, mu
        mu *= 2.0
