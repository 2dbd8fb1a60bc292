"""Line search: a lower point on the line of a step, or none."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from drocap_ros.reconstruction.common.engine import search_line


class Point(NamedTuple):
    share: float
    cost: float


def along(cost, most: float = float("inf")):
    tried: list[float] = []

    def point_at(share: float) -> Point | None:
        tried.append(share)
        return Point(share, cost(share)) if share <= most else None

    return point_at, tried


def test_lower_end_of_the_step_is_taken_at_once():
    point_at, tried = along(lambda s: (s - 1.5) ** 2)
    assert search_line(2.25, -3.0, point_at) == (1.0, 0.25)
    assert tried == [1.0]


@pytest.mark.parametrize("minimum", [0.1, 0.3, 0.45])
def test_step_that_is_too_long_ends_at_the_minimum_of_a_parabola(minimum: float):
    point_at, tried = along(lambda s: (s - minimum) ** 2)
    found = search_line(minimum**2, -2 * minimum, point_at)
    assert found is not None
    assert found.share == pytest.approx(minimum)
    assert len(tried) == 2


def test_points_that_are_not_allowed_shorten_the_step():
    point_at, tried = along(lambda s: -s, most=0.02)
    found = search_line(0.0, -1.0, point_at)
    assert found is not None
    assert found.share <= 0.02
    assert len(tried) <= 4


def test_direction_without_a_lower_point_has_none():
    point_at, tried = along(lambda s: 1.0 + s)
    assert search_line(1.0, -1.0, point_at) is None
    assert len(tried) == 10


def test_cost_that_is_not_finite_shortens_the_step():
    point_at, _ = along(lambda s: float("nan") if s > 0.3 else -s)
    found = search_line(0.0, -1.0, point_at)
    assert found is not None
    assert found.share <= 0.3
