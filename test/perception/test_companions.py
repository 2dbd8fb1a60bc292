"""Persons beside the subject, image after image, with the networks for simulation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import pytest
from people_scenes import PeopleScene, camera_of, images_of, of_another, people_of

from drocap_ros.observation import PoseObservation
from drocap_ros.perception.companions import Companions
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.sources.base import Frame
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

pytest.importorskip("onnxruntime")

SCENE = PeopleScene("walk", 3, duration_s=4.0, rate_hz=12.5, distance_m=7.0, orbit=False)
CONFIG = PoseEstimatorConfig(people=3)
MODELS = models_folder("simulation")
SCALE = 0.5
Shown = list[dict[int, PoseObservation]]


@lru_cache
def frames(who: tuple[int, ...] = (0, 1, 2)) -> list[Frame]:
    def small(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA)

    return [Frame(frame.stamp_ns, small(frame.image)) for frame in images_of(SCENE, people_of(SCENE), who)]


def followed(images: Sequence[Frame], companions: Companions | None = None) -> Shown:
    """Of each image the subject, place 1, and the others."""
    estimator = PoseEstimator(MODELS, CONFIG)
    others = companions or Companions(MODELS, CONFIG, itertools.count(1001))
    shown = []
    for frame in images:
        subject = estimator.process(frame.image, frame.stamp_ns)
        shown.append({1: subject, **others.process(frame.image, subject)})
    others.close()
    return shown


@pytest.fixture(scope="module")
def three() -> Shown:
    return followed(frames())


def keypoints(shown: Shown, track_id: int) -> np.ndarray:
    """(F, 15, 2) px of one person, NaN where it is in no place."""
    found = np.full((len(shown), 15, 2), np.nan)
    for i, places in enumerate(shown):
        for observation in places.values():
            if observation.track_id == track_id:
                found[i] = observation.keypoints[:15]
    return found


def test_three_are_followed_each_under_one_number_and_none_has_joints_of_another(three: Shown) -> None:
    ids = {o.track_id for places in three for o in places.values() if o.has_subject}
    assert ids == {1, 1001, 1002}
    truth = [SCALE * camera_of(SCENE).pixels(person) for person in people_of(SCENE)]
    owners = set()
    for track_id in ids:
        own = keypoints(three, track_id)
        off = [float(np.nanmedian(np.linalg.norm(own - person, axis=2))) for person in truth]
        who = int(np.argmin(off))
        owners.add(who)
        assert off[who] < 6.0
        if track_id > 1:  # the subject's estimator does not know of the others
            assert of_another(own, truth, who).any(axis=1).mean() < 0.05
        # Others have two detections, 0.2 s apart, before they are followed; one comes from behind another.
        # 35 of 50 images on one processor, more on another one: the networks' last bits differ.
        assert np.isfinite(own).all(axis=2).any(axis=1).mean() >= 0.7
    assert owners == {0, 1, 2}


def test_one_image_never_shows_one_person_twice(three: Shown) -> None:
    for places in three:
        ids = [o.track_id for o in places.values() if o.has_subject]
        assert len(set(ids)) == len(ids)


def test_others_do_not_touch_what_is_known_of_the_subject(three: Shown) -> None:
    estimator = PoseEstimator(MODELS, CONFIG)
    for frame, places in zip(frames(), three, strict=True):
        alone = estimator.process(frame.image, frame.stamp_ns)
        np.testing.assert_array_equal(alone.keypoints, places[1].keypoints)
        np.testing.assert_array_equal(alone.covariance, places[1].covariance)
        np.testing.assert_array_equal(alone.confidence, places[1].confidence)
        assert alone.track_id == places[1].track_id


def test_who_leaves_frees_the_place_and_a_number_is_never_given_twice(three: Shown) -> None:
    """Someone vanishes for three seconds and is there again, then everything begins anew with earlier stamps."""
    own = keypoints(three, 1001)
    truth = [SCALE * camera_of(SCENE).pixels(person) for person in people_of(SCENE)]
    gone = int(np.argmin([np.nanmedian(np.linalg.norm(own - person, axis=2)) for person in truth]))
    whole, without = frames(), frames(tuple(k for k in range(3) if k != gone))
    companions = Companions(MODELS, CONFIG, itertools.count(1001))
    first = followed(whole[:15] + without[15:], companions)
    assert {o.track_id for o in first[14].values()} == {1, 1001, 1002}
    place = next(n for n, o in first[14].items() if o.track_id == 1001)
    assert np.isnan(keypoints(first[16:], 1001)).all()
    hidden_s = (first[15][place].stamp_ns - first[14][place].stamp_ns) * 1e-9
    assert all(places[place].has_subject for places in first[15 : 15 + round(1.9 / hidden_s)])
    assert not any(places[place].has_subject for places in first[15 + round(2.2 / hidden_s) :])
    assert companions.followed == [1002]
    second = followed(whole, companions)
    again = {o.track_id for places in second for n, o in places.items() if n > 1} - {0}
    assert again == {1003, 1004}
    assert {o.track_id for places in second for n, o in places.items() if n == place} - {0}
