"""The closed loop by rendered images and the shipped simulation networks, in simulated time."""

import numpy as np
import pytest

from drocap_ros.flight.orbit.states import State
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import SIMULATION, models_folder
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from lab.flights.orbit_loop import LoopSettings, orbit_quality, with_config
from lab.flights.pixel_loop import PixelOrbitLoop

pytest.importorskip("onnxruntime")


@pytest.mark.xfail(reason="the radius is not settled at 18 s by a vehicle as the recorded one", strict=True)
def test_orbit_by_rendered_images_keeps_radius_and_heading():
    settings = with_config(LoopSettings(seed=0, wind_m_s=(8.0, 0.0, 0.0), seconds=18.0), body_height_m=1.75)
    loop = PixelOrbitLoop(settings, PoseEstimator(models_folder(SIMULATION), PoseEstimatorConfig()))
    loop.start()
    loop.run(18.0)
    assert loop.controller.safety.state == State.ORBITING, loop.reasons
    quality = orbit_quality(loop, 6.0, 13.0)
    assert quality.radius_error_m < 0.3
    assert quality.yaw_error_deg < 3.0
    assert quality.in_middle_third > 0.95
    errors = np.array(loop.errors) / np.array(loop.heights_px)[:, None]
    assert np.isfinite(errors).all(axis=1).mean() > 0.95
    assert np.nanmean(errors) < 0.03
    # Images from many sides: a large part of a turn.
    bearings = np.unwrap([np.arctan2(*row.position[1::-1]) for row in loop.rows])
    assert np.degrees(np.ptp(bearings)) > 150


def test_two_boxes_of_one_person_do_not_end_the_orbit():
    settings = LoopSettings(seed=1, bearing_deg=37.0, wind_m_s=(8.0, 0.0, 0.0), seconds=9.0)
    settings = with_config(settings, body_height_m=1.75)
    loop = PixelOrbitLoop(settings, PoseEstimator(models_folder(SIMULATION), PoseEstimatorConfig()))
    loop.start()
    loop.run(8.0)
    assert loop.controller.safety.state == State.ORBITING, loop.reasons
    assert np.isfinite(loop.errors).all(axis=1).mean() > 0.95
