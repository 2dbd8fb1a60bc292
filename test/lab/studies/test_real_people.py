"""The study of real people: errors against MoCap of another rate, pose, size and place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.skeleton import BODY_15
from lab.studies.real_people import errors

RATE_HZ, TRUE_HZ, LATER_S = 25, 100, 0.48


def squats(time_s: np.ndarray) -> np.ndarray:
    """(F, 15, 3) m of a body whose knees bend and whose other joints stay."""
    body = np.random.default_rng(0).normal(size=(len(BODY_15), 3)) + np.zeros((len(time_s), 1, 1))
    for side, x in (("r", 0.1), ("l", -0.1)):
        forward = 0.3 * np.square(np.sin(3.0 * time_s))
        for joint, place in (("hip", (x, 0.0, 0.9)), ("knee", (x, 0.0, 0.5)), ("ankle", (x, 0.0, 0.1))):
            body[:, BODY_15.index(side + joint)] = place
        body[:, BODY_15.index(f"{side}knee"), 1] += forward
    return body


def test_errors_vanish_at_the_offset_alone_for_any_size_and_pose():
    at = np.arange(0, 8, 1 / TRUE_HZ)
    time_s = np.arange(0, 6, 1 / RATE_HZ)
    turn = Rotation.from_euler("xyz", (0.3, -1.0, 2.0)).as_matrix()
    seen = 0.7 * squats(time_s + LATER_S) @ turn.T + (1.0, 2.0, 3.0)
    pa, knees, signed = errors(seen, time_s + LATER_S, squats(at), at)
    assert max(pa, knees, abs(signed)) < 1.0
    wrong = errors(seen, time_s + LATER_S + 0.3, squats(at), at)
    assert wrong[0] > 10
    assert wrong[1] > 5


def test_bent_knees_are_told_in_degrees_and_sign():
    at = np.arange(0, 4, 1 / TRUE_HZ)
    body = squats(at)
    bent = body.copy()
    for side in "rl":
        bent[:, BODY_15.index(f"{side}knee"), 1] += 0.1
    _, knees, signed = errors(bent, at, body, at)
    assert knees == pytest.approx(signed)
    assert 15 < signed < 29


def test_too_short_an_overlap_is_no_match():
    at = np.arange(0, 4, 1 / TRUE_HZ)
    assert errors(squats(at), at + 3.0, squats(at), at)[0] == np.inf
