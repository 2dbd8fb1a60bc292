"""Observations of pictures that are still to be published."""

from __future__ import annotations

from concurrent.futures import Future

import cv2
import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.ros.own_process import LookAhead
from drocap_ros.simulation.orbit_camera import orbit_camera, pinhole_matrix
from drocap_ros.simulation.render.renderer import Renderer
from drocap_ros.simulation.simulated_person import simulate_person

STEP_NS = 66_666_667  # of a camera with 15 images a second


@pytest.fixture(scope="module")
def jpegs():
    t = 1.3 + np.arange(6) * STEP_NS * 1e-9
    joints = simulate_person(t, "mixed", 0)
    rotation, position = orbit_camera(t, joints[:, 0], 6.0, 2.5, 25.0, 0.0)
    renderer = Renderer(pinhole_matrix(640, 360, 60), 640, 360, 0)
    return [renderer.jpeg(90, *view) for view in zip(joints, rotation, position, strict=True)]


@pytest.fixture
def ahead():
    process = LookAhead(PoseEstimatorConfig(models_dir="simulation", provider="cpu"))
    yield process
    process.close()


def rendered(jpeg):
    """The future of a picture that is there."""
    future = Future()
    future.set_result(jpeg)
    return future


def test_observations_are_those_of_an_estimator_of_this_process(jpegs, ahead):
    config = PoseEstimatorConfig(models_dir="simulation", provider="cpu")
    estimator, box = PoseEstimator(models_folder("simulation"), config), np.array([200.0, 60, 440, 330])
    for i, jpeg in enumerate(jpegs):
        ahead.begin(i * STEP_NS, rendered(jpeg), box if i == 2 else None)
    seen = 0
    for i, jpeg in enumerate(jpegs):
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        here, there = estimator.process(image, i * STEP_NS, box if i == 2 else None), ahead.take(i * STEP_NS)
        np.testing.assert_array_equal(here.keypoints, there.keypoints)
        np.testing.assert_array_equal(here.roi, there.roi)
        np.testing.assert_array_equal(here.background.point, there.background.point)
        seen += there.has_subject
    assert seen > len(jpegs) / 2


def test_pictures_that_were_never_published_are_forgotten(jpegs, ahead):
    for stamp_ns in (10, 20, 30):
        ahead.begin(stamp_ns, rendered(jpegs[0]), None)
    assert ahead.take(5) is None  # exposed before the first that was begun
    assert ahead.take(20).stamp_ns == 20
    assert not ahead.knows(20)
    assert ahead.knows(30)


def test_a_picture_that_does_not_decode_is_an_error_of_its_own(jpegs, ahead):
    ahead.begin(10, rendered(b"no picture"), None)
    ahead.begin(20, rendered(jpegs[0]), None)
    with pytest.raises(InputError, match="expected JPEG"):
        ahead.take(10)
    assert ahead.take(20).stamp_ns == 20
