"""The view of a camera that looks at the person, there and back, with the covariance; lenses that are assumed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.geometry.alignment import similarity
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.body_input import body_keypoints
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, Report
from drocap_ros.reconstruction.person_view import PersonView, person_view, true_shape, with_lens
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.tracks import Tracks, load_tracks, save_tracks
from lab.studies.near_camera import NearCamera, error_mm, known, without_camera
from lab.studies.protocol import Sequence, protocol_sequences


def people() -> Sequence:
    """Points of a size of a person about the first one, its pelvis."""
    x = np.random.default_rng(0).uniform(-500.0, 500.0, (30, 17, 3))
    x[:, 0] = 0.0
    return Sequence("cloud", x)


def view_of(tracks: Tracks) -> PersonView:
    view = person_view(body_keypoints(tracks), tracks.camera_matrix, tracks.camera_rotation, tracks.image_size)
    assert view is not None
    return view


@pytest.mark.parametrize("camera", [NearCamera(3.3, aside_deg=20.0, roll_deg=26.0), NearCamera(6.0, pitch_deg=50.0)])
def test_a_pose_of_the_view_explains_the_image_and_keeps_its_shape(camera: NearCamera) -> None:
    people_here = people()
    tracks = camera.tracks(people_here)
    view = view_of(tracks)
    assert tracks.camera_rotation is not None
    assert tracks.camera_position is not None
    from_camera = people_here.x / 1000.0 - tracks.camera_position[:, None]
    seen = from_camera @ np.swapaxes(view.turn @ tracks.camera_rotation, 1, 2)
    focal, range_m = view.focal[0], seen[:, :1, 2]
    flat = seen[..., :2] / seen[..., 2:] * focal + view.centre
    pose = np.concatenate([flat, ((seen[..., 2] - range_m) * focal / range_m)[..., None]], axis=-1)
    np.testing.assert_allclose(view.keypoints(body_keypoints(tracks)).xy, flat, atol=1e-6)
    in_image = view.in_image(ImagePoses.uncentred(pose, Report())).in_image
    np.testing.assert_allclose(in_image[..., :2], tracks.keypoints, atol=1e-6)
    truth = (people_here.x - people_here.x[:, :1]) @ np.swapaxes(tracks.camera_rotation, 1, 2)
    shape = true_shape(in_image, tracks.camera_matrix)
    size = np.linalg.norm(truth, axis=(1, 2)) / np.linalg.norm(shape, axis=(1, 2))
    np.testing.assert_allclose(shape * size[:, None, None], truth, atol=1e-6 * 500.0)


def test_the_view_is_upright_and_looks_at_the_person() -> None:
    tracks = NearCamera(3.3, aside_deg=25.0, roll_deg=-40.0).tracks(people())
    view = view_of(tracks)
    rotation = view.rotation(tracks.camera_rotation)
    assert rotation is not None
    np.testing.assert_allclose(rotation[:, 0, 2], 0.0, atol=1e-9)  # gravity has no part to the side
    assert (rotation[:, 1, 2] < 0.0).all()
    torso = view.keypoints(body_keypoints(tracks)).xy[:, [0, 1, 4, 7]].mean(axis=(0, 1))
    assert np.abs(torso - view.centre).max() < 0.1 * view.focal[0]


def test_a_camera_that_looks_at_the_person_upright_sees_the_view_itself() -> None:
    tracks = NearCamera(5.0).tracks(people())
    points = np.full((30, 17, 2), np.array(tracks.image_size) / 2)
    points[:, [3, 6, 8], 1] += [80.0, 90.0, -70.0]  # ankles and head; the torso is in the middle
    seen = Keypoints2D(points)
    view = person_view(seen, tracks.camera_matrix, tracks.camera_rotation, tracks.image_size)
    assert view is not None
    np.testing.assert_allclose(view.turn, np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(view.keypoints(seen).xy, seen.xy, atol=1e-6)


def test_covariances_turn_with_the_points() -> None:
    tracks = NearCamera(3.3, aside_deg=20.0, roll_deg=30.0).tracks(people())
    view, rng = view_of(tracks), np.random.default_rng(1)
    covariance = np.broadcast_to([4.0, 1.0, 2.0], (*tracks.keypoints.shape[:2], 3))
    exact = Keypoints2D(tracks.keypoints, None, covariance)
    drawn = rng.multivariate_normal([0.0, 0.0], [[4.0, 1.0], [1.0, 2.0]], (4000,))
    moved = np.stack([view.keypoints(Keypoints2D(tracks.keypoints + d)).xy[0, 3] for d in drawn])
    found = view.keypoints(exact).covariance
    assert found is not None
    sampled = np.cov(moved.T)
    np.testing.assert_allclose(found[0, 3], sampled[[0, 0, 1], [0, 1, 1]], rtol=0.1, atol=0.1)


def test_a_lens_is_assumed_for_real_pictures_alone_and_has_no_place_in_the_world() -> None:
    tracks = known(NearCamera(3.3).tracks(people()), lens=False, rotation=True, position=True)
    assert with_lens(tracks, 0.85) is tracks
    real = dataclasses.replace(tracks, real_lens=True)
    assert with_lens(real, 0.0) is real
    assumed = with_lens(real, 0.85)
    assert assumed.camera_matrix is not None
    assert assumed.camera_matrix[0, 0] == pytest.approx(0.85 * 1280)
    assert assumed.camera_position is None
    given = dataclasses.replace(real, camera_matrix=NearCamera(3.3).tracks(people()).camera_matrix)
    assert with_lens(given, 0.85) is given


def test_a_tracks_file_keeps_whether_a_lens_may_be_assumed(tmp_path: Path) -> None:
    tracks = known(NearCamera(3.3).tracks(people()), lens=False, rotation=False, position=False)
    for real in (False, True):
        save_tracks(tmp_path / "tracks.npz", dataclasses.replace(tracks, real_lens=real))
        with np.load(tmp_path / "tracks.npz") as file:
            assert ("lens" in file.files) == real
            assert not real or file["lens"] == "assumed"
        assert load_tracks(tmp_path / "tracks.npz").real_lens == real


@pytest.fixture(scope="module")
def sequences(shared: Path) -> list[Sequence]:
    return protocol_sequences(shared / "mocap" / "dev")[::6][:4]


def test_a_motion_says_where_its_lens_comes_from(sequences: list[Sequence]) -> None:
    tracks = NearCamera(3.3).tracks(sequences[0])
    nothing = known(tracks, lens=False, rotation=False, position=False)
    real = dataclasses.replace(nothing, real_lens=True)
    assert reconstruct(nothing).meta["lens"] == "unknown"
    assert reconstruct(real).meta["lens"] == "assumed"
    assert not reconstruct(dataclasses.replace(tracks, camera_matrix=None, real_lens=True)).metric
    assert reconstruct(real, adjuster=BundleAdjusterConfig(assumed_focal=0.0)).meta["lens"] == "unknown"
    assert reconstruct(tracks).meta["lens"] == "given"


@pytest.fixture(scope="module")
def near_errors(sequences: list[Sequence]) -> dict[tuple[int, int, int], float]:
    """Error (mm) from 3.3 m by what is known: lens, rotation, position."""

    def error(case: tuple[int, int, int]) -> float:
        lens, rotation, position = map(bool, case)
        return error_mm(
            sequences, NearCamera(3.3), lambda tracks: known(tracks, lens=lens, rotation=rotation, position=position)
        )

    return {case: error(case) for case in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 1, 1), (1, 1, 1)]}


def test_more_knowledge_of_a_near_camera_is_never_worse(near_errors: dict[tuple[int, int, int], float]) -> None:
    """Every combination of lens, rotation and position against each with less, to 3 % (four sequences' noise)."""
    for more in near_errors:
        for less in near_errors:
            if all(a >= b for a, b in zip(more, less, strict=True)):
                assert near_errors[more] <= 1.03 * near_errors[less], f"{near_errors}: {more} against {less}"


def test_a_rolled_or_turned_camera_changes_little(
    sequences: list[Sequence], near_errors: dict[tuple[int, int, int], float]
) -> None:
    """5 %, the issue's bound, where lens and rotation are known."""
    for camera in (NearCamera(3.3, roll_deg=26.0), NearCamera(3.3, aside_deg=20.0)):
        turned = error_mm(sequences, camera, lambda tracks: dataclasses.replace(tracks, camera_position=None))
        assert turned <= 1.05 * near_errors[1, 1, 0]


def test_a_person_aside_does_not_lean_with_an_assumed_lens(sequences: list[Sequence]) -> None:
    """The ray to it is 17 to 20 degrees off the axis: a method that took it as in the middle is turned back."""
    camera = NearCamera(6.0, aside_deg=20.0)
    for sequence in sequences[:2]:
        tracks = camera.tracks(sequence)
        assert tracks.camera_rotation is not None
        motion = reconstruct(dataclasses.replace(without_camera(tracks), real_lens=True))
        truth = (sequence.x - sequence.x[:, :1]) @ np.swapaxes(tracks.camera_rotation, 1, 2)
        found = motion.joints3d[:, : truth.shape[1]]
        _, turn, _ = similarity((found - found[:, :1]).reshape(-1, 3), truth.reshape(-1, 3))
        assert abs(np.degrees(log_so3(turn)[1])) < 7.0
