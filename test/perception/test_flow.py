"""Keypoints propagated by optical flow."""

import cv2
import numpy as np
import pytest

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_shedding import KeypointFlow
from drocap_ros.skeleton import BODY_15

STEP_NS = 33_333_333


@pytest.fixture
def scene():
    """A textured image (480, 640, 3) and a person in it."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    image = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX)
    count = len(BODY_15)
    box = np.array([250, 120, 390, 380], np.float32)
    observation = PoseObservation(
        1_000_000_000, 3, (640, 480), BODY_15, box, 0.9,
        rng.uniform([260, 130], [380, 370], (count, 2)).astype(np.float32),
        np.tile(np.float32([4.0, 1.0, 9.0]), (count, 1)), rng.uniform(0.5, 1, count).astype(np.float32),
    )  # fmt: skip
    return image, observation


def moved(image, dx, dy):
    return cv2.warpAffine(image, np.float32([[1, 0, dx], [0, 1, dy]]), (640, 480), borderMode=cv2.BORDER_REFLECT)


def test_joints_and_box_move_with_the_image_and_covariance_grows(scene):
    image, before = scene
    flow = KeypointFlow()
    flow.start(image, before)
    for k in (1, 2, 3):
        after = flow.propagate(moved(image, 6.5 * k, -3.25 * k), before.stamp_ns + k * STEP_NS)
        assert flow.steps == k
        np.testing.assert_allclose(after.keypoints - before.keypoints, np.tile([6.5 * k, -3.25 * k], (15, 1)), atol=0.5)
        np.testing.assert_allclose(after.roi - before.roi, np.tile([6.5 * k, -3.25 * k], 2), atol=0.5)
        assert (after.stamp_ns, after.track_id) == (before.stamp_ns + k * STEP_NS, 3)
        np.testing.assert_array_equal(after.confidence, before.confidence)
        gain = after.covariance - before.covariance
        assert (gain[:, [0, 2]] > 0.9 * k * (0.005 * 260) ** 2).all()
        np.testing.assert_allclose(gain[:, 1], 0)


def test_covered_joint_is_nan_and_the_others_are_not(scene):
    image, before = scene
    flow = KeypointFlow()
    flow.start(image, before)
    later = moved(image, 4, 0)
    covered = int(before.keypoints[:, 1].argmin())
    x, y = before.keypoints[covered].astype(int)
    later[y - 40 : y + 40, x - 40 : x + 40] = np.random.default_rng(1).integers(0, 255, (80, 80, 3))
    after = flow.propagate(later, before.stamp_ns + STEP_NS)
    assert np.isnan(after.keypoints[covered]).all()
    assert np.isnan(after.covariance[covered]).all()
    assert after.confidence[covered] == 0
    far = np.linalg.norm(before.keypoints - before.keypoints[covered], axis=1) > 100
    np.testing.assert_allclose((after.keypoints - before.keypoints)[far], np.tile([4, 0], (far.sum(), 1)), atol=0.5)


def test_unseen_joint_stays_nan(scene):
    image, before = scene
    before.keypoints[4], before.covariance[4], before.confidence[4] = np.nan, np.nan, 0
    flow = KeypointFlow()
    flow.start(image, before)
    after = flow.propagate(image, before.stamp_ns + STEP_NS)
    assert np.flatnonzero(np.isnan(after.keypoints).any(axis=1)).tolist() == [4]


@pytest.mark.parametrize(
    ("change", "dt_ns"),
    [
        (lambda image: image, 0),
        (lambda image: image, -STEP_NS),
        (lambda image: image, 200_000_000),
        (lambda image: image[:-2], STEP_NS),
        (lambda image: image[::-1].copy(), STEP_NS),
        (np.zeros_like, STEP_NS),
    ],
    ids=["same time", "earlier", "much later", "another size", "a cut", "dark"],
)
def test_unrelated_images_give_no_keypoints(scene, change, dt_ns):
    image, before = scene
    flow = KeypointFlow()
    flow.start(image, before)
    assert flow.propagate(change(image), before.stamp_ns + dt_ns) is None
    assert flow.steps == 0


def test_reference_without_keypoints_gives_none(scene):
    image, before = scene
    flow = KeypointFlow()
    assert flow.propagate(image, STEP_NS) is None
    for kept in (None, image):
        flow.start(kept, PoseObservation(before.stamp_ns, 0, (640, 480)))
        assert flow.propagate(image, before.stamp_ns + STEP_NS) is None
    before.keypoints[:] = np.nan
    flow.start(image, before)
    assert flow.propagate(image, before.stamp_ns + STEP_NS) is None


def test_flow_agrees_with_the_network_on_a_real_person(shared):
    video = cv2.VideoCapture(str(shared / "media" / "pose_1.mp4"))
    estimator, flow, gaps = PoseEstimator(shared / "models"), KeypointFlow(), []
    for i in range(60):
        image = video.read()[1]
        network = estimator.process(image, i * STEP_NS)
        propagated = flow.propagate(image, i * STEP_NS)
        if propagated is not None:
            sure = (propagated.confidence > 0.5) & (network.confidence > 0.5)
            gap = np.linalg.norm(propagated.keypoints - network.keypoints, axis=1)
            gaps.append((flow.steps, gap[sure] / (network.roi[2:] - network.roi[:2]).max()))
        if propagated is None or flow.steps == 3:
            flow.start(image, network)
    assert len(gaps) >= 40
    assert np.median(np.concatenate([g for steps, g in gaps if steps == 1])) < 0.005
    assert np.median(np.concatenate([g for steps, g in gaps if steps == 3])) < 0.01
    assert np.percentile(np.concatenate([g for _, g in gaps]), 95) < 0.04
