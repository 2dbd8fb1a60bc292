"""Input and result of every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class MethodInput:
    """Keypoints of one person and the parameters of the methods.

    stamp_ns : (F,) increasing
    keypoints : of the method's joints, px
    focal_px : of the camera, None = unknown
    rotation : (F, 3, 3) world (z up) -> camera, None = unknown
    progress : called with a stage and its fraction done
    """

    stamp_ns: np.ndarray
    keypoints: Keypoints2D
    focal_px: float | None
    initializer: InitializerConfig
    adjuster: BundleAdjusterConfig
    dictionary: Dictionary
    progress: Progress
    rotation: np.ndarray | None = None

    def frames(self, use: np.ndarray) -> MethodInput:
        """The input of the frames ``use`` (F,) bool."""
        rotation = None if self.rotation is None else self.rotation[use]
        return replace(self, stamp_ns=self.stamp_ns[use], keypoints=self.keypoints[use], rotation=rotation)


@dataclass(frozen=True)
class CameraPoses:
    """Poses in camera axes, in px, and the solver's report.

    joints_px : (F, P, 3), centred; ``keypoints ~ joints_px[..., :2] + translation_px``
    translation_px : (F, 2)
    seconds : wall-clock per stage
    sigma_px : (F, P, 2) expected error of x, y (each) and of depth, None = the method has none
    still : (F, 2) probability that the right and the left foot rest in the world, None = the method has none
    """

    joints_px: np.ndarray
    translation_px: np.ndarray
    seconds: dict[str, float]
    iterations: int
    stop_reason: str
    cost_terms: dict[str, float]
    sigma_px: np.ndarray | None = None
    still: np.ndarray | None = None
