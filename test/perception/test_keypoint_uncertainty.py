from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.perception.pose.keypoints import Keypoints
from drocap_ros.perception.uncertainty import CALIBRATIONS, calibrate


def keypoints(score, spread=0.0, rival=0.0, box=200.0) -> Keypoints:
    score = np.atleast_1d(np.asarray(score, np.float32))
    n = len(score)
    candidates = np.full((n, 3, 3), np.nan, np.float32)
    candidates[:, 1, 2] = rival
    spreads = np.tile(np.float32([spread, 0, spread]), (n, 1))
    return Keypoints("coco17", np.zeros((n, 2), np.float32), score, spreads, candidates, box)


@pytest.mark.parametrize("layout", [*CALIBRATIONS, "yolo-pose"])
def test_a_higher_peak_is_surer_and_never_perfect(layout):
    covariance, confidence = calibrate(keypoints(np.linspace(0, 1, 30)), layout)
    assert (np.diff(confidence) > 0).all()
    assert (np.diff(covariance[:, 0]) <= 0.2).all()
    assert covariance[0, 0] > 4 * covariance[-1, 0]
    assert (covariance[:, 0] > 0.09).all()
    assert ((confidence > 0) & (confidence < 1)).all()


def test_a_rival_peak_and_a_wide_one_lower_the_confidence():
    plain = calibrate(keypoints(0.6), "heatmap")[1][0]
    assert calibrate(keypoints(0.6, rival=0.5), "heatmap")[1][0] < plain - 0.2
    assert calibrate(keypoints(0.6, spread=400.0), "heatmap")[1][0] < plain
    assert (
        calibrate(keypoints(0.6, spread=400.0), "heatmap")[0][0, 0] > calibrate(keypoints(0.6), "heatmap")[0][0, 0] + 90
    )


def test_the_standard_deviation_follows_the_size_of_the_person():
    small = calibrate(keypoints(0.9, box=100.0), "heatmap")[0][0, 0] - 0.09
    large = calibrate(keypoints(0.9, box=300.0), "heatmap")[0][0, 0] - 0.09
    assert large == pytest.approx(9 * small, rel=1e-6)


def test_extreme_scores_stay_in_range():
    covariance, confidence = calibrate(keypoints([-5.0, 0.0, 1.3, 1e6]), "heatmap")
    assert np.isfinite(covariance).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()
