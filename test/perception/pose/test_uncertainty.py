from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.perception.pose.body_pose import CALIBRATIONS, calibrate
from drocap_ros.perception.pose.pose_model import NetworkKeypoints


def keypoints(score, spread=0.0, second_peak=0.0, box=200.0) -> NetworkKeypoints:
    score = np.atleast_1d(np.asarray(score, np.float32))
    n = len(score)
    second = np.full(n, second_peak, np.float32)
    spreads = np.tile(np.float32([spread, 0, spread]), (n, 1))
    return NetworkKeypoints("coco17", np.zeros((n, 2), np.float32), score, spreads, second, box)


@pytest.mark.parametrize("layout", [*CALIBRATIONS, "yolo-pose"])
def test_higher_peak_has_more_confidence_and_less_covariance(layout):
    covariance, confidence = calibrate(keypoints(np.linspace(0, 1, 30)), layout)
    assert (np.diff(confidence) > 0).all()
    assert (np.diff(covariance[:, 0]) <= 0.2).all()
    assert covariance[0, 0] > 4 * covariance[-1, 0]
    assert (covariance[:, 0] > 0.09).all()
    assert ((confidence > 0) & (confidence < 1)).all()


def test_second_peak_and_spread_lower_the_confidence():
    plain = calibrate(keypoints(0.6), "heatmap")[1][0]
    assert calibrate(keypoints(0.6, second_peak=0.5), "heatmap")[1][0] < plain - 0.2
    assert calibrate(keypoints(0.6, spread=400.0), "heatmap")[1][0] < plain
    assert (
        calibrate(keypoints(0.6, spread=400.0), "heatmap")[0][0, 0] > calibrate(keypoints(0.6), "heatmap")[0][0, 0] + 90
    )


def test_standard_deviation_scales_with_the_box():
    small = calibrate(keypoints(0.9, box=100.0), "heatmap")[0][0, 0] - 0.09
    large = calibrate(keypoints(0.9, box=300.0), "heatmap")[0][0, 0] - 0.09
    assert large == pytest.approx(9 * small, rel=1e-6)


def test_a_model_of_its_own_accuracy_has_scaled_covariances_and_the_same_confidence():
    usual, half = (calibrate(keypoints(0.9, spread=400.0), "simcc", scale) for scale in (1.0, 0.5))
    assert half[0][0, 0] - 0.09 == pytest.approx(0.25 * (usual[0][0, 0] - 0.09), rel=1e-6)  # 0.3 px is the least
    assert half[1] == usual[1]


def test_extreme_scores_stay_in_range():
    covariance, confidence = calibrate(keypoints([-5.0, 0.0, 1.3, 1e6]), "heatmap")
    assert np.isfinite(covariance).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()
