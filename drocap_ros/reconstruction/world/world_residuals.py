"""Residuals of the adjustment in the world, their cost and its derivatives.

- a robust (Geman-McClure) distance of the projected joints from the 2D joints,
- the distance from the lifter's depths, robust, along the reported view,
- the deviation of every bone from its length,
- the accelerations of the joints and of the camera,
- the step of a foot between two frames in contact, and its height above the floor,
- the errors of the camera's position and attitude that wander (Gauss-Markov),
- the priors of lengths, scale, misalignment and latencies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import exp_so3, hat, left_jacobian
from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    BONES,
    CAMERA,
    FEET,
    FEET_HEIGHT_M,
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

_OUTLIER_SQUARE = 9.0
_DEPTH_ROUNDING_M = 0.015
_NEAREST_M = 0.3
_FLOOR_STD_M = 0.1
#: Spread of the floor's height where no foot is in contact.
_ANY_FLOOR_M = 1000.0
#: Standard deviation (m) of the body's total bone length, which sets the unit.
GAUGE_M = 0.0005
_POSITION_WANDER_S, _ATTITUDE_WANDER_S = 60.0, 10.0


class Weights(NamedTuple):
    """Weights of one adjustment that do not depend on the unknowns; the names are those of the terms.

    wander, first : (6,) of the change of the camera's errors between frames, and of the first ones
    shared : (GLOBALS,) of the priors, 0 = none
    """

    acceleration: float
    camera_acceleration: float
    depth: np.ndarray
    wander: np.ndarray
    first: np.ndarray
    shared: np.ndarray


def weights_of(data: WorldInput) -> Weights:
    """Weights from the parameters and from the telemetry's roughness."""
    config, fps = data.config, data.fps
    rough = data.telemetry.roughness() / np.sqrt(2.0 / (_POSITION_WANDER_S * fps))
    position, attitude = max(config.position_wander_m, rough), np.deg2rad(config.attitude_wander_deg)
    first = np.repeat([position**-2, attitude**-2], 3)
    wander = first * np.repeat([0.5 * _POSITION_WANDER_S * fps, 0.5 * _ATTITUDE_WANDER_S * fps], 3)
    shared = np.zeros(GLOBALS)
    shared[LENGTHS] = (config.length_std * data.lengths) ** -2
    shared[FLOOR] = _ANY_FLOOR_M**-2
    shared[SCALE] = config.stature_std**-2
    shared[MISALIGNMENT] = np.deg2rad([config.tilt_error_deg, config.yaw_error_deg, config.tilt_error_deg]) ** -2
    shared[[ATTITUDE_LATENCY, POSITION_LATENCY]] = config.latency_std_s**-2
    fact = config.frames_per_fact
    return Weights(
        acceleration=(config.acceleration_m_s2 / fps**2) ** -2,
        camera_acceleration=(config.camera_acceleration_m_s2 / fps**2) ** -2,
        depth=config.depth_weight / np.maximum(data.depth_sigma, 0.01),
        wander=fact * wander,
        first=fact * first,
        shared=fact * shared,
    )


class Residuals:
    """Residuals at one point.

    contact : (F - 1, 4) probability that a point of ``FEET`` keeps its place between two frames
    contact_weight : of that step, 1 = its standard deviation as configured
    """

    def __init__(
        self, data: WorldInput, weights: Weights, state: WorldState, contact: np.ndarray, contact_weight: float
    ) -> None:
        config, shared = data.config, state.globals
        self.data, self.weights, self.state = data, weights, state
        path = state.path(data.telemetry)
        self.turn = shared[MISALIGNMENT] + state.camera[:, 3:]
        correction = exp_so3(self.turn)
        self.rotation = correction @ path.rotation
        self.position = path.position + state.camera[:, :3]
        self.velocity = path.velocity
        self.turn_rate = np.einsum("fij,fj->fi", correction, path.turn_rate)
        joints = state.joints
        self.seen = (joints - shared[SCALE] * self.position[:, None]) @ np.swapaxes(self.rotation, 1, 2)
        self.depth = np.maximum(self.seen[..., 2], _NEAREST_M)
        focal, centre = np.diagonal(data.camera_matrix)[:2], data.camera_matrix[:2, 2]
        pixels = focal * self.seen[..., :2] / self.depth[..., None] + centre
        self.image = np.where(data.weight[..., None] > 0, pixels - data.keypoints, 0.0)
        square = np.square(self.image).sum(-1) * data.weight
        self.robust = 1.0 / (1.0 + square / _OUTLIER_SQUARE)
        self.view = data.telemetry.view
        self.relief = np.einsum("fpi,fi->fp", joints - joints[:, :1], self.view) - data.depth
        self.rounded = np.sqrt(np.square(self.relief) + _DEPTH_ROUNDING_M**2)
        span = joints[:, SPANS[:, 1]] - joints[:, SPANS[:, 0]]
        length = np.sqrt(np.square(span).sum(-1) + 1e-10)
        self.direction = span / length[..., None]
        self.stretch = (length - shared[LENGTHS]) / SPAN_STD_M
        self.swing = joints[2:] - 2 * joints[1:-1] + joints[:-2]
        flown = data.telemetry.position + state.camera[:, :3]
        self.camera_swing = flown[2:] - 2 * flown[1:-1] + flown[:-2]
        feet = joints[:, FEET]
        self.step = feet[1:] - feet[:-1]
        self.step_weight = contact_weight * contact / (config.contact_speed_m_s / data.fps) ** 2
        self.height = 0.5 * (feet[1:, :, 2] + feet[:-1, :, 2]) - shared[FLOOR] - FEET_HEIGHT_M
        self.height_weight = contact / _FLOOR_STD_M**2
        self.drift = np.diff(state.camera, axis=0)
        self.gauge = (shared[:BONES].sum() - data.lengths[:BONES].sum()) / GAUGE_M
        self.prior = shared.copy()
        self.prior[LENGTHS] -= data.lengths
        self.prior[SCALE] = np.log(shared[SCALE])
        self.terms = {
            "reprojection": 0.5 * float((square * self.robust).sum()),
            "lifter_depth": float((weights.depth * (self.rounded - _DEPTH_ROUNDING_M)).sum()),
            "articulation": 0.5 * float(np.square(self.stretch).sum()),
            "acceleration": 0.5 * weights.acceleration * float(np.square(self.swing).sum()),
            "contact": 0.5 * float((self.step_weight[..., None] * np.square(self.step)).sum()),
            "floor": 0.5 * float((self.height_weight * np.square(self.height)).sum()),
            "telemetry": 0.5 * float((weights.wander * np.square(self.drift)).sum())
            + 0.5 * float((weights.first * np.square(state.camera[0])).sum())
            + 0.5 * weights.camera_acceleration * float(np.square(self.camera_swing).sum()),
            "priors": 0.5 * float((weights.shared * np.square(self.prior)).sum()) + 0.5 * self.gauge**2,
        }
        self.cost = sum(self.terms.values())

    def image_weight(self) -> np.ndarray:
        """(F, 17) weight of the squared image residual at this point."""
        weight: np.ndarray = self.data.weight * np.square(self.robust)
        return weight

    def image_by_seen(self) -> np.ndarray:
        """(F, 17, 2, 3) derivative of the image point by the joint in camera axes."""
        focal = np.diagonal(self.data.camera_matrix)[:2]
        out = np.zeros((*self.seen.shape[:2], 2, 3))
        out[..., 0, 0], out[..., 1, 1] = focal[0] / self.depth, focal[1] / self.depth
        out[..., 2] = np.where(
            (self.seen[..., 2] > _NEAREST_M)[..., None],
            -focal * self.seen[..., :2] / np.square(self.depth)[..., None], 0.0,
        )  # fmt: skip
        return out

    def by_turn(self) -> np.ndarray:
        """(F, 17, 3, 3) derivative of the joints in camera axes by the rotation's error."""
        turned: np.ndarray = -hat(self.seen) @ left_jacobian(self.turn)[:, None]
        return turned

    def by_shared(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (F, 17, 3, 6) of the joints in camera axes by the shared unknowns of the camera, and which."""
        scale = self.state.globals[SCALE]
        columns = np.empty((*self.seen.shape, 6))
        columns[..., 0] = -np.einsum("fij,fj->fi", self.rotation, self.position)[:, None]
        columns[..., 1:4] = self.by_turn()
        columns[..., 4] = -np.einsum("fpij,fj->fpi", hat(self.seen), self.turn_rate)
        columns[..., 5] = -scale * np.einsum("fij,fj->fi", self.rotation, self.velocity)[:, None]
        which = np.r_[SCALE, MISALIGNMENT, ATTITUDE_LATENCY, POSITION_LATENCY]
        return columns, which


def gradient(r: Residuals) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the cost by the unknowns of every frame (F, FRAME) and by the shared ones (GLOBALS,)."""
    weights, state = r.weights, r.state
    frames = np.zeros((len(state.joints), FRAME))
    camera = frames[:, :CAMERA]
    joints = frames[:, CAMERA:].reshape(state.joints.shape)
    shared = np.zeros(GLOBALS)
    pull = np.einsum("fp,fpki,fpk->fpi", r.image_weight(), r.image_by_seen(), r.image)  # by the joint in camera axes
    joints += pull @ r.rotation
    camera[:, :3] -= state.globals[SCALE] * np.einsum("fpi,fij->fj", pull, r.rotation)
    camera[:, 3:] += np.einsum("fpi,fpij->fj", pull, r.by_turn())
    columns, which = r.by_shared()
    shared[which] += np.einsum("fpi,fpij->j", pull, columns)
    relief = (weights.depth * r.relief / r.rounded)[..., None] * r.view[:, None]
    joints += relief
    joints[:, 0] -= relief.sum(axis=1)
    stretch = (r.stretch / SPAN_STD_M)[..., None] * r.direction
    for k, (a, b) in enumerate(SPANS):
        joints[:, b] += stretch[:, k]
        joints[:, a] -= stretch[:, k]
    shared[LENGTHS] -= (r.stretch / SPAN_STD_M).sum(axis=0)
    shared[:BONES] += r.gauge / GAUGE_M
    for swing, weight, into in (
        (r.swing, weights.acceleration, joints), (r.camera_swing, weights.camera_acceleration, camera[:, :3]),
    ):  # fmt: skip
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
    by_prior = weights.shared * r.prior
    by_prior[SCALE] /= state.globals[SCALE]
    return frames, shared + by_prior
