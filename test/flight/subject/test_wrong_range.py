"""A range that is wrong: the orbit stays clear of the minimum distance by the nearer of body size and ground."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.flight.bridge_config import OrbitConfig, SubjectConfig
from drocap_ros.flight.orbit.planner import least_radius
from drocap_ros.flight.subject.subject_filter import SubjectFilter
from drocap_ros.flight.vehicle import CameraPose
from drocap_ros.keypoints import PoseObservation
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config
from lab.simulation.capture import SimulationConfig, simulate_capture

S = 1_000_000_000


def estimated(factor=1.0, ground_m=0.0, action="stand", seconds=8.0):
    """The filter's estimate of a person of 1.7 m whose image is scaled, and the true distance from the camera."""
    settings = SimulationConfig(action=action, stature_m=1.7, attitude_error_deg=0.3, position_error_m=0.0)
    capture = simulate_capture(seconds, 15.0, 3, settings)
    tracks, subject = capture.tracks, SubjectFilter(SubjectConfig(ground_height_m=ground_m))
    middle = np.nanmean(tracks.keypoints, axis=1, keepdims=True)
    keypoints = ((tracks.keypoints - middle) * factor + middle).astype(np.float32)
    for i, stamp in enumerate(tracks.stamp_ns):
        seen = PoseObservation(
            int(stamp) + S, 1, tracks.image_size, keypoints=keypoints[i], covariance=tracks.covariance[i],
            confidence=tracks.confidence[i],
        )  # fmt: skip
        camera = CameraPose(tracks.camera_rotation[i], tracks.camera_position[i])
        subject.update(seen, tracks.camera_matrix, camera)
    estimate = subject.estimate(seen.stamp_ns)
    truth = np.hypot(*(capture.joints3d_world[-1, 0, :2] - camera.position[:2]))
    return estimate, float(np.hypot(*(estimate.position[:2] - camera.position[:2]))), float(truth)


@pytest.mark.parametrize("action", ["stand", "walk", "squats"])
def test_agreeing_ranges_leave_no_doubt(action):
    assert estimated(action=action)[0].nearer < 0.1


@pytest.mark.parametrize("factor", [0.6, 0.75])
def test_a_small_image_is_doubted_by_the_ground(factor):
    estimate, distance, truth = estimated(factor, seconds=2.0)  # the own way corrects the range later
    assert distance > 1.1 * truth
    assert (1 - estimate.nearer) * distance < 1.2 * truth


def test_a_wrong_ground_is_doubted_by_the_image():
    estimate, distance, truth = estimated(ground_m=-1.5)
    assert (1 - estimate.nearer) * distance < 1.1 * truth


def test_a_camera_that_descends_over_another_ground_sees_a_standing_person_stand():
    settings = LoopSettings(seed=4, seconds=8.0)
    loop = OrbitLoop(with_config(settings, ground_height_m=-2.0, height_error_m=1.0, max_height_m=8.0))
    loop.start(4.0)
    distances = []

    places = []

    def note(loop):
        if loop.t > 4.5:
            places.append(loop.status.subject_position[:2])
            distances.append(loop.status.radius_m - loop.rows[-1].distance_m)

    loop.run(7.0, note)
    # From 3 m on, and not to the 0.5 m that are 2.5 m above the configured ground: the picture shows another one.
    assert 2.2 < loop.copter.body.position[2] < 2.9
    assert np.linalg.norm(places[-1] - places[0]) < 0.7 * 2.0
    assert np.abs(distances).max() < 0.7


def test_least_radius_counts_the_worst_error_of_the_range():
    config = OrbitConfig()
    usual = least_radius(config, 0.1, 0.0, 1.3)
    assert least_radius(config, 0.1, 0.0, 1.3, size_error=0.08) > 1.4 * config.min_distance_m + 0.4
    assert least_radius(config, 0.1, 0.0, 1.3, size_error=0.04) < 4.2  # of a body that was measured
    assert least_radius(config, 0.1, 0.0, 1.3, nearer_m=1.0) == pytest.approx(usual + 0.9)


@pytest.mark.parametrize(("autopilot", "factor", "action"), [("ardupilot", 0.72, "kicking"), ("px4", 0.71, "squats")])
def test_an_orbit_by_a_range_far_too_long_keeps_the_minimum_distance(autopilot, factor, action):
    settings = LoopSettings(
        autopilot=autopilot, action=action, seed=5, stature_m=1.75, distance_m=6.5, wind_m_s=(4.0, 0.0, 0.0),
        seconds=26.0,
    )  # fmt: skip
    loop = OrbitLoop(with_config(settings, radius_m=4.2, height_m=3.0))

    def smaller(seen):
        middle = np.nanmean(seen.keypoints, axis=0)
        return dataclasses.replace(seen, keypoints=((seen.keypoints - middle) * factor + middle).astype(np.float32))

    loop.perceive = smaller
    loop.start()
    loop.run(25.0)
    moving = [row.distance_m for row in loop.rows if row.t_s > 4.0 and np.linalg.norm(row.velocity) > 0.5]
    assert len(moving) > 50
    assert min(moving) > 3.0
