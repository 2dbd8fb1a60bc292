"""The live start by the lifter: the newest image of a short past, lifted with the bone lengths seen so far."""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import NamedTuple

import numpy as np

from drocap_ros.leg_sides import exchange, exchanged_legs
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.method import even_slots
from drocap_ros.reconstruction.metrics import limb_lengths
from drocap_ros.reconstruction.paper.dictionary import LIMBS_PER_STATURE
from drocap_ros.skeleton import BODY_15

#: The proportions are looked at after so many images first, and then anew; so many looks are remembered.
FIRST_LOOK, LOOK_EVERY, LOOKS = 12, 24, 40

#: Images over which the size in the image is remembered.
SIZE = 30

_BONES = BODY_15.bones

#: Most images of the past, whatever their stamps say.
MOST_IMAGES = 400

#: Standard deviation of the start's errors, about the pelvis, over what the lifter expects: across and along the ray
#: (measured on the HDM05 sequences of mocap/train, from which it has not learned).
ACROSS, ALONG = 1.35, 1.5


class LiftedImage(NamedTuple):
    """joints (15, 3) px in camera axes, x and y in the image; std (15, 2) px across and along the ray; m per px."""

    joints: np.ndarray
    std: np.ndarray
    metres: float


class LiftedStart:
    """Remembers the last ``past_s`` of keypoints and the person's proportions."""

    def __init__(self, lifter: Lifter, past_s: float, height_m: float) -> None:
        self._lifter = lifter
        self._past_ns = round(past_s * 1e9)
        self._limbs_m = height_m * LIMBS_PER_STATURE
        self._past: deque[tuple[int, np.ndarray, np.ndarray]] = deque(maxlen=MOST_IMAGES)
        self._proportions: deque[np.ndarray] = deque(maxlen=LOOKS)
        self._since_look = 0
        self._limbs_px: deque[float] = deque(maxlen=SIZE)

    def forget_motion(self) -> None:
        """After a gap: the person is the same, where he or she was is worth nothing."""
        self._past.clear()
        self._limbs_px.clear()
        self._since_look = 0

    def forget_person(self) -> None:
        """Another person, or another time."""
        self.forget_motion()
        self._proportions.clear()

    def push(self, stamp_ns: int, keypoints: np.ndarray, confidence: np.ndarray) -> LiftedImage:
        """Lift the next image: keypoints (15, 2) px, NaN where not seen; confidence (15,)."""
        self._past.append((stamp_ns, keypoints, confidence))
        while self._past[0][0] < stamp_ns - self._past_ns:
            self._past.popleft()
        stamps = np.array([stamp for stamp, _, _ in self._past], np.int64)
        slot, fps = even_slots(stamps)
        points = np.full((slot[-1] + 1, *keypoints.shape), np.nan)
        belief = np.zeros(points.shape[:2])
        points[slot], belief[slot] = self._with_own_legs(stamps)
        self._since_look += 1
        if self._since_look >= (LOOK_EVERY if self._proportions else FIRST_LOOK):
            self._since_look = 0
            self._look(points, belief, fps)
        lifted = self._lifter.lift_last(points, belief, fps, self._lengths_px())
        joints = lifted.joints[0]
        self._limbs_px.append(max(float(limb_lengths(joints).sum()), 1e-9))
        metres = self._limbs_m / median(self._limbs_px)
        return LiftedImage(joints, lifted.sigma[0] * np.array([ACROSS, ALONG]), metres)

    def _with_own_legs(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and confidences of the past, the legs exchanged back where the network exchanged them."""
        points = np.array([k for _, k, _ in self._past])
        belief = np.array([c for _, _, c in self._past])
        wrong = exchanged_legs(points, belief, stamps, person_size(points))
        if not wrong.any():
            return points, belief
        points, _, belief = exchange(points, np.zeros((*belief.shape, 3)), belief, wrong)
        return points, belief

    def _look(self, points: np.ndarray, belief: np.ndarray, fps: float) -> None:
        # By a lifter that is told no lengths: told its own, it would believe itself more and more.
        joints = self._lifter.lift(points, belief, fps).joints
        lengths = np.linalg.norm(joints[:, _BONES[:, 1]] - joints[:, _BONES[:, 0]], axis=-1)
        self._proportions.append(np.median(lengths / limb_lengths(joints).sum(axis=-1, keepdims=True), axis=0))

    def _lengths_px(self) -> np.ndarray | None:
        if not self._proportions or not self._limbs_px:
            return None
        lengths: np.ndarray = np.median(np.array(self._proportions), axis=0) * median(self._limbs_px)
        return lengths


def person_size(keypoints: np.ndarray) -> np.ndarray:
    """(F,) px, the person's longer side in the images of keypoints (F, 15, 2), one for all: their median."""
    low = np.fmin.reduce(keypoints, axis=1)
    high = np.fmax.reduce(keypoints, axis=1)
    size = (high - low).max(axis=-1)
    known = size[np.isfinite(size)]
    return np.full(len(keypoints), np.median(known) if len(known) else 1.0)
