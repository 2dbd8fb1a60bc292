"""The standard deviations of a pose network's keypoints, measured on rendered persons that it was not trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.models.spec import read_spec
from drocap_ros.perception.pose.body_pose import calibrate
from drocap_ros.perception.pose.pose_model import PoseModel
from lab.training.rendered_samples import POSE_PADDING, POSE_SIZE, make_world, pose_sample

_SAMPLES, _SEED = 300, 987_654_321
_SURE, _GROSS = 0.5, 3.0  # least confidence, most standard deviations: no Gaussian describes gross errors


def sigma_scale(path: Path) -> float:
    """Standard deviations of the network ``path`` over the calibrated ones, 0.1 to 10, on images without degradation.

    With this factor the usual errors over their standard deviations have a spread of 1.
    """
    network = OnnxModel(path)
    spec = read_spec(network)
    model = PoseModel(network, spec)
    rng = np.random.default_rng(_SEED)
    world = make_world(rng, scenes=6, takes=1)
    half = np.array(POSE_SIZE) / POSE_PADDING / 2
    whole = np.concatenate([np.array(POSE_SIZE) / 2 - half, np.array(POSE_SIZE) / 2 + half])
    standard = []
    for _ in range(_SAMPLES):
        sample = pose_sample(world, rng, degraded=False)
        found = model.estimate(sample.image, whole)._replace(box_size=sample.box_px)
        covariance, confidence = calibrate(found, spec.layout)
        error = (found.xy - sample.joints) / np.sqrt(covariance[:, [0, 2]])
        standard.append(error[sample.seen & (confidence > _SURE)])
    errors = np.abs(np.concatenate(standard))
    usual = errors[errors < _GROSS]
    return float(np.clip(np.sqrt(np.mean(usual**2)), 0.1, 10.0)) if len(usual) else 1.0
