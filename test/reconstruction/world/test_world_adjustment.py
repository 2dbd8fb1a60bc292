"""Body and camera adjusted together in the world: derivatives, exact recovery, invariance, wrong telemetry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from threadpoolctl import threadpool_info, threadpool_limits

from drocap_ros.camera_path import CameraErrors
from drocap_ros.contacts import ANKLES, RestingFeet
from drocap_ros.evaluation.metrics import ellipsoid_coverage, scale_error, still_foot_speed
from drocap_ros.geometry.rotations import exp_so3, left_jacobian, log_so3
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.world import refine
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.reconstruction.world.world_adjustment import adjust_in_world, posterior
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    CAMERA,
    FLOOR,
    GLOBALS,
    LENGTHS,
    MISALIGNMENT,
    POSITION_LATENCY,
    SCALE,
    WorldConfig,
    WorldInput,
    WorldState,
)
from drocap_ros.reconstruction.world.world_residuals import Contacts, WorldResiduals, weights_of
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks

FRAME = CAMERA + 3 * len(BODY_17)
FPS = 24.0
MATRIX = np.array([[900.0, 0, 640.0], [0, 900.0, 360.0], [0, 0, 1.0]])


def orbit(bearing: np.ndarray, centre: np.ndarray, height: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (F, 3, 3) world -> camera and position (F, 3) of a camera 6 m from ``centre`` (F, 2)."""
    position = np.column_stack(
        [centre + 6.0 * np.stack([np.cos(bearing), np.sin(bearing)], axis=1), np.full(len(bearing), height)]
    )
    forward = np.column_stack([centre, np.full(len(bearing), 0.95)]) - position
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1), position


def followed(joints: np.ndarray) -> np.ndarray:
    """(F, 2) m: the person's smoothed place, which the camera orbits."""
    return gaussian_filter1d(joints[:, 0, :2], FPS, axis=0, mode="nearest")


def project(joints: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    seen = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    return 900.0 * seen[..., :2] / seen[..., 2:] + MATRIX[:2, 2]


def walker(frames: int, seed: int = 1) -> np.ndarray:
    """(F, 17, 3) m: a person whose feet rest on the ground in turn."""
    return simulate_person(np.arange(frames) / FPS, "walk", seed, 1.75, BODY_17)


def bearing_with_reversal(frames: int) -> np.ndarray:
    """Rad: 19 deg/s one way, then the other, turned round within a second."""
    time = np.arange(frames) / FPS
    rate = np.deg2rad(19.0) * np.clip((time[-1] / 2 - time) / 0.5, -1.0, 1.0)
    return np.cumsum(rate) / FPS


def exact_input(
    joints: np.ndarray, rotation: np.ndarray, position: np.ndarray, telemetry: CameraTelemetry
) -> WorldInput:
    depth = np.einsum("fpi,fi->fp", joints - joints[:, :1], rotation[:, 2])
    return WorldInput(
        project(joints, rotation, position), np.full(joints.shape[:2], 1.0), depth, np.full(depth.shape, 0.03),
        np.median(span_lengths(joints), axis=0), telemetry, MATRIX,
    )  # fmt: skip


def random_point() -> tuple[WorldResiduals, WorldInput, WorldState, np.ndarray]:
    rng = np.random.default_rng(0)
    joints = rng.normal(0.0, 0.4, (7, 17, 3)) + np.array([0.0, 0.0, 1.0])
    rotation, position = orbit(0.1 * np.arange(7), np.zeros((7, 2)))
    data = exact_input(joints, rotation, position, CameraTelemetry(rotation, position, FPS))
    data = replace(data, keypoints=data.keypoints + rng.normal(0, 4, data.keypoints.shape))
    shared = np.zeros(GLOBALS)
    shared[LENGTHS], shared[SCALE], shared[FLOOR] = 1.01 * data.lengths, 1.04, 0.1
    shared[MISALIGNMENT], shared[[ATTITUDE_LATENCY, POSITION_LATENCY]] = [0.03, -0.05, 0.02], [0.03, 0.02]
    state = WorldState(joints, rng.normal(0, 0.01, (7, 6)), shared)
    contact = rng.random((6, 4))
    return WorldResiduals(data, weights_of(data), state, Contacts(contact, 0.2)), data, state, contact


def test_normal_matrix_holds_body_and_camera_together_by_the_first_frame_of_the_telemetry_alone() -> None:
    # Of many large elements a small sum is left: built in single precision, their rounding outweighs it.
    frames = 600
    joints = walker(frames)
    rotation, position = orbit(bearing_with_reversal(frames), followed(joints))
    data = exact_input(joints, rotation, position, CameraTelemetry(rotation, position, FPS))
    data = replace(data, config=WorldConfig(errors=CameraErrors(position_wander_m=0.5)))
    shared = np.zeros(GLOBALS)
    shared[LENGTHS], shared[SCALE] = data.lengths, 1.0
    weights, state = weights_of(data), WorldState(joints, np.zeros((frames, CAMERA)), shared)
    here = WorldResiduals(data, weights, state, Contacts(np.ones((frames - 1, 4)), 0.2))
    band, _, _ = here.equations()
    for axis in (0, 1):
        along = np.zeros((frames, FRAME))
        along[:, [axis, *range(CAMERA + axis, FRAME, 3)]] = 1.0
        further = np.append(along.ravel(), np.zeros(band.shape[1]))
        pulls = [band[:, d] @ (along.ravel() * further[d : d + len(band)]) for d in range(band.shape[1])]
        assert pulls[0] + 2.0 * sum(pulls[1:]) == pytest.approx(weights.views[0].first[axis], rel=1e-3)


def test_derivatives_are_those_of_the_cost() -> None:
    here, data, state, contact = random_point()
    by_frame, by_shared = here.gradient()
    rng, step = np.random.default_rng(1), 1e-6

    def cost(frames: np.ndarray, shared: np.ndarray) -> float:
        return WorldResiduals(data, here.weights, state.moved(frames, shared), Contacts(contact, 0.2)).cost

    for _ in range(60):
        way = rng.normal(size=by_frame.shape)
        change = (cost(step * way, np.zeros(GLOBALS)) - cost(-step * way, np.zeros(GLOBALS))) / (2 * step)
        assert change == pytest.approx(float((way * by_frame).sum()), rel=1e-5, abs=1e-2)
    for unknown in range(GLOBALS):
        way = np.zeros(GLOBALS)
        way[unknown] = step
        change = (cost(0 * by_frame, way) - cost(0 * by_frame, -way)) / (2 * step)
        assert change == pytest.approx(by_shared[unknown], rel=1e-3, abs=1e-2)


def test_normal_matrix_is_the_curvature_of_the_quadratic_terms() -> None:
    """Along a step of the quadratic terms the gradient changes by the matrix times the step."""
    here, data, state, contact = random_point()
    band, border, corner = here.equations()
    size = band.shape[0]
    full = np.zeros((size, size))
    for offset in range(band.shape[1]):
        at = np.arange(size - offset)
        full[at, at + offset] = full[at + offset, at] = band[: size - offset, offset]
    whole = np.block([[full, border], [border.T, corner]])
    assert np.linalg.eigvalsh(whole).min() > -1e-6 * np.abs(whole).max()  # a sum of squares
    # Feet, floor, accelerations, lengths and telemetry are quadratic: their rows agree exactly.
    rng = np.random.default_rng(2)
    camera = np.zeros((7, FRAME))
    camera[:, 2] = rng.normal(size=7)  # the position's error
    moved = WorldResiduals(replace(data, weight=0 * data.weight), here.weights, state, Contacts(contact, 0.2))
    flat, _, _ = moved.equations()
    matrix = np.zeros((size, size))
    for offset in range(flat.shape[1]):
        at = np.arange(size - offset)
        matrix[at, at + offset] = matrix[at + offset, at] = flat[: size - offset, offset]
    there = WorldResiduals(
        replace(data, weight=0 * data.weight),
        here.weights,
        state.moved(camera, np.zeros(GLOBALS)),
        Contacts(contact, 0.2),
    )
    change = there.gradient()[0] - moved.gradient()[0]
    np.testing.assert_allclose(change.reshape(-1), matrix @ camera.reshape(-1), rtol=1e-8, atol=1e-6)


def test_covariances_are_those_of_the_whole_inverse() -> None:
    """Selected inversion gives the blocks of the dense inverse; joints in the world depend on the scale too."""
    here, _, state, _ = random_point()
    matrix = here.equations()
    band, border, corner = matrix
    size = len(band)
    full = np.zeros((size, size))
    for offset in range(band.shape[1]):
        at = np.arange(size - offset)
        full[at, at + offset] = full[at + offset, at] = band[: size - offset, offset]
    inverse = np.linalg.inv(np.block([[full, border], [border.T, corner]]))
    found = posterior(matrix, state)
    assert found is not None
    of_place, of_joints, shared = found
    np.testing.assert_allclose(shared, inverse[size:, size:], rtol=1e-5, atol=1e-12)
    scale = state.globals[SCALE]
    frames, joints = state.joints.shape[:2]
    by = np.zeros((frames, joints, 3, len(inverse)))
    for frame, joint in np.ndindex(frames, joints):
        at = FRAME * frame + CAMERA + 3 * joint
        by[frame, joint, :, at : at + 3] = np.eye(3) / scale
        by[frame, joint, :, size + SCALE] = -state.joints[frame, joint] / scale**2
    mean = by.mean(axis=(0, 1))
    np.testing.assert_allclose(of_place, mean @ inverse @ mean.T, rtol=1e-4, atol=1e-10)
    for frame, joint in ((0, 0), (3, 8), (6, 14), (5, 16)):
        about = by[frame, joint] - mean
        np.testing.assert_allclose(of_joints[frame, joint], about @ inverse @ about.T, rtol=2e-4, atol=1e-10)


def test_body_scale_yaw_and_latency_are_recovered_from_exact_images() -> None:
    """The telemetry has a yaw error and is late; the person is 8 % taller than the lengths say."""
    longer = walker(400)
    joints = longer[:360]
    rotation, position = orbit(bearing_with_reversal(400), followed(longer))
    late = 2
    reported, place = rotation[:360], position[:360]  # each report is of two frames earlier
    yaw = exp_so3(np.array([0.0, np.deg2rad(2.0), 0.0]))
    telemetry = CameraTelemetry(yaw.T @ reported, place, FPS)
    data = exact_input(joints, rotation[late : 360 + late], position[late : 360 + late], telemetry)
    exact = WorldConfig(iterations=60, length_std=1.0, contact_weight=1.0, contact_speed_m_s=0.02, frames_per_fact=1.0)
    short = replace(data, lengths=data.lengths / 1.08, depth=data.depth / 1.08, config=exact)
    shared = np.zeros(GLOBALS)
    shared[SCALE] = 1.0
    start = WorldState(joints / 1.08 + [0.05, -0.05, 0.02], np.zeros((len(joints), CAMERA)), shared)
    found = adjust_in_world(short, start)
    shared, std = found.state.globals, found.std
    assert 1.0 / shared[SCALE] == pytest.approx(1.08, abs=0.015)
    assert np.degrees(shared[MISALIGNMENT][1]) == pytest.approx(2.0, abs=0.6)
    assert shared[ATTITUDE_LATENCY] == pytest.approx(late / FPS, abs=0.03)
    assert np.isfinite(std).all()
    assert np.linalg.norm(found.joints - joints, axis=-1).mean() < 0.1


def test_a_lifter_whose_bodies_lean_does_not_turn_the_camera() -> None:
    joints = walker(240)
    rotation, position = orbit(np.deg2rad(19.0) * np.arange(240) / FPS, joints[:, 0, :2])
    data = exact_input(joints, rotation, position, CameraTelemetry(rotation, position, FPS))
    leaning = exp_so3(np.array([np.deg2rad(8.0), 0.0, 0.0])) @ rotation
    depth = np.einsum("fpi,fi->fp", joints - joints[:, :1], leaning[:, 2])
    shared = np.zeros(GLOBALS)
    shared[SCALE] = 1.0
    found = adjust_in_world(replace(data, depth=depth), WorldState(joints, np.zeros((240, CAMERA)), shared))
    assert abs(np.degrees(found.turned[0])) < 0.2
    assert np.abs((found.joints - joints)[..., 2].mean()) < 0.04


def test_a_foot_that_looks_moving_is_not_in_contact() -> None:
    joints = walker(48)
    floor, seen = float(np.percentile(joints[:, ANKLES, 2], 2)), np.ones((48, 17), bool)

    def contact(looks: np.ndarray | None) -> np.ndarray:
        return RestingFeet(seen, FPS, looks).probability(joints, floor, 0.15)

    unknown = contact(None)
    right, left = np.array([0.98, 0.02])
    looks = contact(np.tile([right, left], (48, 1)))
    np.testing.assert_array_less(unknown[:, [0, 2]].mean(axis=0), looks[:, [0, 2]].mean(axis=0))
    np.testing.assert_array_less(looks[:, [1, 3]].mean(axis=0), 0.3 * unknown[:, [1, 3]].mean(axis=0))
    np.testing.assert_allclose(contact(np.full((48, 2), 0.5)), unknown)


def test_result_does_not_depend_on_where_the_origin_and_north_lie() -> None:
    view = tracks(walker(120))
    turn = exp_so3(np.array([0.0, 0.0, 1.1]))
    shift = np.array([300.0, -80.0, 40.0])
    moved = replace(
        view, camera_rotation=view.camera_rotation @ turn.T, camera_position=view.camera_position @ turn.T + shift
    )
    one, two = reconstruct(view), reconstruct(moved)
    np.testing.assert_allclose(two.joints3d, one.joints3d @ turn.T + shift, atol=5e-3)
    assert one.scale_source == two.scale_source


def test_body_and_camera_are_adjusted_in_one_thread_whatever_the_environment_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A second thread waits for its core beside another process: a factor of a hundred, and other last bits."""
    used: set[int] = set()

    def spied(*args: Any, **options: Any) -> Any:
        used.update(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        return adjust_in_world(*args, **options)

    monkeypatch.setattr(refine, "adjust_in_world", spied)
    with threadpool_limits(2):
        motion = reconstruct(tracks(walker(30), noise_px=2.0))
    assert used == {1}
    assert motion.meta["seconds"]["world"] > 0.0


def test_feet_in_contact_keep_their_place() -> None:
    joints = walker(240)
    motion = reconstruct(tracks(joints, noise_px=2.0))
    assert motion.frame == "world"
    assert motion.metric
    assert motion.camera_position is not None
    assert still_foot_speed(motion.joints3d, joints, FPS) < 0.1
    assert motion.covariance is not None
    assert ellipsoid_coverage(motion.joints3d, joints, motion.covariance) > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_a_short_person_gets_the_right_scale_from_still_feet(seed: int) -> None:
    """1.60 m where 1.75 m are assumed; feet of a walker rest for more than a fifth of the time."""
    joints = simulate_person(np.arange(360) / FPS, "walk", seed, 1.60, BODY_17)
    motion = reconstruct(tracks(joints, noise_px=2.0), initializer=InitializerConfig(assumed_height_m=1.75))
    assert motion.meta["calibration"][0]["contact_share"] > 0.2
    assert motion.metric
    assert abs(scale_error(motion.joints3d[:, :15], joints[:, :15])) < 0.02


@pytest.mark.parametrize(
    "wrong", ["jump", "yaw", "other flight", "similar flight", "stopped", "wholly frozen", "two seconds late"]
)
def test_wrong_telemetry_is_noticed_and_the_motion_falls_back_to_the_camera(wrong: str) -> None:
    view = tracks(walker(240))
    rotation, position = view.camera_rotation, view.camera_position
    assert rotation is not None
    assert position is not None
    if wrong == "jump":
        position = position + np.where(np.arange(240)[:, None] > 100, [5.0, 0.0, 0.0], 0.0)
    elif wrong == "yaw":
        rotation = rotation @ exp_so3(np.array([0.0, 0.0, np.deg2rad(40.0)]))
    elif wrong == "stopped":
        at = np.minimum(np.arange(240), 150)
        rotation, position = rotation[at], position[at]
    elif wrong == "wholly frozen":
        at = np.zeros(240, int)
        rotation, position = rotation[at], position[at]
    elif wrong == "similar flight":
        other = tracks(walker(240, seed=5))
        assert other.camera_rotation is not None
        assert other.camera_position is not None
        rotation, position = other.camera_rotation, other.camera_position
    elif wrong == "two seconds late":
        view = replace(
            view, keypoints=view.keypoints[48:], stamp_ns=view.stamp_ns[48:], camera_rotation=None, camera_position=None
        )
        rotation, position = rotation[:-48], position[:-48]
    else:
        rotation, position = rotation[::-1], 1.5 * position[::-1] + [20.0, 5.0, 3.0]
    motion = reconstruct(replace(view, camera_rotation=rotation.copy(), camera_position=position.copy()))
    assert motion.frame == "camera"
    assert not motion.metric
    assert "check" in motion.meta["telemetry_rejected"]


def test_logarithm_and_jacobian_of_rotations() -> None:
    rng = np.random.default_rng(3)
    v = rng.uniform(-1.7, 1.7, size=(20, 3))
    np.testing.assert_allclose(log_so3(exp_so3(v)), v, atol=1e-9)
    np.testing.assert_allclose(log_so3(exp_so3(1e-9 * v)), 1e-9 * v, atol=1e-15)
    d = 1e-6 * rng.normal(size=(20, 3))
    turned = exp_so3(np.einsum("nij,nj->ni", left_jacobian(v), d)) @ exp_so3(v)
    np.testing.assert_allclose(exp_so3(v + d), turned, atol=1e-11)


def tracks(joints: np.ndarray, noise_px: float = 0.0) -> Tracks:
    """An orbit of 19 deg/s around the person."""
    frames = len(joints)
    bearing = np.deg2rad(19.0) * np.arange(frames) / FPS
    rotation, position = orbit(bearing, followed(joints))
    keypoints = project(joints, rotation, position)
    keypoints = keypoints + noise_px * np.random.default_rng(0).normal(size=keypoints.shape)
    return Tracks(
        keypoints, BODY_17.joints, np.round(np.arange(frames) * 1e9 / FPS).astype(np.int64), (1280, 720),
        camera_rotation=rotation, camera_position=position, camera_matrix=MATRIX,
    )  # fmt: skip


def test_parameters_of_the_section_reach_the_adjustment() -> None:
    view = tracks(walker(120))
    accurate = BundleAdjusterConfig(telemetry_yaw_deg=0.01, telemetry_latency_s=0.001, feet=False)
    usual, stated = reconstruct(view), reconstruct(view, adjuster=accurate)
    yaw = [motion.meta["calibration"][0]["misalignment_std_deg"][1] for motion in (usual, stated)]
    assert yaw[1] < 0.02 < yaw[0]
    assert stated.meta["calibration"][0]["contact_share"] == 0.0
    assert stated.frame == "world"


def test_a_camera_that_never_moves_is_accepted_and_mentioned() -> None:
    joints = walker(96)
    view = tracks(joints)
    rotation, position = orbit(np.zeros(96), np.zeros((96, 2)))
    fixed = replace(
        view, keypoints=project(joints, rotation, position), camera_rotation=rotation, camera_position=position
    )
    for motion, mentioned in ((reconstruct(fixed), True), (reconstruct(view), False)):
        assert motion.frame == "world"
        assert ("never moves" in telemetry_words(motion.meta)) is mentioned
