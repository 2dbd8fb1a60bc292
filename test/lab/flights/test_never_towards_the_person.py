"""The vehicle keeps away from a person whom perception sees farther away, or walking away, while he stands."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.flight.orbit.states import Action
from drocap_ros.flight.subject import subject_filter
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

FAULT_S, SECONDS = 12.0, 26.0
RANGE_ERROR = 1.4
LATE_NS = 100_000_000
#: The bridge knows the estimated distance: where it is too long by 40 %, the limit of 3 m is 2.14 m in truth.  Stamps
#: 0.1 s late shift the person by 0.2 m at 2 m/s.
LEAST_M = 3.0 / RANGE_ERROR - 0.2
#: The bound is commanded; the copter's velocity loop overshoots, and gusts push it.
BOUND_M_S, LAG_M_S = 1.0, 0.3


def swinging_range(loop, period_s):
    """Factor of the range: grows by 1 m/s up to 40 %, stays, and returns within the last second of the period."""

    def factor():
        t = (loop.t - FAULT_S) % period_s
        if loop.t < FAULT_S:
            return 1.0
        distance = loop.rows[-1].distance_m
        up = min(t / distance, RANGE_ERROR - 1)
        down = np.clip(t - (period_s - 1.0), 0.0, 1.0)
        return 1.0 + up * (1 - down)

    return factor


#: With stamps this late, PX4's orbit of 4.2 m ends before the fault begins: too near.
@pytest.mark.parametrize(
    ("autopilot", "radius_m", "period_s"),
    [
        ("ardupilot", 6.0, 9.0), ("ardupilot", 4.2, 5.0), ("px4", 5.0, 5.0), ("px4", 9.0, 7.0),
    ],
)  # fmt: skip
def test_receding_estimate_of_a_standing_person(autopilot, radius_m, period_s, monkeypatch):
    settings = LoopSettings(
        autopilot=autopilot, seed=3, distance_m=radius_m + 0.5, height_m=2.5, seconds=SECONDS + 1
    )  # fmt: skip
    loop = OrbitLoop(with_config(settings, radius_m=radius_m, body_height_m=1.75, angular_speed_deg_s=19.0))
    factor, locate = swinging_range(loop, period_s), subject_filter.locate_subject

    def wrong_range(observation, matrix, camera, *rest):
        found = locate(observation, matrix, camera, *rest)
        if found is None:
            return None
        return found._replace(position=camera.position + factor() * (found.position - camera.position))

    monkeypatch.setattr(subject_filter, "locate_subject", wrong_range)
    loop.perceive = lambda seen: dataclasses.replace(seen, stamp_ns=seen.stamp_ns + LATE_NS)
    loop.start()
    closing = []

    def record(loop):
        body = loop.copter.body
        sight = loop.pelvis()[:2] - body.position[:2]
        if loop.t > FAULT_S:
            closing.append(float(body.velocity[:2] @ sight) / float(np.hypot(*sight)))

    loop.run(SECONDS, record)
    flown = [row for row in loop.rows if row.t_s > FAULT_S]
    assert any(row.action == Action.ORBIT for row in flown)
    assert min(row.distance_m for row in flown) >= LEAST_M
    assert max(closing) <= BOUND_M_S + LAG_M_S
