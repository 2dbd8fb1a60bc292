"""Boxes that a doubtful subject may be instead: which of them are looked at again."""

from __future__ import annotations

import numpy as np
from test_doubtful_subject import box_of, drawn, judged
from test_subject_tracking import RED, STEP, Scene

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.tracking.other_poses import OtherPoses


class PoseOf:
    """A pose that is believed where its box lies on the person."""

    mean_confidence = 0.9

    def __init__(self, box: np.ndarray) -> None:
        self.found = box

    def belief(self, image, box) -> float:
        return 0.9 if iou(self.found[None].astype(float), box_of(300, 180, 160)[None])[0, 0] > 0.5 else 0.3

    def box(self, confidence, share) -> None:
        return None


class Looks:
    """A pose model that remembers the boxes in which it looked."""

    def __init__(self) -> None:
        self.boxes: list[list[float]] = []

    def estimate(self, image, box) -> PoseOf:
        self.boxes.append(box.tolist())
        return PoseOf(box)


def test_box_that_lost_against_a_better_one_of_its_image_is_looked_at_in_the_next_and_a_shadow_is_not():
    scene, looks, person = Scene(), Looks(), (300, 180, 160, RED)
    others = OtherPoses(scene.tracker, looks)
    for _ in range(5):
        judged(scene, 0.9, scene.show([person]))
    exact, loose = box_of(300, 180, 160), box_of(300, 180, 160) + np.array([-6, -6, 6, 6])
    shadow = np.array([340.0, 230, 420, 260])
    around = np.array([260.0, 100, 430, 260])

    def compete(boxes) -> np.ndarray:
        subject = scene.show([person], detections=[(around, 0.8)])
        found = Detections(np.array([around, *boxes]), np.linspace(0.8, 0.5, 1 + len(boxes)))
        stamp = (scene.index - 1) * STEP
        return others.compete(drawn([person]), stamp, subject, PoseOf(subject.box), found, False)[0].box

    assert compete([exact, loose]).tolist() == exact.tolist()
    assert looks.boxes == [exact.tolist(), loose.tolist()]
    assert compete([loose]).tolist() == loose.tolist()
    looks.boxes.clear()
    assert compete([shadow]).tolist() == around.tolist()
    assert compete([shadow]).tolist() == around.tolist()
    assert looks.boxes == [shadow.tolist()]
