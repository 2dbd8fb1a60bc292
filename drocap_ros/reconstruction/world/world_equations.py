"""Normal equations of the adjustment in the world: a band of the frames, bordered by the shared unknowns.

Gauss-Newton: second derivatives of the residuals are left out, and robust terms have the weight of the present point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import as_strided

from drocap_ros.contacts import FEET
from drocap_ros.reconstruction.common.engine import Equations, add_second_difference
from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.view_residuals import CAMERA_COLUMNS, OF_CAMERA, ViewResiduals
from drocap_ros.reconstruction.world.world_model import (
    BONES,
    CAMERA,
    FLOOR,
    GAUGE_M,
    JOINTS,
    LENGTHS,
    SCALE,
    SPAN_STD_M,
    joint_columns,
    shared_columns,
)

if TYPE_CHECKING:
    from drocap_ros.reconstruction.world.world_residuals import WorldResiduals

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
    both = camera.reshape(frames, JOINTS, 2, 9)
    coupling = rows[:, :, 0, :, None] * both[:, :, 0, None, :] + rows[:, :, 1, :, None] * both[:, :, 1, None, :]
    by_depth = r.view[:, None, :, None] * (along * turned)[:, :, None]
    coupling += by_depth
    coupling[:, 0] -= by_depth.sum(axis=1)
    coupling = coupling.reshape(frames, _BODY, 9)
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
