import numpy as np

from drocap_ros.flight.pose_history import PoseHistory
from drocap_ros.flight.vehicle_state import VehicleState

S = 1_000_000_000


def state(t_s, yaw_deg=0.0, **kwargs):
    half = np.deg2rad(yaw_deg) / 2
    return VehicleState(
        int(t_s * S), position_enu_m=np.array([t_s, 0.0, 2.0]), velocity_enu_m_s=np.array([1.0, 0.0, 0.0]),
        gimbal_orientation_xyzw=np.array([0.0, 0.0, np.sin(half), np.cos(half)]), **kwargs,
    )  # fmt: skip


def test_pose_is_interpolated_and_briefly_extrapolated():
    history = PoseHistory()
    assert history.at(S) is None
    for i in range(20):
        seen = state(1 + 0.1 * i, 3.0 * i)
        history.add(seen, seen.position_enu_m)
    middle = history.at(int(1.55 * S))
    assert np.allclose(middle.position, [1.55, 0, 2])
    yaw = np.deg2rad(16.5)
    assert np.allclose(middle.rotation[2], [np.cos(yaw), np.sin(yaw), 0])
    after = history.at(int(3.0 * S))
    yaw = np.deg2rad(60.0)
    assert np.allclose(after.position, [3.0, 0, 2])
    assert np.allclose(after.rotation[2], [np.cos(yaw), np.sin(yaw), 0])
    assert history.at(int(3.3 * S)) is None
    assert history.at(int(0.5 * S)) is None
    history.add(state(0.2), np.zeros(3))  # the clock went back
    assert history.at(int(1.5 * S)) is None
