"""What the estimator leaves out when the next image waits already."""

import cv2
import pytest

from drocap_ros.perception.estimator import PoseEstimator


@pytest.mark.parametrize("hurried", [False, True])
def test_a_subject_shown_dimly_gets_a_second_look_only_where_there_is_time(shared, monkeypatch, hurried):
    estimator = PoseEstimator(shared / "models")
    look, windows = estimator.detector.detect, []
    monkeypatch.setattr(
        estimator.detector, "detect", lambda image, w, least: windows.append(w) or look(image, w, least)
    )
    clear = cv2.imread(str(shared / "media" / "skier.jpg"))
    dim = cv2.GaussianBlur(clear // 12, (0, 0), 9)
    for i in range(3):
        assert estimator.process(clear, i * 33_000_000).track_id == 1
    windows.clear()
    observation = estimator.process(dim, 3 * 33_000_000, hurried=hurried)
    assert observation.track_id == 1
    assert len(windows) == (1 if hurried else 2)
    assert None not in windows  # near the subject, not over the whole
