"""Single-view initialization: viewpoint and pose of each frame from a pose dictionary (Zhou et al. 2016)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drocap_ros.reconstruction.paper.convex_relaxation import convex_relaxation, rotation_and_coefficients
from drocap_ros.reconstruction.paper.dictionary import Dictionary, sparse_code
from drocap_ros.reconstruction.paper.expectation import GaussianJoints, UncertainJoints
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last
from drocap_ros.reconstruction.paper.sparse_fit import SparseFit, fit_sparse
from drocap_ros.reconstruction.paper.viewpoint_search import DenseFit, fit_dense, image_scale, viewpoint_starts
from drocap_ros.reconstruction.paper.viterbi import choose_path
from drocap_ros.reconstruction.reconstruction_config import InitializerConfig


@dataclass(frozen=True)
class SingleViewFit:
    """Start of the reconstruction, in the unit of the 2D joints.

    shape : (F, P, 3) torso frame
    rotation : (F, 3, 3) torso -> camera
    scale : units per metre of the dictionary's 1.70 m person
    cost : (F,) of the chosen start
    w, information : (F, P, 2), (F, P, 3) the 2D joints as the last E-step believes them
    """

    shape: np.ndarray
    rotation: np.ndarray
    scale: float
    cost: np.ndarray
    w: np.ndarray
    information: np.ndarray

    @property
    def camera_shape(self) -> np.ndarray:
        """(F, P, 3) poses in camera axes."""
        return self.shape @ np.swapaxes(self.rotation, 1, 2)


def initialize(
    w: np.ndarray,
    information: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig | None = None,
    *,
    joints: UncertainJoints | None = None,
    scale: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> SingleViewFit:
    """Poses of all frames: multi-start search, choice over time, sparse refinement within EM over the 2D joints.

    Parameters
    ----------
    w : (F, P, 2) centred joints in units of their standard deviation, 0 where the information is 0
    information : (F, P, 3) as :func:`~drocap_ros.reconstruction.paper.reprojection.information_from` makes it
    joints : evidence in place of w and information, as mixtures or heatmaps; by default they are Gaussians
    scale : units per metre of the dictionary where it is known from earlier frames
    """
    config = config or InitializerConfig()
    joints = joints or GaussianJoints(w, information, config.outlier_share)
    w, information = joints.start()
    dense, known = multi_start(w, information, dictionary, config, scale=scale)
    path = choose_path(dense.cost, dense.camera_shape, config.switch_cost)
    frames = np.arange(len(w))
    if progress is not None:
        progress(0.6)
    rotation = dense.rotation[path, frames]
    coefficients = sparse_from_dense(dense.coefficients[path, frames], dictionary)
    for k in range(config.em_rounds + 1):
        projection = Projection(w, information)
        fit = fit_sparse(projection, rotation, coefficients, dictionary, config)
        if k < config.em_rounds:
            rotation, coefficients = fit.rotation, fit.coefficients
            w, information = joints.expect(projected_joints(projection, fit), config.keypoint_std)
    if progress is not None:
        progress(1.0)
    return SingleViewFit(fit.shape, fit.rotation, known, dense.cost[path, frames], w, information)


def projected_joints(projection: Projection, fit: SparseFit) -> np.ndarray:
    """(F, P, 2) the model's joints in the image."""
    flat = frames_last((fit.shape @ np.swapaxes(fit.rotation, 1, 2))[..., :2])
    return frames_first(flat + projection.translation(flat)[:, None])


def multi_start(
    w: np.ndarray,
    information: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig,
    *,
    scale: float | None = None,
) -> tuple[DenseFit, float]:
    """Fits with a leading axis of starts, (A, F, ...), and the body's image scale."""
    views = viewpoint_starts(w, information, config.azimuth_starts, np.deg2rad(config.elevation_start_deg))
    size = min(config.start_components, len(dictionary.components))
    if config.convex_start:
        relaxed = convex_relaxation(
            w, information[..., 0] > 0.0, dictionary, alpha=config.convex_alpha, iterations=config.convex_iterations
        )
        views = np.concatenate([rotation_and_coefficients(relaxed)[0][None], views])
    starts, frames = views.shape[:2]
    tiled_w, tiled_i = np.tile(w, (starts, 1, 1)), np.tile(information, (starts, 1, 1))
    rotation = views.reshape(-1, 3, 3)
    coefficients = np.zeros((len(rotation), 1 + size))
    half = config.start_iterations // 2
    guess = image_scale(w, information, dictionary) if scale is None else scale
    coefficients[:, 0] = guess
    if scale is None:
        # The scale is common to the sequence: fit it loosely first, then hold the frames to their median.
        loose = fit_dense(
            tiled_w, tiled_i, rotation, coefficients, dictionary, config,
            scale=guess, scale_std=3.0 * config.scale_std, iterations=half,
        )  # fmt: skip
        best = np.argmin(loose.cost.reshape(starts, frames), axis=0)
        guess = float(np.median(loose.coefficients.reshape(starts, frames, -1)[best, np.arange(frames), 0]))
        rotation, coefficients = loose.rotation, loose.coefficients
    fit = fit_dense(
        tiled_w, tiled_i, rotation, coefficients, dictionary, config,
        scale=guess, scale_std=config.scale_std, iterations=config.start_iterations - half,
    )  # fmt: skip
    return DenseFit(*(value.reshape(starts, frames, *value.shape[1:]) for value in vars(fit).values())), guess


def sparse_from_dense(coefficients: np.ndarray, dictionary: Dictionary) -> np.ndarray:
    """Sparse coefficients (F, 1 + K) of poses given by the mean and principal components (F, 1 + D)."""
    components = dictionary.components.reshape(len(dictionary.components), -1)[: coefficients.shape[1] - 1]
    atoms = dictionary.atoms.reshape(len(dictionary.atoms), -1)
    scale = np.maximum(np.abs(coefficients[:, :1]), 1e-6)
    code = sparse_code((coefficients[:, 1:] / scale) @ components, atoms, dictionary.sparsity, iterations=30)
    return np.concatenate([coefficients[:, :1], code * scale], axis=1)
