"""A motion in the world by telemetry and fixed points of the scene together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drocap_ros.background import Background
from drocap_ros.evaluation.compare import world_errors
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.studies.protocol import Sequence
from lab.studies.world_protocol import FPS, WorldCase, WorldView, world_view

FRAMES = 192


@pytest.fixture(scope="module")
def view() -> WorldView:
    person = simulate_person(np.arange(FRAMES) / FPS, "walk", 1, 1.75, BODY_15)
    return world_view(Sequence("walk", 1000.0 * person), WorldCase("gps", background=True), seed=2)


@pytest.fixture(scope="module")
def with_points(view: WorldView) -> Motion:
    return reconstruct(view.tracks)


def test_points_make_the_path_of_a_person_better_than_gps_does(view: WorldView, with_points: Motion) -> None:
    alone = reconstruct(dataclasses.replace(view.tracks, background=None))
    before, after = (
        world_errors(m.joints3d[:, :15], view.truth, FPS, m.covariance[:, :15]) for m in (alone, with_points)
    )
    assert after.wa_mm < before.wa_mm
    assert after.root_percent < before.root_percent
    assert after.coverage > 0.75


def test_what_the_points_measured_stands_in_the_motion(with_points: Motion) -> None:
    (window,) = with_points.meta["calibration"]
    assert window["measured_by"] == "background"
    assert window["background"]["residual_px"] < 1.0
    assert window["background"]["covered_share"] > 0.95
    turned, std = (np.array(window[f"misalignment{name}_deg"]) for name in ("", "_std"))
    assert (np.abs(np.abs(turned[[0, 2]]) - 1.0) < 1.0).all()  # the protocol turns every axis by a degree, and wanders
    assert (std[[0, 2]] < 0.5).all()
    assert std[1] < 1.2  # the prior's: for 8 s a receiver that wanders by 0.5 m knows a direction to about a degree
    assert "tracks of fixed points" in telemetry_words(with_points.meta)
    assert with_points.meta["seconds"]["camera"] > 0.0


def test_the_same_input_gives_the_same_arrays(view: WorldView, with_points: Motion) -> None:
    again = reconstruct(view.tracks)
    np.testing.assert_array_equal(again.joints3d, with_points.joints3d)
    np.testing.assert_array_equal(again.camera_position, with_points.camera_position)
    np.testing.assert_array_equal(again.covariance, with_points.covariance)


def test_points_of_another_flight_do_not_move_the_camera_far(view: WorldView) -> None:
    """Points that no camera explains are refused or ignored, and the body is one still."""
    rng = np.random.default_rng(0)
    points = view.tracks.background
    assert points is not None
    shaken = Background(points.frame, points.track, rng.uniform(0, 700, points.point.shape).astype(np.float32))
    motion = reconstruct(dataclasses.replace(view.tracks, background=shaken))
    errors = world_errors(motion.joints3d[:, :15], view.truth, FPS)
    assert errors.pa_mm < 70.0
