"""Flights with fixed seeds whose world, reports, pilot and person vary; `python -m lab.flights.vary` draws more."""

import pytest

from lab.flights.vary import LIMITS, Draw, draw, fly, smaller

#: What drawn flights broke, without the values that it does not need, and what mended it.
ROWS = (
    # Somebody runs up to the vehicle and stands: it springs back by less than 0.3 m.
    Draw(seed=7, person_m_s=3.517, person_deg=0.0),
    Draw(autopilot="px4", seed=3, person_m_s=3.0, person_deg=0.0),
    # The pilot chooses his mode while a request of control is pending.
    Draw(autopilot="px4", seed=402, grant_s=4.578, takes_s=7.826),
    # Control is granted late, to a vehicle that its pilot flies towards the person.
    Draw(seed=1, pilot_m_s=4.0, grant_s=3.0, mode_s=1.0, distance_m=19.0),
    Draw(autopilot="px4", seed=1, pilot_m_s=3.0, grant_s=3.0, mode_s=1.0, distance_m=18.0),
)
#: What is not mended, with the reason.
OPEN = (
    (Draw(seed=50, height_error_m=4.249), "a reported height too great by more than 2.2 m"),
    (Draw(autopilot="px4", seed=49, estimate_error=1.698), "a reported height that wanders by more than a metre"),
)


@pytest.mark.parametrize("first", range(0, 40, 10))
def test_forty_drawn_flights_break_nothing(first):
    broken = {}
    for number in range(first, first + 10):
        drawn = draw(0, number)
        if "height_error_m" not in drawn and (found := fly(drawn).found):
            broken[number] = found, drawn
    assert not broken


@pytest.mark.parametrize("drawn", ROWS, ids=str)
def test_what_once_broke_does_not(drawn):
    assert not fly(drawn).found


@pytest.mark.parametrize(
    "drawn", [pytest.param(drawn, marks=pytest.mark.xfail(reason=reason), id=str(drawn)) for drawn, reason in OPEN]
)
def test_what_breaks_still_has_a_reason(drawn):
    assert not fly(drawn).found


def test_a_draw_repeats_and_becomes_smaller(monkeypatch):
    assert draw(3, 5) == draw(3, 5) != draw(3, 6)
    fence, kind = {"fence_radius_m": 9.0}, "m outside of the fence"
    monkeypatch.setitem(LIMITS, kind, -9.0)  # an orbit of 6 m breaks it
    assert smaller(Draw(fence | {"seed": 1, "latency_s": 0.12}), kind) == Draw(fence | {"seed": 1})
