"""Input and result of every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.evidence import Evidence
from drocap_ros.reconstruction.common.spread import Spread
from drocap_ros.reconstruction.common.stop_reason import NO_ADJUSTMENT

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class MethodInput:
    """Keypoints of one person and the parameters of the methods.

    stamp_ns : (F,) increasing
    keypoints : of the method's joints, px
    focal_px : of the camera, None = unknown
    rotation : (F, 3, 3) world (z up) -> camera, None = unknown
    progress : called with a stage and its fraction done
    evidence : of the method's joints, in camera axes
    pictures : whether a network found the keypoints in pictures of a lens
    """

    stamp_ns: np.ndarray
    keypoints: Keypoints2D
    focal_px: float | None
    initializer: InitializerConfig
    adjuster: BundleAdjusterConfig
    progress: Progress
    rotation: np.ndarray | None = None
    evidence: Evidence | None = None
    pictures: bool = False

    def frames(self, use: np.ndarray | slice) -> MethodInput:
        """The input of some of the frames."""
        rotation = None if self.rotation is None else self.rotation[use]
        evidence = None if self.evidence is None else self.evidence.map(lambda values: values[use])
        return replace(
            self, stamp_ns=self.stamp_ns[use], keypoints=self.keypoints[use], rotation=rotation, evidence=evidence
        )


@dataclass(frozen=True)
class Report:
    """What a solver did.

    iterations : accepted steps; cost_terms : cost at the end per term
    seconds : wall-clock per stage, "initial" and "ba"
    origin : for the motion's ``meta``: metadata of learned files, further parameters
    """

    iterations: int = 0
    stop_reason: str = NO_ADJUSTMENT
    cost_terms: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    origin: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ImagePoses:
    """Poses in px as the images show them: the result of every method, and of each window of one.

    joints_px : (F, P, 3) camera axes; ``keypoints ~ joints_px[..., :2] + translation_px[:, None]``
    translation_px : (F, 2)
    sigma_px : (F, P, 2) expected absolute error of x, y (each) and of depth; None = the method has none
    still : (F, 2) probability that the right and the left foot rest in the world; None = the method has none
    spread : of the poses about their pelvis
    """

    joints_px: np.ndarray
    translation_px: np.ndarray
    sigma_px: np.ndarray | None = None
    still: np.ndarray | None = None
    spread: Spread = field(default_factory=Spread)
    report: Report = field(default_factory=Report)

    @staticmethod
    def uncentred(in_image: np.ndarray, report: Report) -> ImagePoses:
        """Poses (F, P, 3) px whose x and y stand in the image, as they are."""
        return ImagePoses(in_image, np.zeros((len(in_image), 2)), report=report)

    @staticmethod
    def centred(
        in_image: np.ndarray, sigma_px: np.ndarray | None = None, still: np.ndarray | None = None
    ) -> ImagePoses:
        """Poses (F, P, 3) px whose x and y stand in the image, centred about their mean."""
        middle = in_image.mean(axis=1, keepdims=True)
        return ImagePoses(in_image - middle, middle[:, 0, :2], sigma_px, still)

    @property
    def in_image(self) -> np.ndarray:
        """(F, P, 3) px, x and y in the image."""
        joints = self.joints_px.copy()
        joints[..., :2] += self.translation_px[:, None]
        return joints
