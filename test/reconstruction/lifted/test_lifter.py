"""The lifter: invariances, bad input, and accuracy on held-out people."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.evaluation.protocol import PX_PER_MM, orbit_view, protocol_sequences
from drocap_ros.reconstruction.lifted.lifter import SHIPPED, Lifter
from drocap_ros.skeleton import BODY_15


@pytest.fixture(scope="module")
def lifter():
    return Lifter.load()


def walker(frames: int, seed: int = 0) -> np.ndarray:
    """Keypoints (F, 15, 2) px of a body-like set of points that sways."""
    rng = np.random.default_rng(seed)
    body = np.zeros((15, 2))
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            body[joint] = body[parent] + rng.normal(0, 60, 2) + (0, -40 if joint >= 7 else 60)
    time = np.arange(frames)[:, None, None]
    return 500 + body + 20 * np.sin(0.2 * time + rng.uniform(0, 6, (1, 15, 2)))


def test_shipped_network_names_its_training_data_and_is_small(lifter):
    origin = lifter.origin
    assert "CMU" in origin["licence"]
    assert "cmu_*" in origin["command"]
    assert int(origin["frames_seen"]) > 1_000_000
    assert SHIPPED.stat().st_size < 4 << 20


def test_result_follows_scale_and_position_in_the_image(lifter):
    points = walker(50)
    here = lifter.lift(points)
    there = lifter.lift(3.0 * points - np.array([700.0, -90.0]))
    moved = 3.0 * here.joints - np.array([700.0, -90.0, 0.0])
    np.testing.assert_allclose(there.joints, moved, atol=0.05)
    np.testing.assert_allclose(there.sigma, 3.0 * here.sigma, rtol=1e-3)


def test_mirrored_keypoints_give_the_mirrored_pose(lifter):
    points = walker(48)
    here = lifter.lift(points).joints
    there = lifter.lift((points * np.array([-1, 1]))[:, BODY_15.mirror]).joints
    np.testing.assert_allclose(there, (here * np.array([-1, 1, 1]))[:, BODY_15.mirror], atol=0.05)


def test_equal_input_gives_equal_bits(lifter):
    points = walker(300)
    first, second = lifter.lift(points), Lifter.load(SHIPPED).lift(points)
    assert np.array_equal(first.joints, second.joints)
    assert np.array_equal(first.sigma, second.sigma)


@pytest.mark.parametrize("frames", [1, 2, 3, 241, 700])
@pytest.mark.parametrize("fps", [5.0, 24.0, 60.0])
def test_every_length_and_rate_gives_finite_poses(lifter, frames, fps):
    result = lifter.lift(walker(frames), fps=fps)
    assert result.joints.shape == (frames, 15, 3)
    assert result.sigma.shape == (frames, 15, 2)
    assert np.isfinite(result.joints).all()
    assert (result.sigma > 0).all()
    assert np.array_equal(result.joints[:, 0, 2], np.zeros(frames))


def test_missing_joints_and_frames_are_estimated(lifter):
    points = walker(60)
    whole = lifter.lift(points).joints
    points[10:20, 9] = np.nan
    points[30] = np.nan
    points[:, 14] = np.nan
    filled = lifter.lift(points).joints
    assert np.isfinite(filled).all()
    # Seen joints stay where they are in the image.
    apart = np.linalg.norm((filled - whole)[..., :2], axis=-1)
    assert np.median(apart[40:, 1:7]) < 15.0


def test_given_bone_lengths_change_the_result_towards_them(lifter):
    points = walker(60)
    free = lifter.lift(points).joints
    length = np.median(np.linalg.norm(free[:, 1:] - free[:, list(BODY_15.parents[1:])], axis=-1), axis=0)
    longer_pose = lifter.lift(points, lengths=1.3 * length).joints
    longer = np.median(np.linalg.norm(longer_pose[:, 1:] - longer_pose[:, list(BODY_15.parents[1:])], axis=-1), axis=0)
    assert (longer > length).mean() > 0.7


def test_bad_input_is_refused_in_one_line(lifter, tmp_path):
    bad = tmp_path / "no.onnx"
    bad.write_bytes(b"no network")
    for call in (
        lambda: lifter.lift(np.zeros((4, 14, 2))),
        lambda: lifter.lift(np.zeros((0, 15, 2))),
        lambda: lifter.lift(np.full((4, 15, 2), np.nan)),
        lambda: lifter.lift(walker(4), np.ones((4, 14))),
        lambda: lifter.lift(walker(4), fps=0.0),
        lambda: lifter.lift(walker(4), fps=float("nan")),
        lambda: Lifter.load(bad),
        lambda: Lifter.load(tmp_path / "absent.onnx"),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_error_on_held_out_people_stays_low(lifter, shared):
    sequences = protocol_sequences(shared / "mocap" / "dev", limit=4)
    errors = []
    for sequence in sequences:
        view = orbit_view(sequence.x, 25.0)
        joints = lifter.lift(view.tracks.keypoints).joints
        errors.append(pa_mpjpe(joints / PX_PER_MM, view.truth).mean())
    assert np.mean(errors) < 38.0
