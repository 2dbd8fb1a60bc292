"""Residuals of the adjustment in the world, their cost and its derivatives.

- a robust (Geman-McClure) distance of the projected joints from the 2D joints,
- the distance from the lifter's depths, robust, along the camera's corrected view,
- the deviation of every bone from its length,
- the accelerations of the joints and of the camera,
- the step of a foot between two frames in contact, and its height above the floor,
- the errors of the camera's position and attitude that wander (Gauss-Markov),
- the priors of lengths, scale, misalignment and latencies.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from drocap_ros.contacts import FEET, HEIGHT_STD_M, step_height
from drocap_ros.geometry.rotations import exp_so3, left_jacobian
from drocap_ros.reconstruction.lifted.adjustment import DEPTH_ROUNDING_MM, SPANS
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    BONES,
    CALIBRATED,
    CAMERA,
    FLOOR,
    FRAME,
    GLOBALS,
    LENGTHS,
    MISALIGNMENT,
    POSITION_LATENCY,
    SCALE,
    SPAN_STD_M,
    WorldInput,
    WorldState,
)

#: Squared image residual, in standard deviations, at which a joint has half its weight.
OUTLIER_SQUARE = LiftedConfig.outlier_square
#: The same over the median square, while all residuals are large: two standard deviations of the usual joint.
_OVER_MEDIAN = 4.0
_DEPTH_ROUNDING_M = DEPTH_ROUNDING_MM / 1000.0
#: Least depth (m) of a joint before the camera: no drone is nearer.
_NEAREST_M = 0.3
#: Square (m^2) below which a bone has no direction: a hundredth of a millimetre.
_LEAST_SQUARE_M2 = 1e-10
#: Standard deviation (m) of the floor's height where no foot is in contact: any height.
_ANY_FLOOR_M = 1000.0
#: Standard deviation (m) of the body's total bone length, which sets the unit: less than any other term feels.
GAUGE_M = 0.0005
#: The shared unknowns of the camera, and their columns in its derivatives: a misalignment turns every frame.
OF_CAMERA = np.r_[SCALE, MISALIGNMENT, ATTITUDE_LATENCY, POSITION_LATENCY]
CAMERA_COLUMNS = np.array([6, 3, 4, 5, 7, 8])
#: Share of the latencies' variance that attitude and position do not have in common: one log holds both.
_OWN_LATENCY = 0.2


class WorldWeights(NamedTuple):
    """Weights of one adjustment that do not depend on the unknowns; the names are those of the terms.

    wander, first : (6,) of the change of the camera's errors between frames, and of the first ones
    shared : (GLOBALS, GLOBALS) inverse covariance of the priors
    expected : (GLOBALS,) their means: the logarithm of the scale, and differences from the lifter's lengths
    body : of the bones; 0 = another view has them
    """

    acceleration: float
    camera_acceleration: float
    depth: np.ndarray
    wander: np.ndarray
    first: np.ndarray
    shared: np.ndarray
    expected: np.ndarray
    body: float = 1.0


def weights_of(data: WorldInput) -> WorldWeights:
    """Weights from the parameters and from the telemetry's roughness."""
    config, errors, fps = data.config, data.config.errors, data.fps
    rough = data.telemetry.roughness() / np.sqrt(2.0 / (errors.position_wander_s * fps))
    # What points leave of a receiver's noise is no error that wanders.
    position = errors.position_wander_m if config.corrected else max(errors.position_wander_m, rough)
    attitude = np.deg2rad(errors.attitude_wander_deg)
    first = np.repeat([position**-2, attitude**-2], 3)
    wander = first * (0.5 * errors.wander_s * fps)
    shared = np.zeros((GLOBALS, GLOBALS))
    shared[LENGTHS, LENGTHS] = np.diag((config.length_std * data.lengths) ** -2)
    shared[FLOOR, FLOOR] = _ANY_FLOOR_M**-2
    shared[SCALE, SCALE] = config.stature_std**-2
    axes = data.telemetry.gimbal_axes()
    turned = np.deg2rad([errors.tilt_deg, errors.yaw_deg, errors.tilt_deg])
    shared[MISALIGNMENT, MISALIGNMENT] = axes.T @ np.diag(turned**-2) @ axes
    own = _OWN_LATENCY * np.eye(2) + (1.0 - _OWN_LATENCY)
    latencies = slice(ATTITUDE_LATENCY, POSITION_LATENCY + 1)
    shared[latencies, latencies] = np.linalg.inv(errors.latency_s**2 * own)
    expected = np.zeros(GLOBALS)
    if data.known is not None:
        shared[CALIBRATED, CALIBRATED] += data.known.precision
        expected[CALIBRATED] = np.linalg.solve(shared[CALIBRATED, CALIBRATED], data.known.vector)
    fact = config.frames_per_fact
    return WorldWeights(
        acceleration=(config.acceleration_m_s2 / fps**2) ** -2,
        camera_acceleration=(errors.acceleration_m_s2 / fps**2) ** -2,
        depth=config.depth_weight / np.maximum(data.depth_sigma, 0.01),
        wander=fact * wander,
        first=fact * first,
        shared=fact * shared,
        expected=expected,
    )


class Contacts(NamedTuple):
    """What is judged anew before every step of an adjustment: feet in contact, and outliers in the image.

    probability : (F - 1, 4) that a point of ``FEET`` keeps its place between two frames
    weight : of that step, 1 = its standard deviation as configured
    outlier : squared image residual, in standard deviations, at which a joint has half its weight
    floor_std : m, spread of the heights of feet in contact
    """

    probability: np.ndarray
    weight: float
    outlier: float = OUTLIER_SQUARE
    floor_std: float = HEIGHT_STD_M


class WorldResiduals:
    """Residuals at one point."""

    def __init__(self, data: WorldInput, weights: WorldWeights, state: WorldState, contacts: Contacts) -> None:
        self.data, self.weights, self.state, self.contacts = data, weights, state, contacts
        self._see()
        self._compare_image()
        self._compare_body()
        self._compare_feet()
        self._compare_camera()
        self._compare_shared()
        self.terms = self._terms()
        self.cost = sum(self.terms.values())

    def _see(self) -> None:
        """The camera's corrected path, and the joints in its axes."""
        shared, camera, path = self.state.globals, self.state.camera, self.state.path(self.data.telemetry)
        self.turn = shared[MISALIGNMENT] + camera[:, 3:]
        correction = exp_so3(self.turn)
        self.rotation = correction @ path.rotation
        self.position = path.position + camera[:, :3]
        self.velocity = path.velocity
        self.turn_rate = np.einsum("fij,fj->fi", correction, path.turn_rate)
        offset = self.state.joints - shared[SCALE] * self.position[:, None]
        self.seen = offset @ np.swapaxes(self.rotation, 1, 2)
        # Along the reported view, a lifter whose bodies lean would turn the camera.
        self.view = self.rotation[:, 2]

    def _compare_image(self) -> None:
        """Projected joints with the keypoints, and depths behind the pelvis with the lifter's."""
        data = self.data
        self.depth = np.maximum(self.seen[..., 2], _NEAREST_M)
        focal, centre = np.diagonal(data.camera_matrix)[:2], data.camera_matrix[:2, 2]
        pixels = focal * self.seen[..., :2] / self.depth[..., None] + centre
        self.image = np.where(data.weight[..., None] > 0, pixels - data.keypoints, 0.0)
        self.square = np.square(self.image).sum(-1) * data.weight
        self.robust = 1.0 / (1.0 + self.square / self.contacts.outlier)
        self.relief = self.seen[..., 2] - self.seen[:, :1, 2] - data.depth
        self.rounded = np.sqrt(np.square(self.relief) + _DEPTH_ROUNDING_M**2)

    def _compare_body(self) -> None:
        """Bones with their lengths, and joints with a steady motion."""
        joints, lengths = self.state.joints, self.state.globals[LENGTHS]
        span = joints[:, SPANS[:, 1]] - joints[:, SPANS[:, 0]]
        length = np.sqrt(np.square(span).sum(-1) + _LEAST_SQUARE_M2)
        self.direction = span / length[..., None]
        self.stretch = self.weights.body * (length - lengths) / SPAN_STD_M
        self.excess = 1.0 - lengths / length
        self.swing = joints[2:] - 2 * joints[1:-1] + joints[:-2]

    def _compare_feet(self) -> None:
        """Feet in contact with their place one frame before, and with the floor."""
        feet, config = self.state.joints[:, FEET], self.data.config
        self.step = feet[1:] - feet[:-1]
        touching = self.contacts.probability
        self.step_weight = self.contacts.weight * touching / (config.contact_speed_m_s / self.data.fps) ** 2
        self.height = step_height(feet, self.state.globals[FLOOR])
        self.height_weight = touching / self.contacts.floor_std**2

    def _compare_camera(self) -> None:
        """The camera's errors with those one frame before, and its path with a steady flight."""
        camera = self.state.camera
        flown = self.data.telemetry.position + camera[:, :3]
        self.camera_swing = flown[2:] - 2 * flown[1:-1] + flown[:-2]
        self.drift = np.diff(camera, axis=0)

    def _compare_shared(self) -> None:
        """Lengths, scale, misalignment and latencies with their priors."""
        shared, lengths = self.state.globals, self.data.lengths
        self.gauge = self.weights.body * (shared[:BONES].sum() - lengths[:BONES].sum()) / GAUGE_M
        self.prior = shared.copy()
        self.prior[LENGTHS] -= lengths
        self.prior[SCALE] = np.log(shared[SCALE])
        self.prior -= self.weights.expected

    def _terms(self) -> dict[str, float]:
        """The cost, term by term."""
        weights = self.weights
        return {
            "reprojection": 0.5 * float((self.square * self.robust).sum()),
            "lifter_depth": float((weights.depth * (self.rounded - _DEPTH_ROUNDING_M)).sum()),
            "articulation": 0.5 * float(np.square(self.stretch).sum()),
            "acceleration": 0.5 * weights.acceleration * float(np.square(self.swing).sum()),
            "contact": 0.5 * float((self.step_weight[..., None] * np.square(self.step)).sum()),
            "floor": 0.5 * float((self.height_weight * np.square(self.height)).sum()),
            "telemetry": 0.5 * float((weights.wander * np.square(self.drift)).sum())
            + 0.5 * float((weights.first * np.square(self.state.camera[0])).sum())
            + 0.5 * weights.camera_acceleration * float(np.square(self.camera_swing).sum()),
            "priors": 0.5 * float(self.prior @ weights.shared @ self.prior) + 0.5 * self.gauge**2,
        }

    def moved(self, frames: np.ndarray, shared: np.ndarray) -> WorldResiduals:
        """Residuals of the same cost after a step."""
        return WorldResiduals(self.data, self.weights, self.state.moved(frames, shared), self.contacts)

    def usual_outlier(self) -> float:
        """Squared residual that sets outliers apart from the rest: far from the solution all are large."""
        weighed = self.square[self.data.weight > 0]
        return max(OUTLIER_SQUARE, _OVER_MEDIAN * float(np.median(weighed))) if len(weighed) else OUTLIER_SQUARE

    @cached_property
    def image_derivatives(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The image residuals (F, 34) at the present robust weight, and their derivatives.

        By the joint (F, 34, 3), and by the camera (F, 34, 9): position, rotation, scale, latencies; rows are u and v of
        every joint.
        """
        frames, scale = len(self.seen), self.state.globals[SCALE]
        root = np.sqrt(self.data.weight) * self.robust
        x, y, z = np.moveaxis(self.seen, -1, 0)
        far = z > _NEAREST_M
        slope = np.where(far[..., None], self.seen[..., :2] / self.depth[..., None], 0.0)
        per_m = root[..., None] * np.diagonal(self.data.camera_matrix)[:2] / self.depth[..., None]
        by_joint = per_m[..., None] * (self.rotation[:, None, :2] - slope[..., None] * self.rotation[:, None, 2:])
        # Rows of the joints' change by a rotation, less the slope times that of the depth.
        by_turn = np.empty(by_joint.shape)
        by_turn[:, :, 0, 0], by_turn[:, :, 1, 0] = -slope[..., 0] * y, -z - slope[..., 1] * y
        by_turn[:, :, 0, 1], by_turn[:, :, 1, 1] = z + slope[..., 0] * x, slope[..., 1] * x
        by_turn[:, :, 0, 2], by_turn[:, :, 1, 2] = -y, x
        by_turn *= per_m[..., None]
        by_joint, by_turn = by_joint.reshape(frames, -1, 3), by_turn.reshape(frames, -1, 3)
        camera = np.empty((*by_joint.shape[:2], 9))
        camera[..., :3] = -scale * by_joint
        camera[..., 3:6] = by_turn @ left_jacobian(self.turn)
        camera[..., 6:7] = by_joint @ -self.position[..., None]
        camera[..., 7:8] = by_turn @ self.turn_rate[..., None]
        camera[..., 8:9] = by_joint @ (-scale * self.velocity[..., None])
        return (root[..., None] * self.image).reshape(frames, -1), by_joint, camera

    @cached_property
    def depth_derivatives(self) -> np.ndarray:
        """Derivatives (F, 17, 9) of the depths behind the pelvis by the camera, as in :meth:`image_derivatives`."""
        x, y, _ = np.moveaxis(self.seen - self.seen[:, :1], -1, 0)
        by_turn = np.stack([y, -x, np.zeros(x.shape)], axis=-1)
        out = np.zeros((*x.shape, 9))
        out[..., 3:6] = by_turn @ left_jacobian(self.turn)
        out[..., 7:8] = by_turn @ self.turn_rate[..., None]
        return out


def gradient(r: WorldResiduals) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the cost by the unknowns of every frame (F, FRAME) and by the shared ones (GLOBALS,)."""
    weights, state = r.weights, r.state
    frames = np.zeros((len(state.joints), FRAME))
    camera = frames[:, :CAMERA]
    joints = frames[:, CAMERA:].reshape(state.joints.shape)
    shared = np.zeros(GLOBALS)
    image, by_joint, by_camera = r.image_derivatives
    joints += (image[..., None] * by_joint).reshape(*joints.shape[:2], 2, 3).sum(axis=2)
    relief = weights.depth * r.relief / r.rounded
    pull = (image[:, None] @ by_camera + relief[:, None] @ r.depth_derivatives)[:, 0]
    camera += pull[:, :CAMERA]
    shared[OF_CAMERA] += pull[:, CAMERA_COLUMNS].sum(axis=0)
    joints += relief[..., None] * r.view[:, None]
    joints[:, 0] -= relief.sum(axis=1)[:, None] * r.view
    stretch = (r.stretch / SPAN_STD_M)[..., None] * r.direction
    for k, (a, b) in enumerate(SPANS):
        joints[:, b] += stretch[:, k]
        joints[:, a] -= stretch[:, k]
    shared[LENGTHS] -= (r.stretch / SPAN_STD_M).sum(axis=0)
    shared[:BONES] += r.gauge / GAUGE_M
    of_camera = (r.camera_swing, weights.camera_acceleration, camera[:, :3])
    for swing, weight, into in ((r.swing, weights.acceleration, joints), of_camera):
        into[2:] += weight * swing
        into[1:-1] -= 2 * weight * swing
        into[:-2] += weight * swing
    step = r.step_weight[..., None] * r.step
    height = r.height_weight * r.height
    for i, foot in enumerate(FEET):
        joints[1:, foot] += step[:, i]
        joints[:-1, foot] -= step[:, i]
        joints[1:, foot, 2] += 0.5 * height[:, i]
        joints[:-1, foot, 2] += 0.5 * height[:, i]
    shared[FLOOR] -= height.sum()
    drift = weights.wander * r.drift
    camera[1:] += drift
    camera[:-1] -= drift
    camera[0] += weights.first * state.camera[0]
    by_prior = weights.shared @ r.prior
    by_prior[SCALE] /= state.globals[SCALE]
    return frames, shared + by_prior
