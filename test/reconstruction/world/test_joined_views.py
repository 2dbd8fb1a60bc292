"""One body in several views: derivatives of the cost, and the whole adjustment on exact images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_world_adjustment import FPS, exact_input, orbit, walker

from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.world_adjustment import adjust_in_world
from drocap_ros.reconstruction.world.world_model import (
    CAMERA,
    GLOBALS,
    LENGTHS,
    SCALE,
    Doubt,
    WorldInput,
    WorldState,
)
from drocap_ros.reconstruction.world.world_residuals import Contacts, WorldResiduals, weights_of


def two_views(joints: np.ndarray) -> WorldInput:
    """The joints seen by two orbiting cameras, the second placed with an error that is to be found."""
    frames = len(joints)
    views = []
    for bearing in (0.0, 2.0):
        rotation, position = orbit(bearing + 0.01 * np.arange(frames), np.zeros((frames, 2)))
        views.append(exact_input(joints, rotation, position, CameraTelemetry(rotation, position, FPS)))
    return replace(views[0], further=(replace(views[1], doubt=Doubt(0.5, (5.0, 5.0), lens=(0.0, 0.2), lean_std=0.1)),))


def test_derivatives_of_all_views_are_those_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    joints = rng.normal(0.0, 0.4, (7, 17, 3)) + np.array([0.0, 0.0, 1.0])
    data = two_views(joints)
    shared = np.zeros(GLOBALS)
    shared[LENGTHS], shared[SCALE] = 1.01 * data.lengths, 1.03
    state = WorldState(joints + rng.normal(0, 0.03, joints.shape), np.zeros((7, CAMERA)), shared).with_views(1)
    state = replace(
        state,
        camera=state.camera + rng.normal(0, 0.01, state.camera.shape),
        globals=np.append(state.globals[:GLOBALS], rng.normal(0, 0.02, len(state.globals) - GLOBALS)),
    )
    weights, contact = weights_of(data), rng.random((6, 4))
    here = WorldResiduals(data, weights, state, Contacts(contact, 0.2))
    by_frame, by_shared = here.gradient()
    step = 1e-6

    def cost(frames: np.ndarray, all_frames: np.ndarray) -> float:
        return here.moved(frames, all_frames).cost

    none, still = np.zeros_like(by_frame), np.zeros_like(by_shared)
    for _ in range(40):
        way = rng.normal(size=by_frame.shape)
        change = (cost(step * way, still) - cost(-step * way, still)) / (2 * step)
        assert change == pytest.approx(float((way * by_frame).sum()), rel=1e-5, abs=1e-2)
    for unknown in range(len(by_shared)):
        way = np.zeros_like(by_shared)
        way[unknown] = step
        change = (cost(none, way) - cost(none, -way)) / (2 * step)
        assert change == pytest.approx(by_shared[unknown], rel=5e-3, abs=1e-2)


def test_a_step_of_the_matrix_is_the_change_of_the_gradient() -> None:
    """Near the solution, where every term is quadratic: band, border and corner are those of all views."""
    joints = walker(20)
    data = two_views(joints)
    shared = np.zeros(GLOBALS)
    shared[LENGTHS], shared[SCALE] = data.lengths, 1.0
    state = WorldState(joints, np.zeros((20, CAMERA)), shared).with_views(1)
    here = WorldResiduals(data, weights_of(data), state, Contacts(np.zeros((19, 4)), 0.0))
    band, border, corner = here.equations()
    size = len(band)
    full = np.zeros((size, size))
    for offset in range(band.shape[1]):
        at = np.arange(size - offset)
        full[at, at + offset] = full[at + offset, at] = band[: size - offset, offset]
    whole = np.block([[full, border], [border.T, corner]])
    assert np.linalg.eigvalsh(whole).min() > -1e-6 * np.abs(whole).max()
    rng = np.random.default_rng(2)
    frames, ours = rng.normal(size=(20, size // 20)), rng.normal(size=len(state.globals))
    frames[:, 2 * CAMERA :], ours[: SCALE + 1] = 0.0, 0.0  # the cameras alone: depths of joints are robust
    step = 1e-7
    before, after = (here.moved(sign * step * frames, sign * step * ours).gradient() for sign in (-1, 1))
    change = np.concatenate([(after[0] - before[0]).ravel(), after[1] - before[1]]) / (2 * step)
    expected = whole @ np.concatenate([frames.ravel(), ours])
    np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(expected).max())


def test_exact_images_of_two_cameras_give_body_and_place_of_the_second() -> None:
    """The second camera stands 0.3 m away from its given place and is turned by 2 degrees."""
    joints = walker(120)
    data = two_views(joints)
    view = data.further[0]
    wrong = CameraTelemetry(view.telemetry.rotation, view.telemetry.position + np.array([0.2, -0.2, 0.1]), FPS)
    data = replace(data, further=(replace(view, telemetry=wrong),))
    shared = np.zeros(GLOBALS)
    shared[SCALE] = 1.0
    start = joints + np.random.default_rng(1).normal(0.0, 0.05, joints.shape)
    found = adjust_in_world(data, WorldState(start, np.zeros((120, CAMERA)), shared))
    assert np.linalg.norm(found.joints - joints, axis=-1).mean() < 0.02
    moved = found.state.of_view(1).camera[:, :3]
    np.testing.assert_allclose(moved, np.broadcast_to([-0.2, 0.2, -0.1], moved.shape), atol=0.05)
