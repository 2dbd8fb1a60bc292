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
from numpy.lib.stride_tricks import as_strided

from drocap_ros.contacts import ANKLE_M, FEET, HEIGHT_STD_M, step_height
from drocap_ros.reconstruction.common.engine import (
    Equations,
    add_second_difference,
    pull_second_difference,
    second_difference,
)
from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.view_residuals import (
    CAMERA_COLUMNS,
    OF_CAMERA,
    OUTLIER_SQUARE,
    ViewResiduals,
    ViewWeights,
    errors_precision,
    view_weights,
)
from drocap_ros.reconstruction.world.world_model import (
    BONES,
    CALIBRATED,
    CAMERA,
    FLOOR,
    GAUGE_M,
    GLOBALS,
    JOINTS,
    LENGTHS,
    LENS,
    OF_VIEW,
    OWN,
    SCALE,
    SPAN_STD_M,
    WorldInput,
    WorldState,
    joint_columns,
    shared_columns,
)


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
    # Standard deviation (m) of the floor's height where no foot is in contact: any height.
    shared[FLOOR, FLOOR] = (config.ground_m or 1000.0) ** -2
    expected[FLOOR] = ANKLE_M if config.ground_m else 0.0
    shared[SCALE, SCALE] = config.stature_std**-2
    for number, view in enumerate(data.views):
        own = shared_columns(number)[OF_VIEW]
        shared[np.ix_(own, own)] = errors_precision(view)
        expected[own[LENS - OF_VIEW.start]] = view.doubt.lens[0]
    if data.known is not None:
        shared[CALIBRATED, CALIBRATED] += data.known.precision
        expected[CALIBRATED] = np.linalg.solve(shared[CALIBRATED, CALIBRATED], data.known.vector)
    return WorldWeights(
        views=tuple(view_weights(view, not data.further) for view in data.views),
        acceleration=(config.acceleration_m_s2 / data.fps**2) ** -2,
        shared=config.frames_per_fact * shared,
        expected=expected,
    )


class Contacts(NamedTuple):
    """What is judged anew before every step of an adjustment: feet in contact, and outliers in the image.

    probability : (F - 1, 4) that a point of ``FEET`` keeps its place between two frames
    weight : of that step, 1 = its standard deviation as configured
    ground : (F - 1, 4) 1/m^2, weight of the height of a lower ankle that stands on the ground, or near it
    outlier : squared image residual, in standard deviations, at which a joint has half its weight
    floor_std : m, spread of the heights of feet in contact
    """

    probability: np.ndarray
    weight: float
    ground: np.ndarray | float = 0.0
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
        # Square (m^2) below which a bone has no direction: a hundredth of a millimetre.
        length = np.sqrt(np.square(span).sum(-1) + 1e-10)
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
        self.height_weight = touching / self.contacts.floor_std**2 + self.contacts.ground

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


_BODY = 3 * JOINTS
#: (17, 18) whether a joint is an end of a span.
_ENDS = np.array([[float(joint in span) for span in SPANS] for joint in range(JOINTS)])


def normal_equations(r: WorldResiduals) -> Equations:
    """The equations at a point.

    They need double precision: the small weight that holds body and camera together in their place is what remains of
    large elements.
    """
    frames, views, size = len(r.state.joints), len(r.views), joint_columns(len(r.views)).stop
    shared, width = len(r.state.globals), 2 * size + 1  # couplings reach two frames on
    band, border = np.zeros((frames, size, width)), np.zeros((frames, size, shared))
    corner = np.zeros((shared, shared))
    # In the band's memory, element [r, c] of a frame's block is r (W - 1) + c.
    step = band.itemsize
    blocks = as_strided(band, (frames, size, size), (size * width * step, (width - 1) * step, step))
    for number, view in enumerate(r.views):
        _add_view(view, slice(CAMERA * number, CAMERA * (number + 1)), shared_columns(number), (blocks, border, corner))
    _add_body(r, blocks[:, CAMERA * views :, CAMERA * views :], border[:, CAMERA * views :], corner)
    # Elements below the diagonal, of the cameras' blocks at most, lie here, in the rows before theirs.
    band[:, :, 1 - CAMERA :] = 0.0
    _add_time(r, band)
    corner[:BONES, :BONES] += GAUGE_M**-2
    prior = r.weights.shared.copy()
    prior[SCALE] /= r.state.globals[SCALE]
    prior[:, SCALE] /= r.state.globals[SCALE]
    corner += prior
    return Equations(band.reshape(frames * size, width), border.reshape(frames * size, shared), corner)


def _add_view(
    r: ViewResiduals, at: slice, columns: np.ndarray, into: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """Add a view, whose camera's errors are at these places, to blocks, border and corner."""
    blocks, border, corner = into
    _, by_joint, camera = r.image_derivatives
    frames, own, body = len(by_joint), columns[OF_CAMERA], blocks.shape[1] - _BODY
    turned, along = r.depth_derivatives, (r.weights.depth / r.rounded)[..., None]
    square = np.swapaxes(camera, 1, 2) @ camera + np.swapaxes(turned, 1, 2) @ (along * turned)
    blocks[:, at, at] = square[:, :CAMERA, :CAMERA]
    border[:, at, own] = square[:, :CAMERA, CAMERA_COLUMNS]
    corner[np.ix_(own, own)] += square[:, CAMERA_COLUMNS[:, None], CAMERA_COLUMNS].sum(axis=0)
    rows = by_joint.reshape(frames, JOINTS, 2, 3)
    joint = rows[:, :, 0, :, None] * rows[:, :, 0, None, :] + rows[:, :, 1, :, None] * rows[:, :, 1, None, :]
    depth = along[:, 1:, :, None] * (r.view[:, :, None] * r.view[:, None, :])[:, None]
    joint[:, 1:] += depth
    joint[:, 0] += depth.sum(axis=1)
    for j in range(JOINTS):
        here = slice(body + 3 * j, body + 3 * j + 3)
        blocks[:, here, here] += joint[:, j]
        if j:
            blocks[:, body : body + 3, here] -= depth[:, j - 1]
    both = camera.reshape(frames, JOINTS, 2, -1)
    coupling = rows[:, :, 0, :, None] * both[:, :, 0, None, :] + rows[:, :, 1, :, None] * both[:, :, 1, None, :]
    by_depth = r.view[:, None, :, None] * (along * turned)[:, :, None]
    coupling += by_depth
    coupling[:, 0] -= by_depth.sum(axis=1)
    coupling = coupling.reshape(frames, _BODY, -1)
    blocks[:, at, body:] = np.swapaxes(coupling[..., :CAMERA], 1, 2)
    border[:, body:, own] += coupling[..., CAMERA_COLUMNS]


def _add_body(r: WorldResiduals, blocks: np.ndarray, border: np.ndarray, corner: np.ndarray) -> None:
    """Add bones, feet and floor within a frame, in upper triangles."""
    frames = len(blocks)
    precision = SPAN_STD_M**-2
    slope = precision[:, None] * r.direction
    # A bone that is too long is stiff across, too: without this term its turn and its length take turns for many steps.
    across = (precision * np.maximum(r.excess, 0.0))[..., None]
    outer = (slope - across * r.direction)[..., :, None] * r.direction[..., None, :] + across[..., None] * np.eye(3)
    own = (_ENDS @ outer.reshape(frames, len(SPANS), 9)).reshape(frames, JOINTS, 3, 3)
    for i, foot in enumerate(FEET):
        step, height = r.step_weight[:, i], 0.25 * r.height_weight[:, i]
        for part in (slice(1, None), slice(None, -1)):
            own[part, foot] += step[:, None, None] * np.eye(3)
            own[part, foot, 2, 2] += height
            border[part, 3 * foot + 2, FLOOR] -= 2 * height
    for j in range(JOINTS):
        at = slice(3 * j, 3 * j + 3)
        blocks[:, at, at] += own[:, j]
    for k, (a, b) in enumerate(np.sort(SPANS, axis=1)):
        blocks[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] -= outer[:, k]
    for k, (a, b) in enumerate(SPANS):
        border[:, 3 * b : 3 * b + 3, k] -= slope[:, k]
        border[:, 3 * a : 3 * a + 3, k] += slope[:, k]
    corner[LENGTHS, LENGTHS] += np.diag(frames * precision)
    corner[FLOOR, FLOOR] += float(r.height_weight.sum())


def _add_time(r: WorldResiduals, band: np.ndarray) -> None:
    """Add the couplings between frames: accelerations, contacts, wander of the cameras' errors."""
    # Of every unknown with itself, and with itself one frame on: the band's memory is passed once.
    size, body = band.shape[1], CAMERA * len(r.views)
    own, after = np.zeros((2, len(band), size))
    steady = np.full(size, r.weights.acceleration)
    for number, view in enumerate(r.weights.views):
        at = slice(CAMERA * number, CAMERA * (number + 1))
        steady[at] = np.repeat([view.acceleration, 0.0], 3)
        own[1:, at] += view.wander
        own[:-1, at] += view.wander
        after[:-1, at] -= view.wander
        own[0, at] += view.first
    add_second_difference(steady, own, after, band[:, :, 2 * size])
    for i, foot in enumerate(FEET):
        at = slice(body + 3 * foot, body + 3 * foot + 3)
        after[:-1, at] -= r.step_weight[:, i, None]
        after[:-1, at.stop - 1] += 0.25 * r.height_weight[:, i]
    band[:, :, 0] += own
    band[:, :, size] = after
