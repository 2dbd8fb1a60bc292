"""The default pair of models (RTMDet-nano, PP-TinyPose) on real recordings with known keypoints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.people import find_persons
from drocap_ros.perception.pose.body_pose import calibrate
from drocap_ros.perception.pose.pose_model import NetworkKeypoints
from drocap_ros.perception.sources import open_source
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15, COCO_17

#: COCO's spread of human labels per joint, share of the square root of the person's area.
COCO_SIGMAS = np.array([26, 25, 25, 35, 35, 79, 79, 72, 72, 62, 62, 107, 107, 87, 87, 89, 89]) / 1000
BLAZEPOSE_AS_COCO = [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
LIMBS = slice(5, 17)


@pytest.fixture(scope="module")
def models(shared: Path) -> Path:
    pytest.importorskip("onnxruntime")
    return shared / "models"


def labelled(shared: Path) -> dict[str, tuple[np.ndarray, int]]:
    """Recording -> keypoints (F, 17, 2) px, and the stride of the images."""
    media = shared / "media"
    skier = json.loads((media / "skier_keypoints.json").read_text())["persons"][0]
    named = json.loads((media / "pose_1_keypoints2d.json").read_text())
    squats = np.array(json.loads((media / "pose_squats_landmarks2d.json").read_text()))
    return {
        "skier.jpg": (np.array(skier["keypoints_xyv_coco17"], float).reshape(1, 17, 3)[..., :2], 1),
        "pose_1.mp4": (np.array([[[f[j]["x"], f[j]["y"]] for j in COCO_17.joints] for f in named]), 6),
        "pose_squats.mp4": (squats[:, BLAZEPOSE_AS_COCO, :2], 4),
    }


@pytest.fixture(scope="module")
def seen(models: Path, shared: Path) -> dict[str, list[tuple[NetworkKeypoints, np.ndarray, np.ndarray]]]:
    """Recording -> (keypoints, box, truth) of each labelled image."""
    out: dict[str, list[tuple[NetworkKeypoints, np.ndarray, np.ndarray]]] = {}
    for name, (truth, step) in labelled(shared).items():
        estimator = PoseEstimator(models)
        out[name] = []
        with open_source(shared / "media" / name) as source:
            for i, frame in enumerate(source):
                if i % step == 0:
                    observation = estimator.process(frame.image, frame.stamp_ns)
                    assert observation.track_id == 1
                    out[name].append((estimator.keypoints, observation.roi, truth[i]))
    return out


def test_object_keypoint_similarity_of_the_skier(seen, shared):
    keypoints, _, truth = seen["skier.jpg"][0]
    area = json.loads((shared / "media" / "skier_keypoints.json").read_text())["persons"][0]["area"]
    squared = ((keypoints.xy - truth) ** 2).sum(axis=1)
    similarity = np.exp(-squared / (2 * area * (2 * COCO_SIGMAS) ** 2)).mean()
    assert similarity >= 0.9


@pytest.mark.parametrize(("name", "percent"), [("pose_1.mp4", 3.0), ("pose_squats.mp4", 2.0)])
def test_mean_distance_to_the_labels_is_small(seen, name, percent):
    distance = [np.linalg.norm(k.xy - truth, axis=1)[LIMBS].mean() / (box[3] - box[1]) for k, box, truth in seen[name]]
    assert 100 * np.mean(distance) <= percent


def test_standardized_errors_have_unit_spread(seen):
    errors = []
    for rows in seen.values():
        for keypoints, _, truth in rows:
            covariance, _ = calibrate(keypoints, "heatmap")
            error = (keypoints.xy - truth)[LIMBS]
            errors.append(error / np.sqrt(covariance[LIMBS][:, [0, 2]]))
    assert 0.8 <= np.concatenate(errors).std() <= 1.25


def test_equal_images_give_equal_bits_and_the_whole_body(models, shared):
    with open_source(shared / "media" / "skier.jpg") as source:
        image = source.read().image
    first, second = (PoseEstimator(models).process(image, 0) for _ in range(2))
    assert (first.keypoints == second.keypoints).all()
    assert first.joints is BODY_15
    assert np.isfinite(first.keypoints).all()
    assert first.keypoints.dtype == np.float32
    y = dict(zip(BODY_15.joints, first.keypoints[:, 1], strict=True))
    assert y["head"] < y["neck"] < y["pelvis"] < y["lknee"] < y["lankle"]
    assert (first.covariance[:, 0] * first.covariance[:, 2] > first.covariance[:, 1] ** 2).all()


@pytest.mark.parametrize("shape", [(1, 1, 3), (9000, 12000, 3), (8, 4000, 3)])
def test_images_of_any_shape_are_accepted(models, shape):
    observation = PoseEstimator(models).process(np.zeros(shape, np.uint8), 0)
    assert observation.track_id == 0
    assert observation.keypoints.shape == (0, 2)


def test_person_in_a_huge_image_is_found(models, shared):
    import cv2

    with open_source(shared / "media" / "skier.jpg") as source:
        image = source.read().image
    huge = cv2.resize(image, (12000, 7968), interpolation=cv2.INTER_NEAREST)
    small = PoseEstimator(models).process(image, 0)
    large = PoseEstimator(models).process(huge, 0)
    assert large.track_id == 1
    scale = 12000 / image.shape[1]
    limbs = [BODY_15.index(j) for j in ("lknee", "rknee", "rwrist", "relbow")]
    distance = np.linalg.norm(large.keypoints[limbs] / scale - small.keypoints[limbs], axis=1)
    assert distance.max() < 12


def test_stamps_that_go_back_restart_the_tracker(models, shared, caplog):
    with open_source(shared / "media" / "skier.jpg") as source:
        image = source.read().image
    estimator = PoseEstimator(models)
    assert estimator.process(image, 10**9).track_id == 1
    assert estimator.process(image, 0).track_id == 2
    assert "stamps went back" in caplog.text


def test_person_close_to_the_camera_keeps_one_track(models, shared):
    estimator = PoseEstimator(models, PoseEstimatorConfig(on_loss="next"))
    ids = []
    with open_source(shared / "media" / "one_by_one_person_detection.mp4") as source:
        for i, frame in enumerate(source):
            if i > 130:
                break
            if i >= 50:
                ids.append(estimator.process(frame.image, frame.stamp_ns).track_id)
    assert set(ids[:8]) == {0}
    assert set(ids[14:]) == {1}


@pytest.mark.parametrize(("size", "images"), [((1280, 720), 8), ((3840, 2160), 28)])
def test_small_person_in_a_large_image_is_found_and_kept(models, shared, size, images):
    import cv2

    estimator = PoseEstimator(models)
    with open_source(shared / "media" / "pose_squats.mp4") as source:
        person = cv2.resize(source.read().image[100:760, 150:520], None, fx=0.15, fy=0.15, interpolation=cv2.INTER_AREA)
    ground = np.random.default_rng(0).normal(110, 12, (size[1] // 8, size[0] // 8, 3)).clip(0, 255).astype(np.uint8)
    image = cv2.resize(ground, size, interpolation=cv2.INTER_LINEAR)
    x, y = int(0.6 * size[0]), int(0.55 * size[1])
    image[y : y + person.shape[0], x : x + person.shape[1]] = person
    ids = [estimator.process(image, i * 33_000_000).track_id for i in range(images + 4)]
    assert set(ids[images:]) == {1}
    assert set(ids) <= {0, 1}


def test_person_whose_track_goes_over_to_clutter_keeps_his_number(models, shared):
    """The man on the wall of `outdoor_walk` jumps off; his box then follows a hole in the leaves."""
    with open_source(shared / "media" / "outdoor_walk.mp4") as source:
        frames = [frame for i, frame in enumerate(source) if 72 <= i < 192]
    man, woman = find_persons(frames, models, PoseEstimatorConfig())
    assert man.first_ns == frames[0].stamp_ns
    assert all(box[3] < 470 for box in man.boxes.values())  # px: on the wall
    assert woman.last_ns > man.last_ns
