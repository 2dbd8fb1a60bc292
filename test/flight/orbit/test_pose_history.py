import numpy as np

from drocap_ros.flight.vehicle_filter import PoseHistory
from drocap_ros.flight.vehicle_state import VehicleState

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
