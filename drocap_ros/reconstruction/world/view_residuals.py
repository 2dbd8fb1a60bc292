"""What one camera has to do with the body, at one point: its image, the lifter's depths in it, its own errors."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import exp_so3, left_jacobian
from drocap_ros.reconstruction.common.engine import pull_second_difference, second_difference, usual_outlier
from drocap_ros.reconstruction.lifted.adjustment import DEPTH_ROUNDING_MM
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    CAMERA,
    LEAN,
    LENS,
    MISALIGNMENT,
    POSITION_LATENCY,
    SCALE,
    WorldInput,
    WorldState,
)

#: Squared image residual, in standard deviations, at which a joint has half its weight.
OUTLIER_SQUARE = LiftedConfig.outlier_square
_DEPTH_ROUNDING_M = DEPTH_ROUNDING_MM / 1000.0
#: Least depth (m) of a joint before the camera: no drone is nearer.
_NEAREST_M = 0.3
#: The shared unknowns of a camera, and their columns in its derivatives: a misalignment turns every frame.
OF_CAMERA = np.r_[SCALE, MISALIGNMENT, ATTITUDE_LATENCY, POSITION_LATENCY, LENS, LEAN]
CAMERA_COLUMNS = np.array([6, 3, 4, 5, 7, 8, 9, 10, 11])


class ViewWeights(NamedTuple):
    """Weights of a view's terms, which do not depend on the unknowns.

    wander, first : (6,) of the change of the camera's errors between frames, and of the first ones
    """

    acceleration: float
    depth: np.ndarray
    wander: np.ndarray
    first: np.ndarray


def view_weights(view: WorldInput, alone: bool) -> ViewWeights:
    """Weights from the errors that are expected, and from the telemetry's roughness; ``alone``: no further view."""
    config, errors, fps = view.config, view.config.errors, view.fps
    rough = view.telemetry.roughness() / np.sqrt(2.0 / (errors.position_wander_s * fps))
    # What points leave of a receiver's noise is no error that wanders.
    position = errors.position_wander_m if config.corrected else max(errors.position_wander_m, rough)
    attitude = np.deg2rad(errors.attitude_wander_deg)
    first = np.repeat([position**-2, attitude**-2], 3)
    wander, fact = first * (0.5 * errors.wander_s * fps), config.frames_per_fact
    first = fact * first
    if view.doubt.placed_m:  # a camera that was placed by the body errs by its placement
        first[:3] = fact / (fact / first[:3] + view.doubt.placed_m**2)
    # Weight of the lifter's depths, whose errors last, where further views measure them.
    return ViewWeights(
        acceleration=(errors.acceleration_m_s2 / fps**2) ** -2,
        depth=(1.0 if alone else 0.1) / np.maximum(view.depth_sigma, 0.01),
        wander=fact * wander,
        first=first,
    )


def errors_precision(view: WorldInput) -> np.ndarray:
    """(8, 8) inverse covariance of misalignment (rad, camera axes), latencies (s), the lens' logarithm and lean."""
    errors, doubt, axes = view.config.errors, view.doubt, view.telemetry.gimbal_axes()
    tilt, yaw = doubt.placed_deg or (errors.tilt_deg, errors.yaw_deg)
    turned = np.deg2rad([tilt, yaw, tilt])
    precision = np.zeros((8, 8))
    precision[:3, :3] = axes.T @ np.diag(turned**-2) @ axes
    precision[3:5, 3:5] = np.linalg.inv(errors.latency_covariance)
    # Deviation of the logarithm of a focal length that is known, and of a lean (rad) that is none.
    precision[5:, 5:] = np.diag(np.maximum([doubt.lens[1], doubt.lean_std, doubt.lean_std], 1e-6) ** -2)
    return precision


class ViewResiduals:
    """Residuals of a view.

    state : the point as this view has it; outlier : squared image residual at which a joint has half its weight
    """

    def __init__(self, view: WorldInput, weights: ViewWeights, state: WorldState, outlier: float) -> None:
        self.data, self.weights, self.state, self._outlier = view, weights, state, outlier
        self._see()
        self._compare_image()
        self._compare_camera()
        self.terms = {
            "reprojection": 0.5 * float((self.square * self.robust).sum()),
            "lifter_depth": float((weights.depth * (self.rounded - _DEPTH_ROUNDING_M)).sum()),
            "telemetry": 0.5 * float((weights.wander * np.square(self.drift)).sum())
            + 0.5 * float((weights.first * np.square(state.camera[0])).sum())
            + 0.5 * weights.acceleration * float(np.square(self.swing).sum()),
        }

    def _see(self) -> None:
        """The camera's corrected path, and the joints in its axes."""
        shared, camera, telemetry = self.state.globals, self.state.camera, self.data.telemetry
        rotation, position = self.state.path(telemetry)
        self.turn = shared[MISALIGNMENT] + camera[:, 3:]
        correction = exp_so3(self.turn)
        self.rotation = correction @ rotation
        self.position = position + camera[:, :3]
        self.velocity = telemetry.velocity
        self.turn_rate = np.einsum("fij,fj->fi", correction, telemetry.turn_rate)
        offset = self.state.joints - shared[SCALE] * self.position[:, None]
        self.seen = offset @ np.swapaxes(self.rotation, 1, 2)
        # Along the reported view, a lifter whose bodies lean would turn the camera.
        self.lean = shared[LEAN]
        self.view = self.rotation[:, 2] - self.lean @ self.rotation[:, :2]

    def _compare_image(self) -> None:
        """Projected joints with the keypoints, and depths behind the pelvis with the lifter's."""
        data = self.data
        self.depth = np.maximum(self.seen[..., 2], _NEAREST_M)
        self.focal = np.diagonal(data.camera_matrix)[:2] * np.exp(self.state.globals[LENS])
        self.from_centre = self.focal * self.seen[..., :2] / self.depth[..., None]
        pixels = self.from_centre + data.camera_matrix[:2, 2]
        self.image = np.where(data.weight[..., None] > 0, pixels - data.keypoints, 0.0)
        self.square = np.square(self.image).sum(-1) * data.weight
        self.robust = 1.0 / (1.0 + self.square / self._outlier)
        about = self.seen - self.seen[:, :1]
        self.relief = about[..., 2] - about[..., :2] @ self.lean - data.depth
        self.rounded = np.sqrt(np.square(self.relief) + _DEPTH_ROUNDING_M**2)

    def _compare_camera(self) -> None:
        """The camera's errors with those one frame before, and its path with a steady flight."""
        camera = self.state.camera
        self.swing = second_difference(self.data.telemetry.position + camera[:, :3])
        self.drift = np.diff(camera, axis=0)

    def usual_outlier(self) -> float:
        """Squared residual that sets outliers apart from the rest: far from the solution all are large."""
        return usual_outlier(self.square[self.data.weight > 0], OUTLIER_SQUARE)

    @cached_property
    def image_derivatives(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The image residuals (F, 34) at the present robust weight, and their derivatives.

        By the joint (F, 34, 3), and by the camera (F, 34, 12): position, rotation, scale, latencies, lens, lean;
        rows are u and v of every joint.
        """
        frames, scale = len(self.seen), self.state.globals[SCALE]
        root = np.sqrt(self.data.weight) * self.robust
        x, y, z = np.moveaxis(self.seen, -1, 0)
        far = z > _NEAREST_M
        slope = np.where(far[..., None], self.seen[..., :2] / self.depth[..., None], 0.0)
        per_m = root[..., None] * self.focal / self.depth[..., None]
        by_joint = per_m[..., None] * (self.rotation[:, None, :2] - slope[..., None] * self.rotation[:, None, 2:])
        # Rows of the joints' change by a rotation, less the slope times that of the depth.
        by_turn = np.empty(by_joint.shape)
        by_turn[:, :, 0, 0], by_turn[:, :, 1, 0] = -slope[..., 0] * y, -z - slope[..., 1] * y
        by_turn[:, :, 0, 1], by_turn[:, :, 1, 1] = z + slope[..., 0] * x, slope[..., 1] * x
        by_turn[:, :, 0, 2], by_turn[:, :, 1, 2] = -y, x
        by_turn *= per_m[..., None]
        by_joint, by_turn = by_joint.reshape(frames, -1, 3), by_turn.reshape(frames, -1, 3)
        camera = np.zeros((*by_joint.shape[:2], 12))
        camera[..., :3] = -scale * by_joint
        camera[..., 3:6] = by_turn @ left_jacobian(self.turn)
        camera[..., 6:7] = by_joint @ -self.position[..., None]
        camera[..., 7:8] = by_turn @ self.turn_rate[..., None]
        camera[..., 8:9] = by_joint @ (-scale * self.velocity[..., None])
        camera[..., 9] = (root[..., None] * self.from_centre).reshape(frames, -1)
        return (root[..., None] * self.image).reshape(frames, -1), by_joint, camera

    @cached_property
    def depth_derivatives(self) -> np.ndarray:
        """Derivatives (F, 17, 12) of the depths behind the pelvis by the camera, as in :meth:`image_derivatives`."""
        x, y, z = np.moveaxis(self.seen - self.seen[:, :1], -1, 0)
        a, b = self.lean
        by_turn = np.stack([y + b * z, -x - a * z, a * y - b * x], axis=-1)
        out = np.zeros((*x.shape, 12))
        out[..., 3:6] = by_turn @ left_jacobian(self.turn)
        out[..., 7:8] = by_turn @ self.turn_rate[..., None]
        out[..., 10], out[..., 11] = -x, -y
        return out

    def add_gradient(self, camera: np.ndarray, joints: np.ndarray, shared: np.ndarray) -> None:
        """Add derivatives by the camera's errors (F, 6), the joints (F, 17, 3), and ``OF_CAMERA`` (6,)."""
        weights = self.weights
        image, by_joint, by_camera = self.image_derivatives
        joints += (image[..., None] * by_joint).reshape(*joints.shape[:2], 2, 3).sum(axis=2)
        relief = weights.depth * self.relief / self.rounded
        pull = (image[:, None] @ by_camera + relief[:, None] @ self.depth_derivatives)[:, 0]
        camera += pull[:, :CAMERA]
        shared += pull[:, CAMERA_COLUMNS].sum(axis=0)
        joints += relief[..., None] * self.view[:, None]
        joints[:, 0] -= relief.sum(axis=1)[:, None] * self.view
        pull_second_difference(camera[:, :3], weights.acceleration * self.swing)
        drift = weights.wander * self.drift
        camera[1:] += drift
        camera[:-1] -= drift
        camera[0] += weights.first * self.state.camera[0]
