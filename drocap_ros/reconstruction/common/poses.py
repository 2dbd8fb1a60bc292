"""Input and result of every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.skeleton import BODY_17

CONVERGED = "converged"
#: The configured number of steps is done.
ITERATIONS = "iterations"
#: No damping gives a lower cost.
NO_DESCENT = "no descent"
#: The caller cancelled the solve.
DEADLINE = "deadline"
#: The window has too few frames for an adjustment.
TOO_SHORT = "too short"
#: The method has no adjustment.
NO_ADJUSTMENT = "no adjustment"
#: The recording is shorter than the live method's first window.
NO_WINDOW = "no window was due"


class Spread(NamedTuple):
    """Standard deviations of a method's poses.

    across, along : of a joint over its expected absolute error, across and along the ray
    size : of the body's size in the image, share: limbs that the method puts too deep are taken for longer ones
    lean : rad, of the whole body about either axis of the image: a single view does not show it
    """

    across: float = 1.0
    along: float = 1.0
    size: float = 0.0
    lean: float = 0.0

    def covariance(self, joints: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """(F, P, 3, 3) of joints (F, P, 3) in a camera's axes with expected errors (F, P, 2) in the same unit."""
        about = joints - joints[:, :1]
        x, y, z = np.moveaxis(about, -1, 0)
        by_lean = self.lean * np.stack([[0 * x, -z, y], [z, 0 * x, -x]])
        ways = np.concatenate([self.size * about[None], np.moveaxis(by_lean, 1, -1)])
        full: np.ndarray = np.einsum("nfpi,nfpj->fpij", ways, ways)
        axes = np.arange(3)
        full[..., axes, axes] += np.square(sigma * (self.across, self.along))[..., [0, 0, 1]]
        return np.asarray(full)


def packed(full: np.ndarray) -> np.ndarray:
    """xx, xy, xz, yy, yz, zz (..., 6) of symmetric matrices (..., 3, 3)."""
    return np.asarray(full[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


#: Least standard deviation of a joint's depth in the evidence, mm of an ordinary person: of the best single-image
#: methods on their own test sets, per joint.
_LEAST_MM = 30.0


@dataclass(frozen=True)
class Evidence:
    """Poses in the axes of each image's camera, any unit and place.

    joints : (F, P, 3) of a body set, NaN where unknown
    sigma : (F, P) expected error in the same unit, NaN where unknown
    """

    joints: np.ndarray
    sigma: np.ndarray

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Evidence:
        """The evidence with the same change along the frames of both arrays."""
        return Evidence(change(self.joints), change(self.sigma))

    def turned(self, turn: np.ndarray) -> Evidence:
        """The evidence in axes turned by (F, 3, 3)."""
        return Evidence(self.joints @ np.swapaxes(turn, 1, 2), self.sigma)

    def depths(self, pose_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(F, P) mm behind the pelvis and (F, P) their standard deviations, NaN and infinite where unknown.

        The scale is that of the bones; the errors are at least those across the image from ``pose_mm`` (F, P, 3).
        """
        parent, child = BODY_17.bones[: pose_mm.shape[1] - 1].T
        about = self.joints - self.joints[:, :1]
        theirs = np.linalg.norm(about[:, child] - about[:, parent], axis=-1)
        ours = np.linalg.norm(pose_mm[:, child] - pose_mm[:, parent], axis=-1)
        # Most frames with evidence may lack a bone; one of them is enough for the scale.
        known = np.isfinite(theirs) & (theirs > 1e-9)
        if not known.any():
            return np.full(pose_mm.shape[:2], np.nan), np.full(pose_mm.shape[:2], np.inf)
        about = about * float(np.median(ours[known]) / np.median(theirs[known]))
        scale = float(np.median(ours[known]) / np.median(theirs[known]))
        gap = about[..., :2] - (pose_mm - pose_mm[:, :1])[..., :2]
        count = np.maximum(np.isfinite(gap[..., 0]).sum(axis=0), 1)
        across = np.sqrt(np.nansum(np.square(gap), axis=(0, 2)) / (2 * count))
        # Errors in depth over those across the image, which can be measured: of BlazePose on three videos with optical
        # MoCap.
        sigma = np.fmax(np.fmax(self.sigma * scale, 1.5 * across), _LEAST_MM)
        return about[..., 2], np.where(np.isfinite(about[..., 2]), sigma, np.inf)


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
