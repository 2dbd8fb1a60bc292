"""Unknowns and inputs of the adjustment of body and camera in the world.

Lengths are metres of a body whose bones keep their total length; ``scale`` of them make a metre of the world.  So the
scale enters through the camera's position alone, and no term that prefers little motion can shrink the body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraErrors, CameraPath
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.lifted.adjustment import SPAN_STD_MM, SPANS
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.skeleton import BODY_15, BODY_17

#: Standard deviation (m) of the lower ankle's height above ground that is seen: steps, unevenness, the lifter's depths.
GROUND_M = 0.15
#: Deviation of a body's distance by its size, as a share of it; of the height of his feet, of the camera's above them.
SIZE_STD = 0.04
#: Relative standard deviation of the scale below which it counts as measured: half of that among people.
MEASURED = 0.03


class Findings(NamedTuple):
    """Of the measurements alone: precision (6, 6) and vector (6,); zeros = nothing is known.

    The unknowns are the logarithm of the scale, the misalignment (3) rad, the latencies of attitude and position s; of
    points the latter five first, then the logarithm of the focal length.
    """

    precision: np.ndarray
    vector: np.ndarray

    @staticmethod
    def unknown() -> Findings:
        """Nothing is known."""
        return Findings(np.zeros((6, 6)), np.zeros(6))

    def later(self, found: Findings, share: float, passed_s: float) -> Findings:
        """Findings ``passed_s`` later, with a share of those of a window: its frames that the next one has not."""
        # Time (s) after which findings count a third: telemetry drifts, and errors of the poses do not average out.
        decay = float(np.exp(-passed_s / 60.0))
        return Findings(
            decay * (self.precision + share * found.precision), decay * (self.vector + share * found.vector)
        )

    def of_scale(self) -> Findings:
        """What they tell of the scale alone, where the camera's reports have other errors than until now."""
        rest = self.precision[1:, 0] @ np.linalg.pinv(self.precision[1:, 1:])
        alone = Findings.unknown()
        alone.precision[0, 0] = self.precision[0, 0] - rest @ self.precision[1:, 0]
        alone.vector[0] = self.vector[0] - rest @ self.vector[1:]
        return alone

    def after(self, found: Findings, its_ns: np.ndarray, stamp_ns: np.ndarray) -> Findings:
        """Findings before a window of ``stamp_ns``, with those of the window of ``its_ns`` that it has not itself."""
        begin, end = int(its_ns[0]), int(its_ns[-1])
        share = float(np.clip((int(stamp_ns[0]) - begin) / max(end - begin, 1), 0.0, 1.0))
        return self.later(found, share, max(int(stamp_ns[-1]) - end, 0) * 1e-9)


JOINTS = len(BODY_17)
#: Bones whose total length is the unit: those without the feet.
BONES = len(BODY_15.bones)
SPAN_STD_M = SPAN_STD_MM / 1000.0
#: Standard deviation (m) of the body's total bone length, which sets the unit: less than any other term feels.
GAUGE_M = 0.0005
#: Unknowns of one frame and camera: position error (3), rotation error (3).
CAMERA = 6
#: The unknowns of the whole recording, in this order.
LENGTHS = slice(0, len(SPANS))
FLOOR = LENGTHS.stop
SCALE = FLOOR + 1
MISALIGNMENT = slice(SCALE + 1, SCALE + 4)
ATTITUDE_LATENCY = MISALIGNMENT.stop
POSITION_LATENCY = ATTITUDE_LATENCY + 1
LENS = POSITION_LATENCY + 1
LEAN = slice(LENS + 1, LENS + 3)
GLOBALS = LEAN.stop
#: Those of every camera; each further view of the same body has its own ones, behind ``GLOBALS``.
OF_VIEW = slice(MISALIGNMENT.start, GLOBALS)
OWN = OF_VIEW.stop - OF_VIEW.start
#: The unknowns of a :class:`~drocap_ros.reconstruction.world.world_model.Findings`.
CALIBRATED = slice(SCALE, LENS)


def joint_columns(views: int) -> slice:
    """Places of the joints among the unknowns of a frame: behind the errors of every view's camera."""
    return slice(CAMERA * views, CAMERA * views + 3 * JOINTS)


def shared_columns(view: int) -> np.ndarray:
    """(GLOBALS,) places of the unknowns that a view has, in their order, among the shared ones."""
    own = np.arange(OF_VIEW.start, GLOBALS) + OWN * view
    return np.concatenate([np.arange(OF_VIEW.start), own])


@dataclass(frozen=True)
class WorldConfig:
    """Weights of the adjustment in the world, and the accuracy of the telemetry; docs/reconstruction.md has reasons.

    iterations, locking_iterations : steps, and further ones that keep feet in contact in their places
    stature_std, length_std : relative standard deviations of the assumed stature and of the lifter's bone lengths:
        noise lengthens free bones
    errors : of the camera; rough positions wander farther
    corrected : the camera's path is one that fixed points have corrected
    acceleration_m_s2 : ordinary one of a joint
    contact_weight, locked_weight : of feet in contact, less than 1 as contacts last for some frames, and of locked ones
    contact_speed_m_s : standard deviation of the speed of a foot in contact
    feet : whether feet in contact keep their place
    ground_m : standard deviation (m) of the lower ankle from the ground at z = 0, whose points are seen; 0 = none is
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
    contact_weight: float = 0.2
    locked_weight: float = 2.0
    contact_speed_m_s: float = 0.1
    feet: bool = True
    ground_m: float = 0.0
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
        ground_m=_ground_m(camera),
        checks=config.checks and camera.of_reports,
    )


def _ground_m(camera: CameraPath) -> float:
    """Standard deviation (m) of a lower ankle from the ground's plane, for a camera so high above it.

    From near, the body's size tells the height of feet on a step; from high above it errs by more than steps are high.
    """
    if not camera.stands_on_points:
        return 0.0
    by_size = SIZE_STD * max(float(np.median(camera.pose[1][:, 2])), 1.0)
    return float(GROUND_M * np.sqrt(1.0 + 2.0 * (GROUND_M / by_size) ** 2))


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


class Doubt(NamedTuple):
    """Standard deviations of what only further views of a body can tell; zeros and None: a view alone.

    placed_m, placed_deg : of the place, and of tilt and yaw, of a camera that was placed in this world by the body
    wander_m : of its path's slow errors beyond its own
    lens : logarithm of the focal length over that of the matrix, and its deviation
    lean_std : rad, of a turn of all bodies that the lifter sees, whose errors last
    """

    placed_m: float = 0.0
    placed_deg: tuple[float, float] | None = None
    wander_m: float = 0.0
    lens: tuple[float, float] = (0.0, 0.0)
    lean_std: float = 0.0


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
    doubt: Doubt = field(default_factory=Doubt)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.telemetry.fps

    @property
    def views(self) -> tuple[WorldInput, ...]:
        """The first view, which is this one, and the further ones."""
        return (self, *self.further)


@dataclass(frozen=True)
class WorldState:
    """One point in the space of the unknowns.

    joints : (F, 17, 3) m of the body, world axes
    camera : (F, 6 V) of V views, each: error of the reported position (m) and rotation (rad, camera axes) that wanders
    globals : (GLOBALS,) lengths, floor (m of the body), scale, misalignment (rad), latencies (s), logarithm of the
        focal length over that of the matrix, lean of the lifter's bodies (rad, about the image's axes); then
        ``OF_VIEW`` of each further view
    """

    joints: np.ndarray
    camera: np.ndarray
    globals: np.ndarray

    def path(self, telemetry: CameraTelemetry) -> tuple[np.ndarray, np.ndarray]:
        """The telemetry shifted by the latencies, without the other errors."""
        return telemetry.shifted(float(self.globals[ATTITUDE_LATENCY]), float(self.globals[POSITION_LATENCY]))

    def of_view(self, number: int) -> WorldState:
        """The point as one view has it."""
        own = shared_columns(number)
        return WorldState(self.joints, self.camera[:, CAMERA * number : CAMERA * (number + 1)], self.globals[own])

    @property
    def lens(self) -> np.ndarray:
        """(V,) of every view."""
        return self.globals[LENS::OWN]

    def with_views(self, further: int) -> WorldState:
        """A point of one view with as many further ones, whose cameras stand where they were placed."""
        errors = np.zeros((len(self.joints), CAMERA * further))
        camera, shared = np.concatenate([self.camera, errors], axis=1), np.append(self.globals, np.zeros(OWN * further))
        return WorldState(self.joints, camera, shared)

    def moved(self, frames: np.ndarray, shared: np.ndarray) -> WorldState:
        """The point after a step of the frames' unknowns, as of :func:`joint_columns`, and of the shared ones."""
        cameras = self.camera.shape[1]
        joints = self.joints + frames[:, cameras:].reshape(self.joints.shape)
        return WorldState(joints, self.camera + frames[:, :cameras], self.globals + shared)
