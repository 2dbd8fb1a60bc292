"""Reported heights that err by up to 5 m, from the beginning or growing in flight: nobody is brought down by them."""

import pytest

from drocap_ros.flight.orbit.states import Action, State
from lab.flights.vary import START_S, Draw, fly


def flown(**values):
    """A drawn flight: true heights while an orbit was sent, and why it ended or was refused."""
    loop = fly(Draw(seed=4, **values)).loop
    moved_s = max((row.t_s for row in loop.rows if row.action == Action.ORBIT), default=0.0) + 0.5  # the rest is a hold
    heights = [float(row.position[2]) for row in loop.rows if START_S < row.t_s <= moved_s]
    words = f"{loop.controller.safety.condition}" if heights else f"refused: {loop.answers[-1][1].condition}"
    return heights, words, loop.controller.safety.state


@pytest.mark.parametrize(
    "values",
    [
        {"height_error_m": 0.75}, {"height_error_m": 0.75, "autopilot": "px4", "mount": "fixed"},
        {"height_drift_m_s": 0.25, "use_ground_plane": False}, {"height_error_m": 2.5},
        {"height_drift_m_s": 0.25, "mount": "fixed"},
        {"height_error_m": 4.0, "autopilot": "px4", "use_ground_plane": False},
        {"height_drift_m_s": 0.25, "autopilot": "px4"}, {"height_drift_m_s": 0.5}, {"height_error_m": -1.0},
        {"height_drift_m_s": -0.25, "autopilot": "px4"},
    ],
    ids=str,
)  # fmt: skip
def test_a_reported_height_that_errs_brings_nobody_down(values):
    heights, words, _ = flown(**values)
    assert min(heights, default=3.0) > 1.2, words
    error_m = values.get("height_error_m", 5.0)
    if abs(error_m) <= 1.0:  # within three deviations: flown, and near the wanted height where it matters
        assert heights
        assert min(heights) > 2.0
    if error_m >= 2.5 and values.get("height_drift_m_s", 0.0) >= 0.0:  # the reason is named
        assert "ground_height_m" in words or "may be lost" in words
        assert bool(heights) == ("height_drift_m_s" in values)


def test_without_an_error_the_orbit_is_flown_at_its_height():
    heights, _, state = flown()
    assert state == State.ORBITING
    assert 2.3 < min(heights) < 2.8
