"""Time of one motion in another."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.together.timing import ShownMotion, time_offsets
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17


def person(time_s: np.ndarray) -> np.ndarray:
    return simulate_person(time_s, "mixed", 0, 1.75, BODY_17)


def shown(joints: np.ndarray, time_s: np.ndarray) -> ShownMotion:
    return ShownMotion(joints, time_s, np.ones(len(time_s), bool))


@pytest.mark.parametrize("later_s", [-2.31, 0.0, 3.777])
def test_the_offset_of_two_clocks_is_found_within_five_milliseconds(later_s: float) -> None:
    """Another camera's rate, world and errors do not matter."""
    first, second = np.arange(0.0, 12.0, 1 / 30), np.arange(0.0, 10.0, 1 / 24)
    rng = np.random.default_rng(4)
    turned = person(second + later_s + 3.0) @ exp_so3(np.array([0.0, 0.0, 2.0])).T + [5.0, 1.0, 0.0]
    noisy = turned + rng.normal(0.0, 0.01, turned.shape)
    found = time_offsets(shown(person(first + 3.0), first), shown(noisy, second))
    assert found[0].seconds == pytest.approx(later_s, abs=0.005)
    assert found[0].likeness > 0.8 > 1.5 * found[1].likeness


def test_other_motions_and_short_ones_are_not_alike() -> None:
    time = np.arange(0.0, 10.0, 1 / 30)
    other = simulate_person(time, "squats", 0, 1.75, BODY_17)
    found, same = (time_offsets(shown(person(time), time), shown(motion, time)) for motion in (other, person(time)))
    assert same[0].likeness > 0.99
    assert not found or found[0].likeness < 0.5
    short = time[:20]
    assert time_offsets(shown(person(time), time), shown(person(short), short)) == []


def test_what_stands_for_a_person_who_is_not_seen_is_no_motion() -> None:
    """In a long gap poses are interpolated: alike nothing."""
    time = np.arange(0.0, 12.0, 1 / 30)
    other = person(time + 1.5)
    other[100:260] = other[100] + (other[260] - other[100]) * np.linspace(0.0, 1.0, 160)[:, None, None]
    seen = np.ones(len(time), bool)
    seen[100:260] = False
    found = time_offsets(shown(person(time), time), ShownMotion(other, time, seen))
    assert found[0].seconds == pytest.approx(1.5, abs=0.01)
