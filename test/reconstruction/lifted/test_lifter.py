"""The lifter: invariances, bad input, and accuracy on held-out people."""

from __future__ import annotations

import os

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.lifted.lifter import SHIPPED, Lifter
from drocap_ros.reconstruction.lifted.network import LifterInput
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17
from lab.studies.protocol import PX_PER_MM, orbit_rotations, orbit_view, protocol_sequences


@pytest.fixture(scope="module")
def lifter():
    return Lifter.load()


def walker(frames: int, seed: int = 0) -> np.ndarray:
    """Keypoints (F, 17, 2) px of a body-like set of points that sways."""
    rng = np.random.default_rng(seed)
    body = np.zeros((17, 2))
    for joint, parent in enumerate(BODY_17.parents):
        if parent >= 0:
            body[joint] = body[parent] + rng.normal(0, 60, 2) + (0, -40 if 7 <= joint < 15 else 60)
    time = np.arange(frames)[:, None, None]
    return 500 + body + 20 * np.sin(0.2 * time + rng.uniform(0, 6, (1, 17, 2)))


def test_shipped_network_names_its_training_data_and_is_small(lifter):
    origin = lifter.origin
    assert "CMU" in origin["licence"]
    assert "cmu_*" in origin["command"]
    assert int(origin["frames_seen"]) > 1_000_000
    assert SHIPPED.stat().st_size < 8 << 20


def test_the_quick_twin_gives_the_same_newest_pose_but_for_its_rounding(lifter):
    quick = Lifter.load(quick=True)
    assert quick.origin == lifter.origin
    person = simulate_person(np.arange(192) / 24.0, joint_set=BODY_17)
    points = 1000.0 * PX_PER_MM * person[..., [0, 2]] * np.array([1.0, -1.0])
    apart = []
    for end in range(36, len(points), 12):
        seen = LifterInput(points[end - 36 : end])
        apart.append(quick.lift_last(seen).joints - lifter.lift_last(seen).joints)
    millimetres = np.linalg.norm(apart, axis=-1) / PX_PER_MM
    assert 0.0 < np.median(millimetres) < 4.0  # a tenth of the error of a newest pose
    assert np.quantile(millimetres, 0.99) < 20.0


def test_result_follows_scale_and_position_in_the_image(lifter):
    points = walker(50)
    here = lifter.lift(LifterInput(points))
    there = lifter.lift(LifterInput(3.0 * points - np.array([700.0, -90.0])))
    moved = 3.0 * here.joints - np.array([700.0, -90.0, 0.0])
    np.testing.assert_allclose(there.joints, moved, atol=0.05)
    np.testing.assert_allclose(there.sigma, 3.0 * here.sigma, rtol=1e-3)


def test_mirrored_keypoints_give_the_mirrored_pose(lifter):
    points = walker(48)
    here = lifter.lift(LifterInput(points)).joints
    there = lifter.lift(LifterInput((points * np.array([-1, 1]))[:, BODY_17.mirror])).joints
    np.testing.assert_allclose(there, (here * np.array([-1, 1, 1]))[:, BODY_17.mirror], atol=0.05)


def test_mirrored_camera_and_errors_give_the_mirrored_result(lifter):
    frames = 48
    rng = np.random.default_rng(2)
    turn = exp_so3(np.cumsum(rng.normal(0, 0.01, (frames, 3)), axis=0)) @ orbit_rotations(frames, 25.0)
    spread = rng.uniform(2.0, 20.0, (frames, 17, 2))
    covariance = np.stack([spread[..., 0] ** 2, 0.6 * spread.prod(axis=-1), spread[..., 1] ** 2], axis=-1)
    points = walker(frames)
    here = lifter.lift(LifterInput(points, covariance=covariance, rotation=turn, focal=900.0))
    across = np.diag([-1.0, 1.0, 1.0])
    there = lifter.lift(
        LifterInput(
            (points * np.array([-1, 1]))[:, BODY_17.mirror],
            covariance=(covariance * np.array([1, -1, 1]))[:, BODY_17.mirror],
            rotation=across @ turn @ across,
            focal=900.0,
        )
    )
    np.testing.assert_allclose(there.joints, (here.joints @ across)[:, BODY_17.mirror], atol=0.05)
    np.testing.assert_allclose(there.sigma, here.sigma[:, BODY_17.mirror], rtol=1e-3)
    np.testing.assert_allclose(there.still, here.still[:, ::-1], atol=1e-3)


def test_frames_between_those_of_a_slow_camera_are_empty_and_it_turns_evenly():
    turn = orbit_rotations(5, 25.0)
    dense = LifterInput(walker(5), covariance=np.ones((5, 17, 3)), rotation=turn[::2][[0, 0, 1, 1, 2]]).spread(2)
    assert np.isfinite(dense.keypoints[::2]).all()
    assert np.isnan(dense.keypoints[1::2]).all()
    even = LifterInput(walker(3), rotation=turn[::2]).spread(2)
    np.testing.assert_allclose(even.rotation, turn, atol=1e-9)


def test_equal_input_gives_equal_bits(lifter):
    points = walker(300)
    first, second = lifter.lift(LifterInput(points)), Lifter.load(SHIPPED).lift(LifterInput(points))
    assert np.array_equal(first.joints, second.joints)
    assert np.array_equal(first.sigma, second.sigma)


@pytest.mark.parametrize("frames", [1, 2, 3, 241, 700])
@pytest.mark.parametrize("fps", [5.0, 24.0, 60.0])
def test_every_length_and_rate_gives_finite_poses(lifter, frames, fps):
    result = lifter.lift(LifterInput(walker(frames)), fps=fps)
    assert result.joints.shape == (frames, 17, 3)
    assert result.sigma.shape == (frames, 17, 2)
    assert np.isfinite(result.joints).all()
    assert (result.sigma > 0).all()
    assert np.array_equal(result.joints[:, 0, 2], np.zeros(frames))


def test_missing_joints_and_frames_are_estimated(lifter):
    points = walker(60)
    whole = lifter.lift(LifterInput(points)).joints
    points[10:20, 9] = np.nan
    points[30] = np.nan
    points[:, 14] = np.nan
    filled = lifter.lift(LifterInput(points)).joints
    assert np.isfinite(filled).all()
    # Seen joints stay where they are in the image.
    apart = np.linalg.norm((filled - whole)[..., :2], axis=-1)
    assert np.median(apart[40:, 1:7]) < 15.0


def test_toes_that_a_network_drew_leave_the_body_alone_and_turn_the_feet(lifter):
    seen = walker(40)
    low, unseen = seen.copy(), seen.copy()
    low[:, 15:] += (0, 60)
    unseen[:, 15:] = np.nan
    body = lifter.lift(LifterInput(unseen))
    here, there = (lifter.lift_toes_apart(LifterInput(points)) for points in (seen, low))
    np.testing.assert_array_equal(there.joints[:, :15], body.joints[:, :15])
    np.testing.assert_array_equal(here.joints[:, :15], body.joints[:, :15])
    ankles = [BODY_17.index("rankle"), BODY_17.index("lankle")]
    feet = [found.joints[:, 15:, 1] - found.joints[:, ankles, 1] for found in (here, there)]
    every = lifter.lift(LifterInput(low)).joints
    np.testing.assert_allclose(feet[1], every[:, 15:, 1] - every[:, ankles, 1], atol=1e-9)
    # Feet are of one length: they follow toes that are drawn 60 lower by a third of it or more.
    assert (np.median(feet[1] - feet[0], axis=0) > 20).all()
    np.testing.assert_array_equal(lifter.lift_toes_apart(LifterInput(unseen)).joints, body.joints)


def test_given_bone_lengths_change_the_result_towards_them(lifter):
    body = simulate_person(np.arange(60) / 24, "walk", 3, 1.8)[:, :15]
    points = np.full((60, 17, 2), np.nan)
    points[:, :15] = 400.0 * body[..., [1, 2]] * [1, -1]
    free = lifter.lift(LifterInput(points)).joints
    length = np.median(np.linalg.norm(free[:, 1:] - free[:, list(BODY_17.parents[1:])], axis=-1), axis=0)
    longer_pose = lifter.lift(LifterInput(points, lengths=1.3 * length)).joints
    longer = np.median(np.linalg.norm(longer_pose[:, 1:] - longer_pose[:, list(BODY_17.parents[1:])], axis=-1), axis=0)
    assert (longer > length).mean() > 0.7


def test_bad_input_is_refused_in_one_line(lifter, tmp_path):
    bad = tmp_path / "no.onnx"
    bad.write_bytes(b"no network")
    for call in (
        lambda: lifter.lift(LifterInput(np.zeros((4, 14, 2)))),
        lambda: lifter.lift(LifterInput(np.zeros((0, 17, 2)))),
        lambda: lifter.lift(LifterInput(np.full((4, 17, 2), np.nan))),
        lambda: lifter.lift(LifterInput(walker(4), np.ones((4, 14)))),
        lambda: lifter.lift(LifterInput(walker(4), covariance=np.ones((4, 17)))),
        lambda: lifter.lift(LifterInput(walker(4), rotation=np.eye(3))),
        lambda: lifter.lift(LifterInput(walker(4), lengths=np.ones(14))),
        lambda: lifter.lift(LifterInput(walker(4)), fps=0.0),
        lambda: lifter.lift(LifterInput(walker(4)), fps=float("nan")),
        lambda: Lifter.load(bad),
        lambda: Lifter.load(tmp_path / "absent.onnx"),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_file_that_was_written_again_is_loaded_again(tmp_path):
    path = tmp_path / "lifter.onnx"
    path.write_bytes(SHIPPED.read_bytes())
    first = Lifter.load(path)
    assert Lifter.load(path) is first
    path.write_bytes(b"no network")
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match="expected an ONNX network"):
        Lifter.load(path)


def test_error_on_held_out_people_stays_low(lifter, shared):
    sequences = protocol_sequences(shared / "mocap" / "dev", limit=4)
    errors = []
    for sequence in sequences:
        view = orbit_view(sequence.x, 25.0)
        toes = np.full((len(view.truth), 2, 2), np.nan)
        joints = lifter.lift(LifterInput(np.concatenate([view.tracks.keypoints[:, :15], toes], axis=1))).joints[:, :15]
        errors.append(pa_mpjpe(joints / PX_PER_MM, view.truth[:, :15]).mean())
    assert np.mean(errors) < 38.0
