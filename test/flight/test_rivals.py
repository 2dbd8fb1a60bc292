"""A second publisher of the keypoints, and a second bridge, by what arrives."""

import itertools

import pytest

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.command_checks import Rivals


def code(rivals, now_s):
    found = rivals.condition(now_s)
    return None if found is None else found.code


def played(*streams, until_s=4.0):
    """Rivals after the messages (rate Hz, first number, since s) of some publishers, and when they were found."""
    rivals, first_s = Rivals("/drocap"), None
    arrivals = sorted(
        (since + k / rate, first + k) for rate, first, since in streams for k in range(int((until_s - since) * rate))
    )
    for at, number in arrivals:
        rivals.take_pose2d(number, at)
        if first_s is None and rivals.condition(at) is not None:
            first_s = at
    return rivals, first_s


def test_one_publisher_is_alone_also_when_messages_are_lost_or_it_is_restarted():
    assert played((30, 1, 0.0))[1] is None
    rivals = Rivals("/drocap")
    numbers = [*range(1, 50), *range(70, 100), *range(1, 60)]  # a gap, a restart
    for at, number in enumerate(numbers):
        rivals.take_pose2d(number, at / 30)
        assert rivals.condition(at / 30) is None


@pytest.mark.parametrize(
    ("rate", "first", "bound_s"), [(30, 1, 0.15), (12, 1000, 0.3), (30, 31, 0.15), (2, 1, 1.1), (1, 500, 2.0)]
)
def test_a_second_publisher_is_found_within_two_seconds(rate, first, bound_s):
    rivals, found_s = played((30, 1, 0.0), (rate, first, 1.0))
    assert 0 <= found_s - 1.0 <= bound_s
    assert code(rivals, 4.0) == ConditionCode.OTHER_POSE_PUBLISHER


def test_it_is_forgotten_when_it_stays_away():
    rivals, _ = played((30, 1, 0.0), (30, 1, 1.0), until_s=2.0)
    for k in range(150):
        rivals.take_pose2d(1000 + k, 2.0 + k / 30)
    assert code(rivals, 7.0) is None


def test_publishers_of_other_names_are_found_before_they_publish():
    rivals = Rivals("/drocap")
    rivals.set_names(["/drocap/pose_estimator", "/drocap/pose_estimator"])  # a killed one and its successor
    assert rivals.condition(0.0) is None
    rivals.set_names(["/drocap/pose_estimator", "/drocap/session_player"])
    assert "(/drocap/pose_estimator, /drocap/session_player)" in str(rivals.condition(0.0))


def test_a_strange_status_is_a_second_bridge_until_it_is_silent():
    rivals = Rivals("/drone1")
    for stamp in range(10):
        rivals.published_status(stamp)
        rivals.take_status(stamp, 0.2 * stamp)
        assert rivals.condition(0.2 * stamp) is None
    rivals.take_status(77, 2.0)
    assert code(rivals, 4.9) == ConditionCode.SECOND_BRIDGE
    assert "/drone1" in str(rivals.condition(2.0))
    assert rivals.condition(5.1) is None


def test_numbers_that_are_unknown_are_no_rival():
    rivals = Rivals("/drocap")
    for number, at in zip(itertools.repeat(0, 50), itertools.count(0.0, 0.03), strict=False):
        rivals.take_pose2d(number, at)
    assert rivals.condition(1.0) is None
