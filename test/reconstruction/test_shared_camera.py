"""Several persons before one camera: one path, one world, and right places in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, orbit, points_of, seen

from drocap_ros.background import Background
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.people import reconstruct_people
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

FPS, FRAMES = 24.0, 120
#: Mean places (m) of three persons who walk, and their statures (m).
PLACES = np.array([[0.0, 0.0, 0.0], [1.4, 0.6, 0.0], [-0.8, 1.2, 0.0]])
STATURES = (1.7, 1.55, 1.85)


def truth(number: int) -> np.ndarray:
    """(F, 15, 3) m of a person."""
    joints = simulate_person(np.arange(FRAMES) / FPS, "walk", number, STATURES[number])
    moved: np.ndarray = joints - joints[:, 0].mean(axis=0) * [1.0, 1.0, 0.0] + PLACES[number]
    return moved


def people(rotation: np.ndarray, position: np.ndarray) -> dict[int, Tracks]:
    """Tracks of the persons and of fixed points, without telemetry; the third comes later and goes earlier."""
    scene = seen(rotation, position, points_of(np.random.default_rng(5), 150), FPS)
    noise = np.random.default_rng(3).normal(0.0, 0.3, scene.point.shape)
    background = Background(
        scene.frame.astype(np.int32), scene.track.astype(np.int64), (scene.point + noise).astype(np.float32)
    )
    found = {}
    for number in range(len(PLACES)):
        joints = (truth(number) - position[:, None]) @ np.swapaxes(rotation, 1, 2)
        pixels = joints[..., :2] / joints[..., 2:] * np.diagonal(MATRIX)[:2] + MATRIX[:2, 2]
        pixels += np.random.default_rng([4, number]).normal(0.0, 1.0, pixels.shape)
        if number == 2:
            pixels[:20] = pixels[100:] = np.nan
        stamps = np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
        found[number + 1] = Tracks(pixels, BODY_15.joints, stamps, SIZE, camera_matrix=MATRIX, background=background)
    return found


@pytest.fixture(scope="module")
def motions() -> dict[int, Motion]:
    return reconstruct_people(people(*orbit(FRAMES, FPS)))


def test_camera_is_one_and_that_of_the_person_seen_most(motions: dict[int, Motion]) -> None:
    alone = reconstruct(people(*orbit(FRAMES, FPS))[1])
    np.testing.assert_array_equal(motions[1].joints3d, alone.joints3d)
    place = alone.camera_position
    assert place is not None
    for number, rows in ((1, slice(0, FRAMES)), (2, slice(0, FRAMES)), (3, slice(20, 100))):
        motion = motions[number]
        np.testing.assert_array_equal(motion.stamp_ns, alone.stamp_ns[rows])
        np.testing.assert_array_equal(motion.camera_position, place[rows])
        np.testing.assert_array_equal(motion.camera_rotation, alone.camera_rotation[rows])
        assert motion.frame == "world"
        assert motion.meta["camera_found_with"] == 1
        assert np.nanmedian(motion.reprojection_px) < 2.5


def test_distances_and_sizes_are_right_in_the_metres_of_the_first(motions: dict[int, Motion]) -> None:
    def height(joints: np.ndarray) -> float:
        neck, ankle = BODY_15.index("neck"), BODY_15.index("lankle")
        return float(np.median(np.linalg.norm(joints[:, neck] - joints[:, ankle], axis=1)))

    unit = height(motions[1].joints3d) / height(truth(0))
    for number in (2, 3):
        rows = slice(20, 100)
        other = motions[number].joints3d[rows if number == 2 else slice(None)]
        apart = np.linalg.norm(other[:, 0] - motions[1].joints3d[rows, 0], axis=1)
        expected = np.linalg.norm(truth(number - 1)[rows, 0] - truth(0)[rows, 0], axis=1)
        np.testing.assert_allclose(np.median(apart / expected), unit, rtol=0.08)
        assert height(other) / height(truth(number - 1)) == pytest.approx(unit, rel=0.05)


def test_persons_without_a_world_are_each_in_the_cameras_axes() -> None:
    given = {number: replace(t, background=None) for number, t in people(*orbit(FRAMES, FPS)).items()}
    found = reconstruct_people(given)
    np.testing.assert_array_equal(found[2].joints3d, reconstruct(given[2]).joints3d)
    assert {motion.frame for motion in found.values()} == {"camera"}


def test_telemetry_is_corrected_once() -> None:
    rotation, position = orbit(FRAMES, FPS)
    given = {
        number: replace(t, camera_rotation=rotation, camera_position=position)
        for number, t in people(rotation, position).items()
    }
    found = reconstruct_people(given)
    assert found[1].metric
    place = found[1].camera_position
    assert place is not None
    for number, rows in ((2, slice(0, FRAMES)), (3, slice(20, 100))):
        np.testing.assert_array_equal(found[number].camera_position, place[rows])
        assert found[number].meta["calibration"][0]["scale_std"] < 0.06
        off = np.linalg.norm(found[number].joints3d[:, :15] - truth(number - 1)[rows], axis=2)
        assert np.median(off) < 0.12
