"""The simulation's networks: accuracy on rendered orbits, metadata, selection, training."""

import argparse
import logging

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import limited_use, models_folder
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.render.body import dress
from drocap_ros.simulation.render.renderer import draw
from drocap_ros.simulation.render.scenery import make_scenery
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.simulation.orbit import orbit_camera
from lab.training.rendered_samples import (
    DETECTOR_SIZE,
    FIRST_SEED,
    POSE_SIZE,
    detector_sample,
    make_world,
    pose_sample,
)

FOLDER = models_folder("simulation")
SIDES = [i for i in range(len(BODY_15)) if BODY_15.mirror[i] != i]


def overlap(a, b):
    both = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None).prod()
    return both / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - both)


def as_received(image):
    """The image after the JPEG of the image topic."""
    import cv2

    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_COLOR)


class Flown:
    """Results of the estimator on orbits about persons in sceneries that no training used."""

    def __init__(self, orbits=3, images=20):
        matrix = pinhole_matrix(1280, 720, 60)
        self.found, self.followed, self.off, self.exchanged, self.standard, self.confidence = [], [], [], [], [], []
        for seed in range(orbits):
            assert seed < FIRST_SEED
            t = 0.7 + 14.4 / images * np.arange(images)  # once round at 25 deg/s
            joints = simulate_person(t, "mixed", seed, 1.65 + 0.1 * seed)
            centre = joints[:, 0] * [1, 1, 0] + [0, 0, 0.9]
            rotation, position = orbit_camera(t, centre, 6.0, 2.5, 25.0, 70.0 * seed)
            truth = project(joints, rotation, position, matrix)
            estimator = PoseEstimator(FOLDER, PoseEstimatorConfig(detect_every_s=0.0))
            scene, look = make_scenery(seed), dress(seed)
            for i in range(images):
                image, box = draw(scene, look, matrix, (1280, 720), joints[i], rotation[i], position[i])
                image = as_received(image)
                whole = estimator.detector.detect(image, None, estimator.config.detection_threshold)
                self.found.append(len(whole) > 0 and overlap(whole.boxes[0], box) > 0.5)
                # Images 0.2 s apart for the tracker: the person moves as far in one as at 15 fps in three.
                self._compare(estimator.process(image, i * 200_000_000), truth[i], box)

    def _compare(self, observation, truth, box):
        self.followed.append(observation.has_subject)
        if not observation.has_subject:
            return
        difference = observation.keypoints - truth
        height = box[3] - box[1]
        self.off.append(np.linalg.norm(difference, axis=1) / height)
        mirrored = np.linalg.norm(observation.keypoints - truth[BODY_15.mirror], axis=1) / height
        self.exchanged.append(np.nanmean(mirrored[SIDES]) < np.nanmean(self.off[-1][SIDES]))
        self.standard.append(difference / np.sqrt(observation.covariance[:, [0, 2]]))
        self.confidence.append(observation.confidence)


@pytest.fixture(scope="module")
def flown():
    return Flown()


def test_person_is_detected_and_tracked_in_whole_images(flown):
    assert np.mean(flown.found) >= 0.99
    assert np.mean(flown.followed) >= 0.99


def test_mean_keypoint_error_is_within_one_and_a_half_percent_of_the_box(flown):
    off = np.array(flown.off)
    assert np.isfinite(off).mean() > 0.95
    assert np.nanmean(off) <= 0.015


def test_left_and_right_are_not_exchanged(flown):
    assert np.mean(flown.exchanged) < 0.01


def test_covariance_matches_the_errors(flown):
    standard = np.array(flown.standard)
    sure = np.array(flown.confidence) > 0.5
    assert 0.7 <= np.sqrt(np.nanmean(standard[sure] ** 2)) <= 1.5


def test_empty_scenery_has_no_subject():
    matrix = pinhole_matrix(1280, 720, 60)
    estimator = PoseEstimator(FOLDER)
    away = simulate_person(np.array([0.0]), "stand")[0] + np.array([0, -500.0, 0])
    for seed in range(8):
        position = np.array([[1.0, 2.0 + seed, 2.5]])
        rotation = orbit_camera(np.zeros(1), np.zeros((1, 3)), 6.0, 2.5, 0.0, 90.0)[0][0]
        image, box = draw(make_scenery(seed), dress(0), matrix, (1280, 720), away, rotation, position[0])
        assert box is None
        assert not estimator.process(image, seed * 100_000_000).has_subject


def test_both_files_are_small_and_state_their_purpose():
    files = sorted(FOLDER.glob("*.onnx"))
    assert [f.name for f in files] == ["person_detector.onnx", "person_pose.onnx"]
    assert sum(f.stat().st_size for f in files) <= 3_000_000
    for file in files:
        model = OnnxModel(file)
        assert model.metadata["only_for"] == "simulation"
        assert "not for pictures of real people" in limited_use(model)
        assert model.metadata["command"].startswith("drocap train-simulation-models")


def test_use_of_the_simulation_networks_is_reported(caplog, capsys):
    with caplog.at_level(logging.WARNING):
        estimator = PoseEstimator(FOLDER)
    assert "for simulation only" in caplog.text
    assert "for simulation only" in estimator.limited_use
    assert main(["models", "list", "--models", "simulation"]) == 0
    assert capsys.readouterr().out.count("for simulation only") == 2
    assert main(["models", "check", "--models", "simulation"]) == 0
    assert "body15" in capsys.readouterr().out


def test_missing_models_do_not_fall_back_to_them(tmp_path, monkeypatch):
    monkeypatch.delenv("DROCAP_MODELS", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert models_folder(None) != FOLDER
    with pytest.raises(InputError, match="drocap models fetch"):
        PoseEstimator(models_folder(None))
    monkeypatch.setenv("DROCAP_MODELS", "simulation")
    assert models_folder(None) == FOLDER
    assert models_folder(tmp_path) == tmp_path


def test_labels_of_samples_lie_inside_their_images():
    """Boxes lie inside the input, visible joints inside the crop."""
    rng = np.random.default_rng(4)
    world = make_world(rng, scenes=2, takes=1)
    for _ in range(12):
        sample = detector_sample(world, rng)
        assert sample.image.shape == (DETECTOR_SIZE[1], DETECTOR_SIZE[0], 3)
        if np.isfinite(sample.box).all():
            assert (sample.box >= 0).all()
            assert (sample.box <= [*DETECTOR_SIZE, *DETECTOR_SIZE]).all()
        crop = pose_sample(world, rng)
        assert crop.image.shape == (POSE_SIZE[1], POSE_SIZE[0], 3)
        inside = ((crop.joints > -0.5) & (crop.joints < np.array(POSE_SIZE) - 0.5)).all(axis=1)
        assert not (crop.seen & ~inside).any()
    assert world.poses[..., 2].min() > 0


def run_command(folder, *words):
    from lab.commands import build_parser

    args: argparse.Namespace = build_parser().parse_args(["train-simulation-models", "--out", str(folder), *words])
    return args.run(args)


def test_short_training_writes_networks_that_run(tmp_path, capsys):
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    assert run_command(tmp_path / "m", "--steps", "1") == 0
    assert "1 batches of the detector, 2 of the pose network" in capsys.readouterr().out
    estimator = PoseEstimator(tmp_path / "m")
    assert estimator.limited_use
    assert estimator.pose_model.joints is BODY_15
    assert 0.1 <= estimator.pose_model.spec.sigma_scale <= 10.0
    assert "sigma_scale: " in (tmp_path / "m" / "person_pose.yaml").read_text()
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    assert estimator.pose_model.estimate(image, np.array([50.0, 20, 150, 200])).xy.shape == (15, 2)


def test_a_box_has_positive_cells_of_one_stride_alone():
    from lab.training.simulation_networks import detector_targets, grid

    boxes = np.array([[100.0, 40, 140, 120], [10, 10, 22, 40], [0, 0, 190, 180], [np.nan] * 4], np.float32)
    positive, free = detector_targets(boxes)
    _, stride = grid()
    for i, strides in enumerate(({16}, {8}, {32}, set())):
        assert set(stride[positive[i]].astype(int)) == strides
        assert set(stride[free[i]].astype(int)) <= strides
    assert not (positive & free).any()


def test_training_of_given_steps_depends_on_the_seed_alone():
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    from lab.training.simulation_models import SimulationTraining, train

    def weights():
        detector, pose, _ = train(
            SimulationTraining(steps=2, batch=4, seed=3), lambda line: None, lambda *networks: None
        )
        return torch.cat([w.detach().ravel() for network in (detector, pose) for w in network.parameters()])

    assert torch.equal(weights(), weights())
