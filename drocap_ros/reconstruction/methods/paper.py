"""The paper's methods, window by window: ``--method paper``, its ablation, ``initial``, and the baseline ``mf-nnm``.

Inside, poses have the solvers' unit, the standard deviation of the centred 2D joints
(:mod:`drocap_ros.reconstruction.paper.normalize`).
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from drocap_ros.reconstruction.common.poses import TOO_SHORT, ImagePoses, MethodInput, Report
from drocap_ros.reconstruction.common.windows import over_windows, windows
from drocap_ros.reconstruction.paper.bundle_adjustment import MIN_WINDOW, bundle_adjust
from drocap_ros.reconstruction.paper.dictionary import Dictionary, load_dictionary
from drocap_ros.reconstruction.paper.mf_nnm import factorize
from drocap_ros.reconstruction.paper.normalize import normalize_tracks
from drocap_ros.reconstruction.paper.reprojection import Projection, information_from
from drocap_ros.reconstruction.paper.single_view import initialize


def run(data: MethodInput) -> ImagePoses:
    """Single-view initializer, then equations (2) to (4)."""
    clock = time.perf_counter()
    dictionary = _dictionary(data)
    joints, inlier = _initial_poses(data, dictionary)
    initialized = time.perf_counter()

    def solve(rows: slice) -> ImagePoses:
        n = normalize_tracks(data.keypoints[rows])
        initial = joints[rows] / n.scale_px
        if len(initial) < MIN_WINDOW:
            poses, report = Projection(n.w, n.information).placed(initial), Report(0, TOO_SHORT)
        else:
            information = n.information * inlier[rows][..., None]
            result = bundle_adjust(n.w, information, initial, data.adjuster)
            poses = Projection(n.w, information).placed(result.camera_shape)
            report = Report(result.iterations, result.stop_reason, result.cost_terms)
        return ImagePoses.uncentred(n.in_px(poses), report=report)

    return _timed(over_windows(data, solve), initialized - clock, time.perf_counter() - initialized, dictionary)


def run_without_articulation(data: MethodInput) -> ImagePoses:
    """The ablation gamma = 0."""
    return run(replace(data, adjuster=replace(data.adjuster, gamma=0.0)))


def run_initializer(data: MethodInput) -> ImagePoses:
    """The single-view initializer alone, block by block."""
    clock, keypoints = time.perf_counter(), data.keypoints
    dictionary = _dictionary(data)
    joints, inlier = _initial_poses(data, dictionary)
    weights = inlier if keypoints.confidence is None else inlier * np.nan_to_num(keypoints.confidence)
    information = information_from(keypoints.xy, weights, keypoints.covariance)
    poses = ImagePoses.centred(Projection(keypoints.xy, information).placed(joints))
    return _timed(poses, time.perf_counter() - clock, 0.0, dictionary)


def run_factorization(data: MethodInput) -> ImagePoses:
    """The baseline: matrix factorization and nuclear norm minimization."""
    clock = time.perf_counter()
    dictionary = _dictionary(data)

    def solve(rows: slice) -> ImagePoses:
        n = normalize_tracks(data.keypoints[rows])
        poses, report = factorize(n.w, n.information, dictionary, data.adjuster)
        return ImagePoses.uncentred(n.in_px(Projection(n.w, n.information).placed(poses)), report=report)

    return _timed(over_windows(data, solve), 0.0, time.perf_counter() - clock, dictionary)


def _dictionary(data: MethodInput) -> Dictionary:
    return load_dictionary(data.initializer.dictionary or None)


def _timed(poses: ImagePoses, initial_s: float, adjusting_s: float, dictionary: Dictionary) -> ImagePoses:
    seconds, origin = {"initial": initial_s, "ba": adjusting_s}, {"dictionary": dictionary.metadata}
    return replace(poses, report=replace(poses.report, seconds=seconds, origin=origin))


def _initial_poses(data: MethodInput, dictionary: Dictionary) -> tuple[np.ndarray, np.ndarray]:
    """Single-view initializer over blocks of frames.

    returns : poses (F, 15, 3) px in camera axes, centred; inlier (F, 15) in [0, 1]: probability of the last E-step
        that the 2D joint is no outlier
    """
    keypoints, config = data.keypoints, data.initializer
    out = np.zeros((*keypoints.xy.shape[:2], 3))
    inlier = np.zeros(keypoints.xy.shape[:2])
    for rows in windows(len(keypoints), config.block_frames, 0):
        n = normalize_tracks(keypoints[rows])
        shape, information = initialize(n.w, n.information, dictionary, config)
        before = n.information[..., 0] + n.information[..., 2]
        after = information[..., 0] + information[..., 2]
        inlier[rows] = after / np.where(before > 0.0, before, 1.0)
        out[rows] = (shape - shape.mean(axis=1, keepdims=True)) * n.scale_px
        data.progress("initial", rows.stop / len(keypoints))
    return out, inlier
