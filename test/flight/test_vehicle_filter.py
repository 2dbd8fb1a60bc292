"""Position and velocity of the vehicle by the filter, beside the truth of recorded flights and of made ones."""

import numpy as np
import pytest

from drocap_ros.flight.vehicle import VehicleFilter


def filtered(times, positions, velocities, sd_m_s=0.1):
    """(T, 3) places, (T, 3) velocities and the doubts of a flight."""
    own, places, speeds, doubts = VehicleFilter(sd_m_s), [], [], []
    for t, place, velocity in zip(times, positions, velocities, strict=True):
        doubts.append(own.take(t, place, velocity))
        places.append(own.position)
        speeds.append(own.velocity)
    return np.array(places), np.array(speeds), doubts


def circle(seconds=40.0, period_s=0.05):
    """Times, places and velocities of an orbit of 6 m at 2 m/s."""
    t = np.arange(0.0, seconds, period_s)
    phase = t / 3.0
    zero = np.zeros_like(t)
    return (
        t,
        6.0 * np.stack([np.cos(phase), np.sin(phase), zero], 1),
        2.0 * np.stack([-np.sin(phase), np.cos(phase), zero], 1),
    )


def rms(rows):
    return float(np.sqrt(np.mean(np.sum(rows[:, :2] ** 2, axis=1))))


def test_a_lasting_error_of_the_velocity_is_found_and_taken_away():
    t, place, velocity = circle()
    error = np.array([0.3, -0.2, 0.1])
    places, speeds, doubts = filtered(t, place, velocity + error)
    late = t > 10.0
    assert np.abs(speeds - velocity)[late].max() < 0.1
    assert np.abs(places - place)[late].max() < 0.1
    assert not any(any(doubt) for doubt in doubts)


def test_a_good_velocity_takes_the_fine_noise_from_the_position():
    rng = np.random.default_rng(0)
    t, place, velocity = circle()
    reported = place + rng.normal(0.0, 0.05, place.shape)
    places, speeds, _ = filtered(t, reported, velocity)
    late = t > 10.0
    assert rms((places - place)[late]) < 0.4 * rms((reported - place)[late])
    assert rms((speeds - velocity)[late]) < 0.1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_step_that_the_velocity_does_not_explain_is_a_jump_and_the_filter_goes_on_from_there(axis):
    t, place, velocity = circle()
    for step_m, jumps in ((0.4, False), (0.6, True), (-5.0, True)):
        moved = place.copy()
        moved[400:, axis] += step_m
        places, _, doubts = filtered(t, moved, velocity)
        found = [i for i, doubt in enumerate(doubts) if doubt.jump_m]
        assert found == ([400] if jumps else [])
        if jumps:
            assert doubts[400].jump_m == pytest.approx(abs(step_m), abs=0.05)
            np.testing.assert_allclose(places[400], moved[400])


def test_a_position_that_moves_on_where_the_velocity_stands_is_a_contradiction():
    t, place, velocity = circle()
    drift = np.clip(t - 20.0, 0.0, None)[:, None] * [2.0, 0.0, 0.0]
    _, _, doubts = filtered(t, place + drift, velocity)
    first = next(i for i, doubt in enumerate(doubts) if any(doubt))
    assert doubts[first].jump_m == 0.0
    assert 20.0 < t[first] < 25.0
    assert doubts[first].error_m_s > 1.5


def test_a_gap_and_a_step_back_in_time_begin_anew():
    t, place, velocity = circle()
    keep = (t < 10.0) | (t > 10.55)
    places, _, doubts = filtered(t[keep], place[keep], velocity[keep])
    assert not any(any(doubt) for doubt in doubts)
    np.testing.assert_allclose(places[np.argmax(t[keep] > 10.55)], place[keep][np.argmax(t[keep] > 10.55)])
    back = np.concatenate([t[:200], t[:200] + 2.0])
    _, _, doubts = filtered(back, np.concatenate([place[:200]] * 2), np.concatenate([velocity[:200]] * 2))
    assert [i for i, doubt in enumerate(doubts) if doubt.jump_m] == [200]  # it was elsewhere, after an own restart


def test_the_frame_of_the_reports_does_not_matter():
    t, place, velocity = circle()
    rng = np.random.default_rng(1)
    velocity = velocity + 0.2 * rng.standard_normal(3)
    places, speeds, _ = filtered(t, place, velocity)
    moved, same, _ = filtered(t + 1e3, np.add(place, [300.0, -200.0, 50.0]), velocity)
    np.testing.assert_allclose(moved - [300.0, -200.0, 50.0], places, atol=1e-6)
    np.testing.assert_allclose(same, speeds, atol=1e-6)


def recorded(shared, pattern):
    """Recorded flights: report times, reported and true places and velocities, every 0.1 s."""
    for path in sorted((shared / "flight").glob(pattern)):
        with np.load(path) as flight:
            at = flight["reported_time_s"]
            true = [
                np.stack([np.interp(at, flight["time_s"], flight[name][:, axis]) for axis in range(3)], 1)
                for name in ("position_m", "velocity_m_s")
            ]
            yield (
                path.name,
                flight["reported_boot_s"],
                flight["reported_position_m"],
                flight["reported_velocity_m_s"],
                *true,
            )


@pytest.mark.parametrize(
    ("pattern", "sd_m_s", "wander_m", "speed_m_s"),
    [("t3_px4_*gimbal_*", 0.25, 0.15, 0.22), ("t3_ardupilot_gimbal_*", 0.02, 0.04, 0.04)],
)
def test_the_better_of_both_reports_decides_on_the_real_autopilots(shared, pattern, sd_m_s, wander_m, speed_m_s):
    """PX4's reported velocity errs by 0.3 m/s (RMS), and its integral by as much within a second."""
    wanders, errors, integrals = [], [], []
    for _, t, place, velocity, true_place, true_velocity in recorded(shared, pattern):
        if len(t) < 300:
            continue
        places, speeds, _ = filtered(t, place, velocity, sd_m_s)
        error = (places - true_place)[50:]
        wanders.append(rms(error[10:] - error[:-10]))
        errors.append(rms((speeds - true_velocity)[50:]))
        integrals.append(rms((velocity - true_velocity)[50:]))
    assert len(errors) >= 3
    assert np.mean(wanders) < wander_m
    assert np.mean(errors) < speed_m_s
    assert np.mean(errors) < 1.1 * np.mean(integrals)


def test_no_recorded_flight_contradicts_itself(shared):
    judged = 0
    for name, t, place, velocity, *_ in recorded(shared, "t3_*"):
        doubts = filtered(t, place, velocity)[2]
        assert not any(any(doubt) for doubt in doubts), name
        judged += len(doubts)
    assert judged > 10000
