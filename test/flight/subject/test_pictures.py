"""Pictures that are late, frozen, lost or of somebody else: the orbit ends, and says which."""

import dataclasses

import numpy as np
import pytest
from branched import branched
from orbit_observations import GOOD, LIMITS, changed

from drocap_ros.flight.conditions import PICTURE_CODES, ConditionCode
from drocap_ros.flight.orbit.motion_checks import subject_condition
from drocap_ros.flight.orbit.speed import allowed_pace
from drocap_ros.flight.orbit.states import State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop

_C = ConditionCode
LATE_NS = 1_500_000_000


def still():
    """The first picture again and again, with new stamps."""
    shown = []
    return lambda seen: dataclasses.replace(seen, keypoints=(shown or shown.append(seen.keypoints) or shown)[0])


FAULTS = {
    "lost": (lambda seen: None, _C.PICTURES_LOST, "no keypoints of a picture"),
    "late": (
        lambda seen: dataclasses.replace(seen, stamp_ns=seen.stamp_ns - LATE_NS),
        _C.PICTURES_LATE,
        "s after their exposure",
    ),
    "frozen": (still(), _C.PICTURES_FROZEN, "stands still"),
    "another track": (lambda seen: dataclasses.replace(seen, track_id=2), _C.OTHER_SUBJECT, "somebody else"),
    "another place": (
        lambda seen: dataclasses.replace(seen, keypoints=seen.keypoints + np.float32(400)),
        _C.OTHER_SUBJECT,
        "somebody else",
    ),
    "no joint": (
        lambda seen: dataclasses.replace(seen, keypoints=seen.keypoints * np.float32(np.nan)),
        _C.SUBJECT_OUTDATED,
        "last located",
    ),
    "nobody": (lambda seen: dataclasses.replace(seen, track_id=0), _C.SUBJECT_OUTDATED, "last located"),
}


@pytest.fixture(scope="module")
def loop():
    """An orbit that has begun."""
    loop = OrbitLoop(LoopSettings(seed=3, seconds=10.0))
    loop.start()
    loop.run(7.0)
    assert loop.status.state == State.ORBITING
    return loop


@pytest.mark.parametrize("name", FAULTS)
@branched
def test_an_orbit_that_ends_says_what_is_wrong_with_the_pictures(loop, name):
    loop.perceive, code, words = FAULTS[name]
    slowed = []
    loop.run(9.0, lambda flown: slowed.append(flown.status.condition))
    assert (loop.status.state, loop.status.condition.code) == (State.HOLDING, code)
    assert words in str(loop.status.condition)
    causes = [condition.values["cause"].code for condition in slowed if condition.code == _C.DEGRADED]
    assert causes[-1] == code
    assert set(causes) <= PICTURE_CODES


@pytest.mark.parametrize(("silent_s", "code"), [(0.1, _C.PICTURES_LATE), (0.5, _C.PICTURES_LOST)])
def test_the_greater_part_of_the_age_says_whether_pictures_come_late_or_not_at_all(silent_s, code):
    old = changed(GOOD, subject_age_s=0.6, picture_age_s=0.6, silent_s=silent_s)
    assert subject_condition(old, LIMITS).code == code
    assert allowed_pace(old, LIMITS)[1].code == code


@pytest.mark.parametrize(("attitude_s", "code"), [(0.05, _C.SUBJECT_OUTDATED), (0.19, _C.ATTITUDE_OUTDATED)])
def test_a_picture_that_waits_for_the_attitude_is_not_blamed(attitude_s, code):
    waiting = changed(GOOD, subject_age_s=0.3, picture_age_s=0.12, silent_s=0.02, state_age_s=attitude_s)
    assert allowed_pace(waiting, LIMITS)[1].code == code


def test_a_subject_who_is_in_doubt_slows_the_orbit_down_at_once_and_is_named():
    doubted = changed(GOOD, subject_contradicted=True)
    assert allowed_pace(doubted, LIMITS)[1].code == _C.OTHER_SUBJECT
    assert allowed_pace(doubted, LIMITS)[0] < 0.5
