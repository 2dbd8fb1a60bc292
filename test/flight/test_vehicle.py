"""Position and velocity of the vehicle by the filter, beside the truth of recorded flights and of made ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.flight import vehicle
from drocap_ros.flight.vehicle import PoseHistory, VehicleFilter, VehicleState
from drocap_ros.geometry.geodesy import enu_to_geodetic, geodetic_to_enu
from drocap_ros.geometry.rotations import quaternion_multiply


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


RNG = np.random.default_rng(7)
V = RNG.normal(size=(50, 3))
Q = Rotation.random(50, random_state=3).as_quat()


def test_axes_are_swapped_and_negated():
    north, east, down = np.eye(3)
    assert np.array_equal(vehicle.ned_to_enu(north), [0, 1, 0])
    assert np.array_equal(vehicle.ned_to_enu(east), [1, 0, 0])
    assert np.array_equal(vehicle.ned_to_enu(down), [0, 0, -1])
    assert np.array_equal(vehicle.frd_to_flu(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_conversion_is_its_own_inverse():
    assert np.array_equal(vehicle.enu_to_ned(vehicle.ned_to_enu(V)), V)
    assert np.array_equal(vehicle.flu_to_frd(vehicle.frd_to_flu(V)), V)
    back = vehicle.orientation_to_aviation(vehicle.orientation_to_ros(Q))
    assert np.allclose(np.abs(np.sum(back * Q, axis=1)), 1.0)


def test_orientation_agrees_with_converted_vectors():
    # body FLU -> ENU must equal: FLU to FRD, then FRD -> NED, then NED to ENU.
    ros = Rotation.from_quat(vehicle.orientation_to_ros(Q)).apply(V)
    chain = vehicle.ned_to_enu(Rotation.from_quat(Q).apply(vehicle.flu_to_frd(V)))
    assert np.allclose(ros, chain)


def test_vehicle_that_points_north_has_enu_yaw_of_90_degrees():
    q = vehicle.orientation_to_ros(vehicle.quaternion_from_euler(0, 0, 0))
    assert np.allclose(Rotation.from_quat(q).as_euler("ZYX", degrees=True), [90, 0, 0])
    q = vehicle.orientation_to_ros(vehicle.quaternion_from_euler(0, 0, np.pi / 2))  # nose east
    assert np.allclose(Rotation.from_quat(q).apply([1, 0, 0]), [1, 0, 0])
    q = vehicle.orientation_to_ros(vehicle.quaternion_from_euler(0, np.pi / 6, 0))  # nose up
    assert Rotation.from_quat(q).apply([1, 0, 0])[2] > 0.49
    q = vehicle.orientation_to_ros(vehicle.quaternion_from_euler(np.pi / 6, 0, 0))  # right wing down
    assert Rotation.from_quat(q).apply([0, 1, 0])[2] > 0.49


def test_euler_angles_and_product_equal_scipy():
    angles = RNG.uniform(-1.5, 1.5, (30, 3))
    for roll, pitch, yaw in angles:
        ours = vehicle.quaternion_from_euler(roll, pitch, yaw)
        theirs = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
        assert np.isclose(abs(ours @ theirs), 1.0)
        assert np.isclose(vehicle.yaw_of(ours), yaw)
    one_by_one = [vehicle.quaternion_from_euler(*row) for row in angles]
    np.testing.assert_allclose(vehicle.quaternion_from_euler(*angles.T).T, one_by_one, atol=1e-15)
    ours = quaternion_multiply(Q, Q[::-1])
    theirs = (Rotation.from_quat(Q) * Rotation.from_quat(Q[::-1])).as_quat()
    assert np.allclose(np.abs(np.sum(ours * theirs, axis=1)), 1.0)


def test_camera_rotation_of_a_level_camera_facing_north():
    q = vehicle.orientation_to_ros(vehicle.quaternion_from_euler(0, 0, 0))
    rotation = vehicle.camera_rotation(q)
    assert np.allclose(rotation @ [0, 1, 0], [0, 0, 1])  # north is ahead
    assert np.allclose(rotation @ [1, 0, 0], [1, 0, 0])  # east is right
    assert np.allclose(rotation @ [0, 0, 1], [0, -1, 0])  # up is minus y
    assert vehicle.camera_rotation(Q).shape == (50, 3, 3)
    assert np.allclose(np.linalg.det(vehicle.camera_rotation(Q)), 1.0)


@pytest.mark.parametrize("origin", [(47.4, 8.5, 488.0), (0.0, 0.0, 0.0), (-33.9, 151.2, 20.0), (89.99, 10.0, 5.0)])
def test_geodetic_conversion_is_inverted(origin):
    origin = np.array(origin)
    enu = RNG.uniform(-2000, 2000, (40, 3))
    geodetic = enu_to_geodetic(enu, origin)
    assert np.allclose(geodetic_to_enu(geodetic, origin), enu, atol=1e-5)


def test_geodetic_offsets_have_the_known_scale():
    # A minute of latitude is one nautical mile, to within its variation with latitude.
    enu = geodetic_to_enu(np.array([45.0 + 1 / 60, 7.0, 0.0]), np.array([45.0, 7.0, 0.0]))
    assert np.isclose(enu[1], 1852, atol=2)
    assert abs(enu[0]) < 1e-6
    up = geodetic_to_enu(np.array([45.0, 7.0, 30.0]), np.array([45.0, 7.0, 0.0]))
    assert np.allclose(up, [0, 0, 30])


S = 1_000_000_000


def state(t_s, yaw_deg=0.0, **kwargs):
    half = np.deg2rad(yaw_deg) / 2
    return VehicleState(
        int(t_s * S), position_enu_m=np.array([t_s, 0.0, 2.0]), velocity_enu_m_s=np.array([1.0, 0.0, 0.0]),
        gimbal_orientation_xyzw=np.array([0.0, 0.0, np.sin(half), np.cos(half)]), **kwargs,
    )  # fmt: skip


def test_pose_is_interpolated_and_never_extrapolated():
    history = PoseHistory()
    assert history.at(S) is None
    for i in range(20):
        seen = state(1 + 0.1 * i, 3.0 * i)
        history.add(seen, seen.position_enu_m)
    middle = history.at(int(1.55 * S))
    assert np.allclose(middle.position, [1.55, 0, 2])
    yaw = np.deg2rad(16.5)
    assert np.allclose(middle.rotation[2], [np.cos(yaw), np.sin(yaw), 0])
    assert history.reached(int(2.9 * S))
    assert history.at(int(2.9 * S)) is not None
    for outside_s in (0.5, 2.95, 3.3):
        assert history.at(int(outside_s * S)) is None
    assert not history.reached(int(2.95 * S))
    history.add(state(0.2), np.zeros(3))  # the clock went back
    assert history.at(int(1.5 * S)) is None
