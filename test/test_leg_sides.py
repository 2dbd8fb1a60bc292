from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.leg_sides import exchange_legs, exchanged_legs, with_own_legs
from drocap_ros.skeleton import BODY_15

FRAMES = 120
LEGS = {s: [BODY_15.index(s + "knee"), BODY_15.index(s + "ankle")] for s in "lr"}


def walk_from_the_side(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A person of 300 px walks from the left to the right, seen from the side, 30 images a second."""
    rng = np.random.default_rng(seed)
    t = np.arange(FRAMES) / 30
    xy = np.zeros((FRAMES, 15, 2))
    xy[..., 0] = 100 + 120 * t[:, None]
    for side, phase in (("l", 0.0), ("r", np.pi)):
        swing = np.sin(2 * np.pi * 0.9 * t + phase)
        for joint, reach, y in zip(LEGS[side], (35, 70), (220, 300), strict=True):
            xy[:, joint, 0] += reach * swing
            xy[:, joint, 1] = y
    xy += rng.normal(0, 2.0, xy.shape)
    return xy, np.full((FRAMES, 15), 0.95), (t * 1e9).astype(np.int64), np.full(FRAMES, 300.0)


def test_exchanged_legs_are_exchanged_back():
    xy, confidence, stamps, size = walk_from_the_side()
    wrong = np.zeros(FRAMES, bool)
    wrong[20:26] = wrong[55] = wrong[70:80] = True
    confidence[wrong] = 0.7
    spoiled = exchange_legs(Keypoints2D(xy, confidence), wrong)
    corrected = with_own_legs(spoiled, stamps, size).xy
    ankles = [LEGS["l"][1], LEGS["r"][1]]
    apart = np.abs(xy[:, ankles[0], 0] - xy[:, ankles[1], 0]) > 30  # where the legs stand together sides mean nothing
    off = np.abs(corrected[:, ankles] - xy[:, ankles]).max(axis=(1, 2)) > 20
    assert not (off & apart).any()
    before = np.abs(spoiled.xy[:, ankles] - xy[:, ankles]).max(axis=(1, 2)) > 20
    assert (before & apart).sum() >= 10


def test_correct_legs_of_a_confident_network_stay():
    xy, confidence, stamps, size = walk_from_the_side(1)
    assert not exchanged_legs(Keypoints2D(xy, confidence), stamps, size).any()


def test_unseen_legs_stay():
    xy, confidence, stamps, size = walk_from_the_side(2)
    xy[30:60] = np.nan
    confidence[30:60] = 0.0
    assert not exchanged_legs(Keypoints2D(xy, confidence), stamps, size).any()
    assert not exchanged_legs(Keypoints2D(np.full_like(xy, np.nan)), stamps, size).any()
