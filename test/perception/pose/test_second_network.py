"""Feet and joints in space of a body that one network finds, by a second network."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_models import write_model

from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.load_models import load_feet_model
from drocap_ros.perception.models.network_input import crop_around
from drocap_ros.perception.pose.body_pose import BodyPose
from drocap_ros.perception.pose.pose_model import NetworkKeypoints
from drocap_ros.perception.track_video import tracks_from_observations
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15, BODY_19, COCO_21

IMAGE = np.zeros((400, 300, 3), np.uint8)
#: A person who faces the camera, px.
PLACE = {
    "pelvis": (150, 200), "rhip": (135, 200), "rknee": (133, 270), "rankle": (130, 340), "lhip": (165, 200),
    "lknee": (167, 270), "lankle": (170, 340), "neck": (150, 100), "head": (150, 70), "lshoulder": (175, 110),
    "lelbow": (185, 150), "lwrist": (190, 190), "rshoulder": (125, 110), "relbow": (115, 150), "rwrist": (110, 190),
}  # fmt: skip
FEET = {"rtoe": (125, 358), "ltoe": (175, 358), "rheel": (132, 348), "lheel": (168, 348)}
NAMES = {"big_toe": "toe", "heel": "heel"}
BOX = np.array([100.0, 60.0, 200.0, 370.0])


@pytest.fixture
def pose():
    xy = np.array([PLACE[name] for name in BODY_15.joints], float)
    ones = np.ones(len(xy))
    network = NetworkKeypoints("body15", xy, ones, np.zeros((15, 3)), 0 * ones, 310.0)
    return BodyPose(xy, np.tile([4.0, 0.0, 4.0], (15, 1)), ones, network)


def second(folder, pose, places):
    """A network whose output is that the person's joints are at these places of the image."""
    crop = crop_around(pose.box(), (256, 256), 1.25)
    rows = []
    for name in COCO_21.joints:
        side, _, part = name.partition("_")
        ours = f"{side[0]}{NAMES.get(part, part)}"
        x, y = (np.array(places.get(ours, places["head"])) - (np.array(crop.origin) + 0.5)) * crop.scale / 256 + 0.5
        rows.append((y, x, 0.9))
    space = np.arange(63, dtype=np.float32).reshape(1, 21, 3)
    outputs = {"out": np.array(rows, np.float32)[None, None], "space": space}
    write_model(folder / "feet.onnx", (1, 3, 256, 256), outputs)
    (folder / "feet.yaml").write_text("layout: movenet\nskeleton: coco21\n")
    return load_feet_model(folder, PoseEstimatorConfig(feet_model="feet"))


def of(pose, *names):
    return pose.xy[[BODY_19.index(name) for name in names]]


def test_the_first_network_places_the_body_and_the_second_its_feet(tmp_path, pose):
    elsewhere = {name: (x + 4, y - 3) for name, (x, y) in PLACE.items()}
    found = second(tmp_path, pose, elsewhere | FEET).add(IMAGE, BOX, pose)
    np.testing.assert_array_equal(found.xy[:15], pose.xy)
    np.testing.assert_allclose(of(found, *FEET), list(FEET.values()), atol=0.3)
    assert (found.confidence[15:] > 0.5).all()
    np.testing.assert_allclose(found.space[BODY_19.index("rheel")], [60, 61, 62])  # the last of COCO's with feet


def test_a_foot_belongs_to_the_leg_whose_ankle_it_has(tmp_path, pose):
    """The second network takes right for left: its feet are exchanged, its depths are not believed."""
    other = {"r": "l", "l": "r"}
    exchanged = {other.get(name[0], "") + name[1:]: xy for name, xy in (PLACE | FEET).items() if name[0] in other}
    found = second(tmp_path, pose, exchanged | {"head": PLACE["head"]}).add(IMAGE, BOX, pose)
    np.testing.assert_allclose(of(found, *FEET), list(FEET.values()), atol=0.3)
    assert found.space is None


def test_the_feet_of_another_person_in_the_box_are_not_taken(tmp_path, pose):
    aside = {name: (x + 70, y) for name, (x, y) in (PLACE | FEET).items()}
    found = second(tmp_path, pose, aside).add(IMAGE, BOX, pose)
    assert np.isnan(of(found, *FEET)).all()
    np.testing.assert_array_equal(found.xy[:15], pose.xy)


def test_a_network_without_feet_is_refused(tmp_path):
    rows = np.full((1, 1, 17, 3), 0.5, np.float32)
    write_model(tmp_path / "plain.onnx", (1, 3, 256, 256), {"out": rows}, layout="movenet")
    with pytest.raises(InputError, match=r"plain\.onnx: expected a network with toes and heels .* found coco17"):
        load_feet_model(tmp_path, PoseEstimatorConfig(feet_model="plain"))


def test_joints_in_space_are_those_of_the_camera_that_looks_past_the_person():
    """A person at the right border who stands straight towards the camera looks turned about the vertical."""
    size, count = (1000, 600), len(BODY_19)
    space = np.zeros((count, 3), np.float32)
    space[BODY_19.index("rtoe")] = (0, 0, -0.2)  # towards the camera
    rows = []
    for i, x in enumerate((499.5, 999.0)):
        box = np.array([x - 50, 200, x + 50, 399], np.float32)
        xy = np.full((count, 2), [x, 300.0], np.float32)
        arrays = np.ones((count, 3), np.float32), np.ones(count, np.float32)
        rows.append(PoseObservation(i * 10**7, 1, size, BODY_19, box, 1.0, xy, *arrays, space=space))
    tracks = tracks_from_observations(rows)
    assert tracks.evidence_sigma is None  # measured in the recording, across the image
    toe = tracks.evidence[:, BODY_19.index("rtoe")]
    np.testing.assert_allclose(toe[0], [0, 0, -0.2], atol=1e-3)
    angle = np.arctan(0.5 / 0.85)  # of a lens of 0.85 of the width
    np.testing.assert_allclose(toe[1], -0.2 * np.array([np.sin(angle), 0, np.cos(angle)]), atol=2e-3)
