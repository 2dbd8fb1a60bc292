"""How much of a hurry the estimator is in."""

import pytest

from drocap_ros.perception.load_shedding import Hurry


def levels(hurry, waits, step_s=1 / 30, behind=0):
    return [hurry.level(i * step_s, waited, behind) for i, waited in enumerate(waits)]


def test_nobody_hurries_while_no_picture_waits():
    assert levels(Hurry(3), [False] * 100) == [0] * 100


def test_it_rises_step_by_step_while_pictures_wait_and_no_further():
    seen = levels(Hurry(3), [True] * 60)
    assert seen[0] == 1
    assert sorted(seen) == seen
    assert seen[-1] == 3
    assert seen.count(1) >= 5  # each step is given time to show what it does


def test_it_falls_by_one_a_second_when_none_waits_any_more():
    hurry = Hurry(3)
    levels(hurry, [True] * 60)
    seen = [hurry.level(2.0 + i / 30, False, 0) for i in range(120)]
    assert [seen[i] for i in (0, 40, 70, 110)] == [3, 2, 1, 0]


def test_one_late_picture_in_a_while_costs_no_more_than_one_step():
    assert set(levels(Hurry(3), ([True] + [False] * 59) * 5)) == {0, 1}


def test_pictures_that_lie_there_still_are_worked_off_at_once():
    hurry = Hurry(3)
    assert [hurry.level(0.0, True, 1), hurry.level(0.01, True, 4), hurry.level(0.02, True, 0)] == [2, 3, 1]


@pytest.mark.parametrize("behind", [0, 3])
def test_who_may_not_hurry_never_does(behind):
    assert set(levels(Hurry(0), [True] * 60, behind=behind)) == {0}
