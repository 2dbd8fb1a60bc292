"""Unknowns and inputs of the adjustment of body and camera in the world.

Lengths are metres of a body whose bones keep their total length; ``scale`` of them make a metre of the world.  So the
scale enters through the camera's position alone, and no term that prefers little motion can shrink the body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drocap_ros.camera_path import CameraErrors, CameraPath
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.lifted.adjustment import SPAN_STD_MM, SPANS
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry, ShiftedPath
from drocap_ros.reconstruction.world.findings import Findings
from drocap_ros.skeleton import BODY_15, BODY_17

JOINTS = len(BODY_17)
#: Bones whose total length is the unit: those without the feet.
BONES = len(BODY_15.bones)
SPAN_STD_M = SPAN_STD_MM / 1000.0
#: Unknowns of one frame: position error (3), rotation error (3) of the camera, joints.
CAMERA = 6
FRAME = CAMERA + 3 * JOINTS
#: The unknowns of the whole recording, in this order.
LENGTHS = slice(0, len(SPANS))
FLOOR = LENGTHS.stop
SCALE = FLOOR + 1
MISALIGNMENT = slice(SCALE + 1, SCALE + 4)
ATTITUDE_LATENCY = MISALIGNMENT.stop
POSITION_LATENCY = ATTITUDE_LATENCY + 1
GLOBALS = POSITION_LATENCY + 1
#: Those of every camera; each further view of the same body has its own, behind ``GLOBALS``.
OF_VIEW = slice(MISALIGNMENT.start, GLOBALS)
#: The unknowns of a :class:`~drocap_ros.reconstruction.world.findings.Findings`.
CALIBRATED = slice(SCALE, GLOBALS)


@dataclass(frozen=True)
class WorldConfig:
    """Weights of the adjustment in the world, and the accuracy of the telemetry; docs/reconstruction.md has reasons.

    iterations, locking_iterations : steps, and further ones that keep feet in contact in their places
    stature_std, length_std : relative standard deviations of the assumed stature and of the lifter's bone lengths:
        noise lengthens free bones
    errors : of the camera; rough positions wander farther
    corrected : the camera's path is one that fixed points have corrected
    acceleration_m_s2 : ordinary one of a joint
    depth_weight : of the lifter's depths
    contact_weight, locked_weight : of feet in contact, less than 1 as contacts last for some frames, and of locked ones
    contact_speed_m_s : standard deviation of the speed of a foot in contact
    feet : whether feet in contact keep their place
    frames_per_fact : frames that carry one independent piece of information: the priors count as much more
    checks : whether telemetry that cannot be true is refused
    """

    iterations: int = 4
    locking_iterations: int = 2
    stature_std: float = 0.05
    length_std: float = 0.002
    errors: CameraErrors = field(default_factory=CameraErrors)
    corrected: bool = False
    acceleration_m_s2: float = 16.0
    depth_weight: float = 0.2
    contact_weight: float = 0.2
    locked_weight: float = 2.0
    contact_speed_m_s: float = 0.1
    feet: bool = True
    frames_per_fact: float = 4.0
    checks: bool = True


def world_config(adjuster: BundleAdjusterConfig) -> WorldConfig:
    """The parameters that the bundle adjuster's section sets; the weights keep their defaults."""
    return WorldConfig(stature_std=adjuster.stature_std, errors=adjuster.telemetry_errors, feet=adjuster.feet)


def config_of(camera: CameraPath, config: WorldConfig) -> WorldConfig:
    """The parameters of an adjustment with this camera, which has ``errors``."""
    assert camera.errors is not None
    return replace(
        config,
        stature_std=config.stature_std if camera.scale_std is None else camera.scale_std,
        errors=camera.errors,
        corrected=camera.corrected,
        checks=config.checks and camera.of_reports,
    )


@dataclass(frozen=True)
class PlacedPoses:
    """Input of the refinement: F frames.

    joints : (F, 17, 3) m in the world; factor : their scale over that of the assumed stature
    depth, depth_sigma : (F, 17) m at the assumed stature: depth behind the pelvis and its expected error
    image, image_sigma : (F, 17, 2), (F, 17) px: place in the image and its expected error
    still : (F, 2) probability that the right and the left foot rest in the world, None = unknown
    """

    joints: np.ndarray
    factor: float
    depth: np.ndarray
    depth_sigma: np.ndarray
    image: np.ndarray
    image_sigma: np.ndarray
    still: np.ndarray | None = None


@dataclass(frozen=True)
class WorldInput:
    """What is measured and assumed, of evenly spaced frames.

    keypoints : (F, 17, 2) px; weight : (F, 17) 1/px^2, 0 where not seen
    depth, depth_sigma : (F, 17) m of the body, the lifter's depth behind the pelvis and its expected error
    lengths : (18,) m of the body, of the adjustment's spans; the first 14 set the unit
    camera_matrix : (3, 3) px
    seen : (F, 17) bool, the keypoints that a network saw, the others are the lifter's; None = those with a weight
    known : findings of earlier windows
    still : (F, 2) the network's probability that the right and the left foot rest, None = unknown
    further : other cameras' views of the same body at the same instants
    placed_m, placed_deg : standard deviations of the place and attitude of a camera that was placed in this world by
        the body; 0 = the world is the camera's own
    """

    keypoints: np.ndarray
    weight: np.ndarray
    depth: np.ndarray
    depth_sigma: np.ndarray
    lengths: np.ndarray
    telemetry: CameraTelemetry
    camera_matrix: np.ndarray
    config: WorldConfig = field(default_factory=WorldConfig)
    seen: np.ndarray | None = None
    known: Findings | None = None
    still: np.ndarray | None = None
    further: tuple[WorldInput, ...] = ()
    placed_m: float = 0.0
    placed_deg: float = 0.0

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.telemetry.fps


@dataclass(frozen=True)
class WorldState:
    """One point in the space of the unknowns.

    joints : (F, 17, 3) m of the body, world axes
    camera : (F, 6 V) of V views, each: error of the reported position (m) and rotation (rad, camera axes) that wanders
    globals : (GLOBALS,) lengths, floor (m of the body), scale, misalignment (rad), latencies (s); then ``OF_VIEW`` of
        each further view
    """

    joints: np.ndarray
    camera: np.ndarray
    globals: np.ndarray

    def path(self, telemetry: CameraTelemetry) -> ShiftedPath:
        """The telemetry shifted by the latencies, without the other errors."""
        return telemetry.shifted(float(self.globals[ATTITUDE_LATENCY]), float(self.globals[POSITION_LATENCY]))

    def moved(self, frames: np.ndarray, shared: np.ndarray) -> WorldState:
        """The point after a step of the frames' unknowns (F, FRAME) and of the shared ones (GLOBALS,)."""
        cameras = self.camera.shape[1]
        joints = self.joints + frames[:, cameras:].reshape(self.joints.shape)
        return WorldState(joints, self.camera + frames[:, :cameras], self.globals + shared)
