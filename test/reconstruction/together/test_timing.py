"""Time of one motion in another."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.together.timing import time_offsets
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17


def person(time_s: np.ndarray) -> np.ndarray:
    return simulate_person(time_s, "mixed", 0, 1.75, BODY_17)


@pytest.mark.parametrize("later_s", [-2.31, 0.0, 3.777])
def test_the_offset_of_two_clocks_is_found_within_five_milliseconds(later_s: float) -> None:
    """Another camera's rate, world and errors do not matter."""
    first, second = np.arange(0.0, 12.0, 1 / 30), np.arange(0.0, 10.0, 1 / 24)
    rng = np.random.default_rng(4)
    turned = person(second + later_s + 3.0) @ exp_so3(np.array([0.0, 0.0, 2.0])).T + [5.0, 1.0, 0.0]
    noisy = turned + rng.normal(0.0, 0.01, turned.shape)
    found = time_offsets(person(first + 3.0), noisy, (first, second))
    assert found[0].seconds == pytest.approx(later_s, abs=0.005)
    assert found[0].likeness > 0.8 > 1.5 * found[0].next_best


def test_other_motions_and_short_ones_are_not_alike() -> None:
    time = np.arange(0.0, 10.0, 1 / 30)
    other = simulate_person(time, "squats", 0, 1.75, BODY_17)
    found, same = (time_offsets(person(time), motion, (time, time)) for motion in (other, person(time)))
    assert same[0].likeness > 0.99
    assert not found or found[0].likeness < 0.5
    short = time[:20]
    assert time_offsets(person(time), person(short), (time, short)) == []
