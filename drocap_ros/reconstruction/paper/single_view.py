"""Single-view initializer: viewpoint and pose of each frame from a pose dictionary (Zhou et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary, sparse_code
from drocap_ros.reconstruction.paper.expectation import expected_information
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last
from drocap_ros.reconstruction.paper.sparse_fit import SparseFit, fit_sparse
from drocap_ros.reconstruction.paper.viewpoint_search import search_viewpoints
from drocap_ros.reconstruction.paper.viterbi import choose_path


@dataclass(frozen=True)
class SingleViewFit:
    """Initial poses, in the unit of the 2D joints.

    shape : (F, P, 3) torso frame
    rotation : (F, 3, 3) torso -> camera
    information : (F, P, 3) of the 2D joints after the last E-step
    """

    shape: np.ndarray
    rotation: np.ndarray
    information: np.ndarray

    @property
    def camera_shape(self) -> np.ndarray:
        """(F, P, 3) poses in camera axes."""
        turned: np.ndarray = self.shape @ np.swapaxes(self.rotation, 1, 2)
        return turned


def initialize(
    w: np.ndarray, information: np.ndarray, dictionary: Dictionary, config: InitializerConfig
) -> SingleViewFit:
    """Poses of all frames: viewpoint search, choice over time, sparse refinement within EM over the 2D joints.

    Parameters
    ----------
    w : (F, P, 2) centred joints in units of their standard deviation, 0 where the information is 0
    information : (F, P, 3) of :func:`~drocap_ros.reconstruction.paper.reprojection.information_from`
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
    return SingleViewFit(fit.shape, fit.rotation, information)


def projected_joints(projection: Projection, fit: SparseFit) -> np.ndarray:
    """(F, P, 2) the model's joints in the image."""
    flat = frames_last((fit.shape @ np.swapaxes(fit.rotation, 1, 2))[..., :2])
    return frames_first(flat + projection.translation(flat)[:, None])


def sparse_from_dense(coefficients: np.ndarray, dictionary: Dictionary) -> np.ndarray:
    """Sparse coefficients (F, 1 + K) of poses given by the mean and principal components (F, 1 + D)."""
    components = dictionary.components.reshape(len(dictionary.components), -1)[: coefficients.shape[1] - 1]
    atoms = dictionary.atoms.reshape(len(dictionary.atoms), -1)
    scale = np.maximum(np.abs(coefficients[:, :1]), 1e-6)
    code = sparse_code((coefficients[:, 1:] / scale) @ components, atoms, dictionary.sparsity, iterations=30)
    return np.concatenate([coefficients[:, :1], code * scale], axis=1)
