"""The live initializer on a synthetic walk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from live_stream import observed
from walking import Walk, make_walk

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import is_mirrored, pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.initializer import LiveInitializer, LivePose

FRAMES = 72
S = 10**9


def push(initializer: LiveInitializer, observation: PoseObservation) -> LivePose:
    pose = initializer.push(observation)
    assert pose is not None, initializer.event
    return pose


def joints(initializer: LiveInitializer, observations: Sequence[PoseObservation]) -> np.ndarray:
    return np.stack([push(initializer, o).joints3d for o in observations])


@pytest.fixture(scope="module")
def walked() -> tuple[Walk, list[LivePose]]:
    initializer = LiveInitializer()
    return make_walk(FRAMES), [push(initializer, o) for o in observed(FRAMES, covariance_px2=9.0)]


def test_every_image_gets_a_pose_near_the_truth(walked: tuple[Walk, list[LivePose]]) -> None:
    walk, poses = walked
    truth, found = 1000.0 * walk.in_camera, np.stack([p.joints3d for p in poses])
    assert pa_mpjpe(found, truth).mean() < 80.0
    assert not is_mirrored(found, truth)
    assert limb_lengths(found).sum(1).mean() == pytest.approx(1.70 * 1.78, rel=0.06)
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-12)
    assert max(p.reprojection_rms_px for p in poses) < 40.0


def test_covariance_is_larger_along_the_ray(walked: tuple[Walk, list[LivePose]]) -> None:
    covariance = np.mean([p.covariance[1:] for p in walked[1]], axis=0)
    assert np.all(covariance[:, [0, 3, 5]] > 0.0)
    assert covariance[:, 5].mean() > 3.0 * covariance[:, 0].mean()


def test_poses_are_deterministic_and_causal(walked: tuple[Walk, list[LivePose]]) -> None:
    again = joints(LiveInitializer(), observed(FRAMES, covariance_px2=9.0)[:20])
    np.testing.assert_array_equal(again, [p.joints3d for p in walked[1][:20]])


def test_a_time_jump_restarts_the_poses() -> None:
    initializer, images = LiveInitializer(), observed(30)
    first = joints(initializer, images)
    # One image far back in time may be a stray; the one after it confirms the jump.
    assert initializer.push(observed(1, -1000 * S)[0]) is None
    assert initializer.event is StreamEvent.STRAY
    np.testing.assert_array_equal(joints(initializer, observed(30, -999 * S)), first)
    assert initializer.event is StreamEvent.CONTINUED


def test_a_gap_keeps_the_proportions_alone() -> None:
    initializer = LiveInitializer()
    joints(initializer, observed(30))
    push(initializer, observed(1, 5 * S)[0])
    assert initializer.event is StreamEvent.GAP
    assert len(initializer._lifter._past) == 1
    assert len(initializer._lifter._proportions) == 1


def test_an_image_without_the_person_has_an_unknown_pose() -> None:
    initializer = LiveInitializer()
    for stamp_ns, value in enumerate((np.nan, 40.0)):
        pose = push(initializer, observed(1, stamp_ns, keypoints=np.full((1, 15, 2), value))[0])
        assert np.isnan(pose.joints3d).all()
        assert np.all(pose.confidence == 0.0)


def test_missing_joints_are_filled_in_with_confidence_zero() -> None:
    keypoints = make_walk(1).keypoints
    keypoints[:, [2, 11]] = np.nan
    pose = push(LiveInitializer(), observed(1, keypoints=keypoints)[0])
    assert np.isfinite(pose.joints3d).all()
    np.testing.assert_array_equal(pose.confidence[:15] == 0.0, np.isnan(keypoints[0, :, 0]))
    assert (pose.confidence[15:] == 0.0).all()  # this network sees no toes


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("keypoints", np.zeros((14, 2)), r"keypoints: expected shape \(15, 2\)"),
        ("keypoints", np.full((15, 2), np.inf), "infinity"),
        ("confidence", np.ones(3), "confidence: expected shape"),
        ("covariance", np.ones((15, 2)), "covariance: expected shape"),
        ("covariance", np.full((15, 3), np.inf), "positive definite"),
    ],
)
def test_wrong_arrays_are_refused(name: str, values: np.ndarray, words: str) -> None:
    (image,) = observed(1)
    with pytest.raises(InputError, match=words):
        LiveInitializer().push(PoseObservation(**{**vars(image), name: values}))


def test_memory_is_bounded_at_any_frame_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drocap_ros.reconstruction.live.initializer.MAX_IMAGES", 40)
    initializer = LiveInitializer(InitializerConfig(past_s=10.0))
    # 1000 images per second: the age bounds nothing, the counts do.
    for i, o in enumerate(observed(60) * 2):
        push(initializer, PoseObservation(**{**vars(o), "stamp_ns": i * 10**6}))
    assert len(initializer._lifter._past) == 40
    assert len(initializer._lifter._limbs_px) == 30
