"""One point of the adjustment in the world: cost, gradient and equations of body and cameras.

- of every view, see :mod:`.view_residuals`: keypoints, the lifter's depths, the errors of its camera,
- the deviation of every bone from its length,
- the accelerations of the joints,
- the step of a foot between two frames in contact, and its height above the floor,
- the priors of lengths, scale, misalignments and latencies.

The unknowns of a frame are the errors of every camera, then the joints; the shared ones are those of the first view,
then each further camera's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.contacts import FEET, HEIGHT_STD_M, step_height
from drocap_ros.reconstruction.common.engine import Equations, pull_second_difference, second_difference
from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.view_residuals import (
    OF_CAMERA,
    OUTLIER_SQUARE,
    ViewResiduals,
    ViewWeights,
    errors_precision,
    view_weights,
)
from drocap_ros.reconstruction.world.world_equations import normal_equations
from drocap_ros.reconstruction.world.world_model import (
    BONES,
    CALIBRATED,
    CAMERA,
    FLOOR,
    GAUGE_M,
    GLOBALS,
    LENGTHS,
    OF_VIEW,
    OWN,
    SCALE,
    SPAN_STD_M,
    WorldInput,
    WorldState,
    joint_columns,
    shared_columns,
)

#: Square (m^2) below which a bone has no direction: a hundredth of a millimetre.
_LEAST_SQUARE_M2 = 1e-10
#: Standard deviation (m) of the floor's height where no foot is in contact: any height.
_ANY_FLOOR_M = 1000.0


class WorldWeights(NamedTuple):
    """Weights of one adjustment that do not depend on the unknowns; the names are those of the terms.

    views : of each view
    shared : (S, S) inverse covariance of the priors
    expected : (S,) their means: the logarithm of the scale, and differences from the lifter's lengths
    """

    views: tuple[ViewWeights, ...]
    acceleration: float
    shared: np.ndarray
    expected: np.ndarray


def weights_of(data: WorldInput) -> WorldWeights:
    """Weights from the parameters and from the telemetry's roughness."""
    config, size = data.config, GLOBALS + OWN * len(data.further)
    shared, expected = np.zeros((size, size)), np.zeros(size)
    shared[LENGTHS, LENGTHS] = np.diag((config.length_std * data.lengths) ** -2)
    shared[FLOOR, FLOOR] = _ANY_FLOOR_M**-2
    shared[SCALE, SCALE] = config.stature_std**-2
    for number, view in enumerate(data.views):
        own = shared_columns(number)[OF_VIEW]
        shared[np.ix_(own, own)] = errors_precision(view)
    if data.known is not None:
        shared[CALIBRATED, CALIBRATED] += data.known.precision
        expected[CALIBRATED] = np.linalg.solve(shared[CALIBRATED, CALIBRATED], data.known.vector)
    return WorldWeights(
        views=tuple(view_weights(view) for view in data.views),
        acceleration=(config.acceleration_m_s2 / data.fps**2) ** -2,
        shared=config.frames_per_fact * shared,
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
        self.views = [
            ViewResiduals(view, weights.views[number], state.of_view(number), contacts.outlier)
            for number, view in enumerate(data.views)
        ]
        self._compare_body()
        self._compare_feet()
        self._compare_shared()
        self.terms = self._terms()
        self.cost = sum(self.terms.values())

    def _compare_body(self) -> None:
        """Bones with their lengths, and joints with a steady motion."""
        joints, lengths = self.state.joints, self.state.globals[LENGTHS]
        span = joints[:, SPANS[:, 1]] - joints[:, SPANS[:, 0]]
        length = np.sqrt(np.square(span).sum(-1) + _LEAST_SQUARE_M2)
        self.direction = span / length[..., None]
        self.stretch = (length - lengths) / SPAN_STD_M
        self.excess = 1.0 - lengths / length
        self.swing = second_difference(joints)

    def _compare_feet(self) -> None:
        """Feet in contact with their place one frame before, and with the floor."""
        feet, config = self.state.joints[:, FEET], self.data.config
        self.step = feet[1:] - feet[:-1]
        touching = self.contacts.probability
        self.step_weight = self.contacts.weight * touching / (config.contact_speed_m_s / self.data.fps) ** 2
        self.height = step_height(feet, self.state.globals[FLOOR])
        self.height_weight = touching / self.contacts.floor_std**2

    def _compare_shared(self) -> None:
        """Lengths, scale, misalignments and latencies with their priors."""
        shared, lengths = self.state.globals, self.data.lengths
        self.gauge = (shared[:BONES].sum() - lengths[:BONES].sum()) / GAUGE_M
        self.prior = shared.copy()
        self.prior[LENGTHS] -= lengths
        self.prior[SCALE] = np.log(shared[SCALE])
        self.prior -= self.weights.expected

    def _terms(self) -> dict[str, float]:
        """The cost, term by term."""
        weights = self.weights
        return {name: sum(view.terms[name] for view in self.views) for name in self.views[0].terms} | {
            "articulation": 0.5 * float(np.square(self.stretch).sum()),
            "acceleration": 0.5 * weights.acceleration * float(np.square(self.swing).sum()),
            "contact": 0.5 * float((self.step_weight[..., None] * np.square(self.step)).sum()),
            "floor": 0.5 * float((self.height_weight * np.square(self.height)).sum()),
            "priors": 0.5 * float(self.prior @ weights.shared @ self.prior) + 0.5 * self.gauge**2,
        }

    def moved(self, frames: np.ndarray, shared: np.ndarray) -> WorldResiduals:
        """Residuals of the same cost after a step."""
        return WorldResiduals(self.data, self.weights, self.state.moved(frames, shared), self.contacts)

    def usual_outlier(self) -> float:
        """The largest of the views'."""
        return max(view.usual_outlier() for view in self.views)

    def equations(self) -> Equations:
        """Normal equations here."""
        return normal_equations(self)

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the cost by the unknowns of every frame and by the shared ones."""
        state, weights = self.state, self.weights
        at = joint_columns(len(self.views))
        frames, shared = np.zeros((len(state.joints), at.stop)), np.zeros(len(state.globals))
        joints = frames[:, at].reshape(state.joints.shape)
        for number, view in enumerate(self.views):
            own = np.zeros(len(OF_CAMERA))
            view.add_gradient(frames[:, CAMERA * number : CAMERA * (number + 1)], joints, own)
            shared[shared_columns(number)[OF_CAMERA]] += own
        stretch = (self.stretch / SPAN_STD_M)[..., None] * self.direction
        for k, (a, b) in enumerate(SPANS):
            joints[:, b] += stretch[:, k]
            joints[:, a] -= stretch[:, k]
        shared[LENGTHS] -= (self.stretch / SPAN_STD_M).sum(axis=0)
        shared[:BONES] += self.gauge / GAUGE_M
        pull_second_difference(joints, weights.acceleration * self.swing)
        step = self.step_weight[..., None] * self.step
        height = self.height_weight * self.height
        for i, foot in enumerate(FEET):
            joints[1:, foot] += step[:, i]
            joints[:-1, foot] -= step[:, i]
            joints[1:, foot, 2] += 0.5 * height[:, i]
            joints[:-1, foot, 2] += 0.5 * height[:, i]
        shared[FLOOR] -= height.sum()
        by_prior = weights.shared @ self.prior
        by_prior[SCALE] /= state.globals[SCALE]
        return frames, shared + by_prior
