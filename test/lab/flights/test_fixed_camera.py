"""A fixed camera about one who walks, on a busy machine: the body's own motion loses nobody."""

import numpy as np
import pytest

from drocap_ros.flight.orbit.states import State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config


@pytest.mark.parametrize(
    ("autopilot", "seed", "seconds"),
    [
        ("ardupilot", 0, 24.0),  # he comes nearer at 17 s: the vehicle leans back, his legs leave the picture
        ("px4", 2, 10.0),  # the vehicle starts before one who stands, and its telemetry pauses
    ],
)
def test_orbit_goes_on_where_the_vehicle_leans_and_telemetry_pauses(autopilot, seed, seconds):
    settings = LoopSettings(
        autopilot=autopilot, mount="fixed", action="walk", seed=seed, seconds=seconds + 1, late_share=0.05, gaps_hz=0.5
    )
    loop = OrbitLoop(
        with_config(settings, body_height_m=settings.stature_m, size_error=0.04, attitude_hz=50.0, position_hz=20.0)
    )
    loop.start()
    believed = []
    loop.run(seconds, lambda flown: believed.append((flown.rows[-1].distance_m, flown.status.radius_m)))
    assert "HOLDING" not in [state for _, state, _ in loop.reasons]
    assert loop.controller.safety.state == State.ORBITING
    assert min(row.distance_m for row in loop.rows) > 4.5
    true, seen = np.array(believed[100:]).T
    assert np.abs(seen - true).max() < 1.0  # 1.8 m by an attitude that was extrapolated
