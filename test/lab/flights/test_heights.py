"""Reported heights that err by up to 5 m: nobody is brought down by them."""

import pytest

from lab.flights.heights import LEAST_M, Case, fly


@pytest.mark.parametrize(
    "case",
    [
        Case(0.75), Case(0.75, "px4", "fixed"), Case(1.25, ground_plane=False, drifts=True), Case(2.5),
        Case(3.0, mount="fixed", drifts=True), Case(4.0, "px4", ground_plane=False), Case(5.0, "px4", drifts=True),
        Case(-1.0), Case(-5.0, "px4", drifts=True),
    ],
    ids=str,
)  # fmt: skip
def test_a_reported_height_that_errs_brings_nobody_down(case):
    outcome = fly(case)
    assert outcome.lowest_m > LEAST_M, outcome.words
    if abs(case.error_m) <= 1.0:  # within three deviations: flown, and near the wanted height where it matters
        assert outcome.flown
        assert outcome.lowest_m > 2.0
    if case.error_m >= 2.5:  # the reason is named
        assert "ground_height_m" in outcome.words or "may be lost" in outcome.words
        assert outcome.flown == case.drifts


def test_without_an_error_the_orbit_is_flown_at_its_height():
    outcome = fly(Case(0.0))
    assert outcome.words.startswith("ORBITING")
    assert 2.3 < outcome.lowest_m < 2.8
