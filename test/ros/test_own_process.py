"""Observations of pictures that are still to be published."""

import logging
import os
import signal
from concurrent.futures import Future

import cv2
import numpy as np
import pytest

from drocap_ros.errors import InputError, NodeError
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.ros.own_process import LoadShedding, LookAhead, OwnProcess
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.render.renderer import Renderer
from drocap_ros.simulation.simulated_person import simulate_person
from lab.simulation.orbit import orbit_camera

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


def levels(shedding, queued, step_s=1 / 30, backlog=0):
    return [shedding.level(i * step_s, waited, backlog) for i, waited in enumerate(queued)]


def test_level_is_zero_while_no_image_queues():
    assert levels(LoadShedding(3), [False] * 100) == [0] * 100


def test_level_rises_in_steps_to_the_maximum_while_images_queue():
    seen = levels(LoadShedding(3), [True] * 60)
    assert seen[0] == 1
    assert sorted(seen) == seen
    assert seen[-1] == 3
    assert seen.count(1) >= 5  # each level has time to take effect


def test_level_falls_by_one_per_second_without_queued_images():
    shedding = LoadShedding(3)
    levels(shedding, [True] * 60)
    seen = [shedding.level(2.0 + i / 30, False, 0) for i in range(120)]
    assert [seen[i] for i in (0, 40, 70, 110)] == [3, 2, 1, 0]


def test_one_late_image_in_two_seconds_raises_the_level_by_one_only():
    assert set(levels(LoadShedding(3), ([True] + [False] * 59) * 5)) == {0, 1}


def test_backlog_raises_the_level_at_once():
    shedding = LoadShedding(3)
    assert [shedding.level(0.0, True, 1), shedding.level(0.01, True, 4), shedding.level(0.02, True, 0)] == [2, 3, 1]


@pytest.mark.parametrize("backlog", [0, 3])
def test_maximum_of_zero_disables_shedding(backlog):
    assert set(levels(LoadShedding(0), [True] * 60, backlog=backlog)) == {0}


class Sum:
    """What its calls have added, and the process that it lives in."""

    def __init__(self, begin: int) -> None:
        self.value = begin

    def add(self, number: int) -> tuple[int, int]:
        """The sum so far; an error of a negative number."""
        if number < 0:
            raise InputError(f"number: expected 0 or more, got {number}")
        self.value += number
        return self.value, os.getpid()


def warns():
    """Whether this process shows the package's warnings."""
    return logging.getLogger("drocap_ros.test").isEnabledFor(logging.WARNING)


@pytest.fixture
def add():
    process = OwnProcess(Sum(10).add)
    yield process
    process.close()


def test_the_object_of_a_method_lives_on_in_another_process(add):
    first, second = add(1), add(number=2)
    assert (first[0], second[0]) == (11, 13)
    assert first[1] == second[1] != os.getpid()


def test_an_error_comes_back_and_the_object_goes_on(add):
    with pytest.raises(InputError, match="expected 0 or more, got -1"):
        add(-1)
    assert add(1)[0] == 11


def test_the_terminals_interruption_does_not_end_it(add):
    os.kill(add(0)[1], signal.SIGINT)
    assert add(1)[0] == 11


@pytest.mark.parametrize("level", [logging.WARNING, logging.ERROR])
def test_messages_that_this_process_leaves_out_are_left_out_there(level, monkeypatch):
    monkeypatch.setattr(logging.getLogger("drocap_ros"), "level", level)
    process = OwnProcess(warns)
    assert process() is (level == logging.WARNING)
    process.close()


def test_its_death_is_an_error_of_the_node(add):
    os.kill(add(0)[1], signal.SIGKILL)
    with pytest.raises(NodeError, match="ended with status -9"):
        add(1)


def test_pictures_are_those_of_this_process():
    focal, width, height = 200.0, 160, 120
    renderer = Renderer(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), width, height, seed=3)
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # the camera looks down from 8 m
    joints = np.random.default_rng(0).normal(scale=0.3, size=(17, 3)) + np.array([0, 0, 1.0])
    pose = joints, down, np.array([0, 0, 8.0])
    process = OwnProcess(renderer.jpeg)
    assert process(80, *pose) == renderer.jpeg(80, *pose)
    process.close()
