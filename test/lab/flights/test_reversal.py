"""An orbit that turns its direction goes on: no hold, no loss of radius, the turn inside the setpoints' limits."""

import numpy as np
import pytest

from drocap_ros.flight.orbit.states import State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config


@pytest.mark.parametrize(
    ("autopilot", "changes"), [("ardupilot", {"reverse_every_s": 10.0}), ("px4", {"calibrate_telemetry": True})]
)
def test_orbit_turns_without_a_hold(autopilot, changes):
    settings = LoopSettings(autopilot=autopilot, seed=2, distance_m=6.5, seconds=36.0)
    loop = OrbitLoop(with_config(settings, body_height_m=1.75, size_error=0.04, **changes))
    loop.start()
    loop.run(35.0)
    rows = [row for row in loop.rows if row.t_s > 12.0]
    assert all(row.state == State.ORBITING for row in rows)
    assert max(abs(row.distance_m - 6.0) for row in rows) < 1.2
    offset = np.array([row.position[:2] - loop.pelvis(row.t_s)[:2] for row in rows])
    phase = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
    rate = np.degrees(np.gradient(phase, 0.05))
    assert rate.min() < -5.0
    assert rate.max() > 5.0
