"""Level of load shedding over time."""

import pytest

from drocap_ros.ros.look_ahead import LoadShedding


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
