"""The steps of an image beside each other: the same observations with any number of threads."""

import threading

import numpy as np
import pytest
from rendered_person import rendered_images

from drocap_ros.perception import track_video
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import SIMULATION, models_folder
from drocap_ros.perception.scene import Scene
from drocap_ros.perception.sources.base import Frame, in_order
from drocap_ros.perception.track_video import observe
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

pytest.importorskip("onnxruntime")

STEP_NS = 33_333_333


@pytest.fixture(scope="module")
def frames():
    """A moving person; one picture comes twice, and the stamps go back once."""
    images = rendered_images(20)
    images.insert(8, images[7].copy())
    stamps = [*range(15), *range(3, 9)]
    return [Frame(stamp * STEP_NS, image) for stamp, image in zip(stamps, images, strict=True)]


def test_observations_are_the_same_bit_for_bit_with_one_thread_and_with_more(frames):
    one, more = (observe(iter(frames), PoseEstimator(models_folder(SIMULATION)), threads=threads) for threads in (1, 3))
    assert any(np.isfinite(seen.keypoints).any() for seen in one)
    for a, b in zip(one, more, strict=True):
        assert (a.track_id, a.background is None) == (b.track_id, b.background is None)
        for name in ("keypoints", "covariance", "confidence", "roi"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        if a.background is not None:
            assert np.array_equal(a.background.track, b.background.track)
            assert np.array_equal(a.background.point, b.background.point)


def detector_runs(frames, threads):
    """The thread of each run of the detector, and the roi of each image, of images that all need the detector."""
    estimator = PoseEstimator(models_folder(SIMULATION), PoseEstimatorConfig(detect_every_s=0.0))
    detect, runs = estimator.detector.detect, []

    def counted(*arguments):
        runs.append(threading.current_thread())
        return detect(*arguments)

    estimator.detector.detect = counted
    return runs, [seen.roi for seen in observe(iter(frames), estimator, threads=threads)]


def test_the_detector_runs_beside_the_pose_network_and_hardly_more_often(frames):
    (alone, rois), (shared, same) = (detector_runs(frames[:15], threads) for threads in (1, 2))
    assert np.array_equal(rois, same)
    assert set(alone) == {threading.current_thread()}
    assert sum(thread is not threading.current_thread() for thread in shared) > len(shared) / 2
    assert len(shared) <= len(alone) + 2


def test_of_a_long_recording_the_points_of_every_second_or_fourth_image_are_kept(frames, monkeypatch):
    monkeypatch.setattr(track_video, "MOST_ROWS", 400)
    seen = observe(iter(frames[:15]), PoseEstimator(models_folder(SIMULATION)))
    kept = [i for i, observation in enumerate(seen) if observation.background is not None]
    assert 2 < len(kept) < 8
    assert min(np.diff(kept)) in (2, 4)
    assert not (np.array(kept) % min(np.diff(kept))).any()  # but for the picture that came twice
    assert sum(len(seen[i].background) for i in kept) <= 400


def test_a_step_that_was_begun_for_another_image_is_not_taken(frames):
    estimator = PoseEstimator(models_folder(SIMULATION))
    estimator.process(frames[0].image, 0, ahead=frames[5])
    seen = estimator.process(frames[1].image, STEP_NS)
    scene = Scene()
    for frame, stamp_ns in ((frames[0], 0), (frames[5], frames[5].stamp_ns), (frames[1], STEP_NS)):
        step = scene.step(frame.image, stamp_ns, [])
    assert len(seen.background) > 10
    assert np.isin(seen.background.track, step.points.track).all()


def test_points_on_a_person_end_where_the_camera_has_moved_them(frames):
    scene = Scene()
    image = frames[0].image
    first = scene.step(image, 0, []).points
    middle = np.median(first.point, axis=0)
    box = np.concatenate([middle - 150.0, middle + 150.0])
    inside = ((first.point > box[:2]) & (first.point < box[2:])).all(axis=1)
    assert inside.sum() > 3
    moved = np.roll(image, 30, axis=1)
    step = scene.step(moved, STEP_NS, [box])
    assert step.motion is not None
    place = step.points.point - [30.0, 0.0]
    on_it = ((place > box[:2]) & (place < box[2:])).all(axis=1)
    assert not on_it.any()


def test_where_there_is_no_time_points_are_followed_ten_times_a_second_unless_the_camera_pans(frames):
    image, scene = frames[0].image, Scene()
    still = [np.roll(image, i % 2, axis=0) for i in range(13)]  # each differs from the one before
    steps = [scene.step(picture, i * STEP_NS, [], seldom=True) for i, picture in enumerate(still)]
    assert [i for i, step in enumerate(steps) if step.points is not None] == [0, 3, 6, 9, 12]
    assert not any(step.again for step in steps)
    assert np.isin(steps[12].points.track, steps[0].points.track).mean() > 0.7
    assert scene.step(still[12], 13 * STEP_NS, [], seldom=True).again
    pan = [scene.step(np.roll(image, 40 * i, axis=1), (20 + i) * STEP_NS, [], seldom=True) for i in range(1, 6)]
    assert all(step.points is not None for step in pan[1:])
    assert all(step.motion is not None for step in pan[1:])


def test_calls_in_order_raise_their_errors():
    seen = []

    def call(number):
        if number == 2:
            raise ValueError("two")
        seen.append(number)

    def submit_all():
        with in_order(call, waiting=2) as submit:
            for number in range(5):
                submit(number)

    with pytest.raises(ValueError, match="two"):
        submit_all()
    assert seen[:2] == [0, 1]
