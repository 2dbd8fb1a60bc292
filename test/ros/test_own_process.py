"""A function in a process of its own."""

from __future__ import annotations

import logging
import os
import signal

import numpy as np
import pytest

from drocap_ros.errors import InputError, NodeError
from drocap_ros.ros.own_process import OwnProcess
from drocap_ros.simulation.render.renderer import Renderer


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
