"""Covariance and confidence of keypoints, calibrated on labelled images.

Inputs are the height of the network's peak, the height of its second peak and the spread of its distribution.  The
covariance describes keypoints on the correct limb against human labels: standardized errors have unit spread.  The
confidence is the share of keypoints within 10 % of the box of the label; the others are gross errors, which no Gaussian
describes.

``benchmarks/perception.py --fit`` computes the constants from the 12 limb joints on the labelled images, unchanged and
degraded (small, blurred, dark, hazy, partly covered, shifted box).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.pose.pose_model import NetworkKeypoints


@dataclass(frozen=True)
class Calibration:
    """Calibration of one kind of output.

    scores, sigmas : knots of the standard deviation over the peak's height, in shares of the box's longer side
    spread_share : share of the measured spread (px^2) that adds to the variance
    intercept, per_score, per_second_peak, per_spread : logistic regression of the confidence on the peak's height,
        the second peak's height and ten times the spread's standard deviation over the box
    """

    scores: tuple[float, ...]
    sigmas: tuple[float, ...]
    spread_share: float
    intercept: float
    per_score: float
    per_second_peak: float = 0.0
    per_spread: float = 0.0


_KNOTS = (0.0, 0.3, 0.5, 0.65, 0.75, 0.85, 0.95)

#: Fitted with PP-TinyPose and MoveNet Lightning.  SimCC and one-stage models use the most similar kind's constants: the
#: fit had no weights of theirs.
CALIBRATIONS: dict[str, Calibration] = {
    "heatmap": Calibration(
        _KNOTS, (0.0444, 0.0316, 0.0282, 0.0282, 0.0282, 0.0134, 0.0099), 0.25, -1.543, 6.847, -4.887, -0.997
    ),
    "simcc": Calibration(_KNOTS, (0.0444, 0.0316, 0.0282, 0.0282, 0.0282, 0.0134, 0.0099), 0.25, -1.543, 6.847),
    "movenet": Calibration(_KNOTS, (0.0494, 0.0244, 0.0221, 0.0201, 0.0173, 0.0169, 0.0129), 0.0, -0.969, 7.309),
}
_ONE_STAGE = CALIBRATIONS["movenet"]

#: Least standard deviation, px: the pixel grid.
_FLOOR_PX = 0.3


def calibrate(keypoints: NetworkKeypoints, layout: str, sigma_scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and confidence of one person's keypoints.

    keypoints : P joints
    layout : of the pose model's outputs
    sigma_scale : standard deviations of this model over those of the models of the fit

    Returns
    -------
    covariance (P, 3) px^2, xx xy yy; confidence (P,) in [0, 1]
    """
    c = CALIBRATIONS.get(layout, _ONE_STAGE)
    score = keypoints.score.astype(float)
    spread = np.nan_to_num(keypoints.spread.astype(float))
    variance = (np.interp(score, c.scores, c.sigmas) * keypoints.box_size) ** 2
    covariance = sigma_scale**2 * (c.spread_share * spread + variance[:, None] * np.array([1.0, 0.0, 1.0]))
    covariance += _FLOOR_PX**2 * np.array([1.0, 0.0, 1.0])
    second_peak = keypoints.second.astype(float)
    width = np.sqrt((spread[:, 0] + spread[:, 2]) / 2) / max(keypoints.box_size, 1.0)
    logit = c.intercept + c.per_score * score + c.per_second_peak * second_peak + c.per_spread * 10.0 * width
    return covariance, 1.0 / (1.0 + np.exp(-np.clip(logit, -30, 30)))
