"""Single-view initializer: viewpoint and pose of each frame from a pose dictionary (Zhou et al. 2016)."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary, sparse_code
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last
from drocap_ros.reconstruction.paper.viewpoint_search import SparseFit, fit_sparse, search_viewpoints


def initialize(
    w: np.ndarray, information: np.ndarray, dictionary: Dictionary, config: InitializerConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all frames: viewpoint search, choice over time, sparse refinement within EM over the 2D joints.

    w : (F, P, 2) centred joints in units of their standard deviation, 0 where the information is 0
    information : (F, P, 3) of :func:`~drocap_ros.reconstruction.paper.reprojection.information_from`
    returns : poses (F, P, 3) in camera axes and the unit of the joints; information (F, P, 3) after the last E-step
    """
    measured = information
    dense = search_viewpoints(w, information, dictionary, config)
    path = choose_path(dense.cost, dense.camera_shape, config.switch_cost)
    frames = np.arange(len(w))
    rotation = dense.rotation[path, frames]
    coefficients = sparse_from_dense(dense.coefficients[path, frames], dictionary)
    for k in range(config.em_rounds + 1):
        projection = Projection(w, information)
        fit = fit_sparse(projection, rotation, coefficients, dictionary, config)
        if k < config.em_rounds:
            rotation, coefficients = fit.rotation, fit.coefficients
            information = expected_information(
                w, measured, projected_joints(projection, fit), config.keypoint_std, outlier_share=config.outlier_share
            )
    return fit.camera_shape, information


def projected_joints(projection: Projection, fit: SparseFit) -> np.ndarray:
    """(F, P, 2) the model's joints in the image."""
    flat = frames_last(fit.camera_shape[..., :2])
    return frames_first(flat + projection.translation(flat)[:, None])


def sparse_from_dense(coefficients: np.ndarray, dictionary: Dictionary) -> np.ndarray:
    """Sparse coefficients (F, 1 + K) of poses given by the mean and principal components (F, 1 + D)."""
    components = dictionary.components.reshape(len(dictionary.components), -1)[: coefficients.shape[1] - 1]
    atoms = dictionary.atoms.reshape(len(dictionary.atoms), -1)
    scale = np.maximum(np.abs(coefficients[:, :1]), 1e-6)
    code = sparse_code((coefficients[:, 1:] / scale) @ components, atoms, dictionary.sparsity, iterations=30)
    return np.concatenate([coefficients[:, :1], code * scale], axis=1)


def choose_path(cost: np.ndarray, poses: np.ndarray, switch_cost: float) -> np.ndarray:
    """Hypothesis (F,) int of each frame with the least total cost over the sequence (Viterbi 1967).

    cost : (H, F) of each hypothesis alone
    poses : (H, F, P, 3) camera axes
    switch_cost : weight of the squared distance between the poses of neighbouring frames
    """
    flat = np.swapaxes(poses.reshape(*cost.shape, -1), 0, 1)
    square = np.sum(flat * flat, axis=-1)
    cross = flat[:-1] @ np.swapaxes(flat[1:], 1, 2)
    change = switch_cost * np.maximum(square[:-1, :, None] + square[1:, None, :] - 2.0 * cross, 0.0)
    total, frames = cost[:, 0], cost.shape[1]
    came_from = np.zeros((frames, len(cost)), dtype=np.int64)
    for t in range(1, frames):
        sums = total[:, None] + change[t - 1]
        came_from[t] = np.argmin(sums, axis=0)
        total = np.min(sums, axis=0) + cost[:, t]
    path = np.empty(frames, dtype=np.int64)
    path[-1] = int(np.argmin(total))
    for t in range(frames - 1, 0, -1):
        path[t - 1] = came_from[t, path[t]]
    return path


def expected_information(
    w: np.ndarray, information: np.ndarray, projected: np.ndarray, std: float, *, outlier_share: float = 0.05
) -> np.ndarray:
    """Information (F, P, 3) times the probability that the joint is no outlier, given the model's joints.

    The E-step of Zhou et al. 2016, section 4: one Gaussian per joint and a share of gross outliers.

    w, information : (F, P, 2), (F, P, 3), 0 where not seen
    projected : (F, P, 2) the model's joints in the image
    std : standard deviation of an ordinary joint about the model
    outlier_share : prior probability of an outlier
    """
    fit = _log_density(projected - w, information / std**2)
    # Area over which gross outliers are uniform, squared 2D std: about that of the person's box.
    inlier = _share(fit + np.log1p(-outlier_share), np.log(outlier_share / 12.0))
    expected: np.ndarray = information * inlier[..., None]
    return expected


def _log_density(gap: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Log of the Gaussian density of gaps (..., 2) under information (..., 3)."""
    xx, xy, yy = np.moveaxis(information, -1, 0)
    det = np.maximum(xx * yy - xy * xy, 1e-300)
    x, y = gap[..., 0], gap[..., 1]
    density: np.ndarray = 0.5 * np.log(det) - np.log(2.0 * np.pi) - 0.5 * (xx * x * x + 2.0 * xy * x * y + yy * y * y)
    return density


def _share(log_a: np.ndarray, log_b: float) -> np.ndarray:
    """``a / (a + b)`` from logarithms."""
    return 1.0 / (1.0 + np.exp(np.clip(log_b - log_a, -700.0, 700.0)))
