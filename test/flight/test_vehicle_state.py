import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.flight import vehicle_state
from drocap_ros.geometry.geodesy import enu_to_geodetic, geodetic_to_enu
from drocap_ros.geometry.rotations import quaternion_multiply

RNG = np.random.default_rng(7)
V = RNG.normal(size=(50, 3))
Q = Rotation.random(50, random_state=3).as_quat()


def test_axes_are_swapped_and_negated():
    north, east, down = np.eye(3)
    assert np.array_equal(vehicle_state.ned_to_enu(north), [0, 1, 0])
    assert np.array_equal(vehicle_state.ned_to_enu(east), [1, 0, 0])
    assert np.array_equal(vehicle_state.ned_to_enu(down), [0, 0, -1])
    assert np.array_equal(vehicle_state.frd_to_flu(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_conversion_is_its_own_inverse():
    assert np.array_equal(vehicle_state.enu_to_ned(vehicle_state.ned_to_enu(V)), V)
    assert np.array_equal(vehicle_state.flu_to_frd(vehicle_state.frd_to_flu(V)), V)
    back = vehicle_state.orientation_to_aviation(vehicle_state.orientation_to_ros(Q))
    assert np.allclose(np.abs(np.sum(back * Q, axis=1)), 1.0)


def test_orientation_agrees_with_converted_vectors():
    # body FLU -> ENU must equal: FLU to FRD, then FRD -> NED, then NED to ENU.
    ros = Rotation.from_quat(vehicle_state.orientation_to_ros(Q)).apply(V)
    chain = vehicle_state.ned_to_enu(Rotation.from_quat(Q).apply(vehicle_state.flu_to_frd(V)))
    assert np.allclose(ros, chain)


def test_vehicle_that_points_north_has_enu_yaw_of_90_degrees():
    q = vehicle_state.orientation_to_ros(vehicle_state.quaternion_from_euler(0, 0, 0))
    assert np.allclose(Rotation.from_quat(q).as_euler("ZYX", degrees=True), [90, 0, 0])
    q = vehicle_state.orientation_to_ros(vehicle_state.quaternion_from_euler(0, 0, np.pi / 2))  # nose east
    assert np.allclose(Rotation.from_quat(q).apply([1, 0, 0]), [1, 0, 0])
    q = vehicle_state.orientation_to_ros(vehicle_state.quaternion_from_euler(0, np.pi / 6, 0))  # nose up
    assert Rotation.from_quat(q).apply([1, 0, 0])[2] > 0.49
    q = vehicle_state.orientation_to_ros(vehicle_state.quaternion_from_euler(np.pi / 6, 0, 0))  # right wing down
    assert Rotation.from_quat(q).apply([0, 1, 0])[2] > 0.49


def test_euler_angles_and_product_equal_scipy():
    angles = RNG.uniform(-1.5, 1.5, (30, 3))
    for roll, pitch, yaw in angles:
        ours = vehicle_state.quaternion_from_euler(roll, pitch, yaw)
        theirs = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
        assert np.isclose(abs(ours @ theirs), 1.0)
        assert np.isclose(vehicle_state.yaw_of(ours), yaw)
    one_by_one = [vehicle_state.quaternion_from_euler(*row) for row in angles]
    np.testing.assert_allclose(vehicle_state.quaternion_from_euler(*angles.T).T, one_by_one, atol=1e-15)
    ours = quaternion_multiply(Q, Q[::-1])
    theirs = (Rotation.from_quat(Q) * Rotation.from_quat(Q[::-1])).as_quat()
    assert np.allclose(np.abs(np.sum(ours * theirs, axis=1)), 1.0)


def test_camera_rotation_of_a_level_camera_facing_north():
    q = vehicle_state.orientation_to_ros(vehicle_state.quaternion_from_euler(0, 0, 0))
    rotation = vehicle_state.camera_rotation(q)
    assert np.allclose(rotation @ [0, 1, 0], [0, 0, 1])  # north is ahead
    assert np.allclose(rotation @ [1, 0, 0], [1, 0, 0])  # east is right
    assert np.allclose(rotation @ [0, 0, 1], [0, -1, 0])  # up is minus y
    assert vehicle_state.camera_rotation(Q).shape == (50, 3, 3)
    assert np.allclose(np.linalg.det(vehicle_state.camera_rotation(Q)), 1.0)


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
