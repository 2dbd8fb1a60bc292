"""Normal equations of the adjustment in the world: a band of the frames, bordered by the shared unknowns.

Gauss-Newton: second derivatives of the residuals are left out, and robust terms have the weight of the present point.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided

from drocap_ros.contacts import FEET
from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.world_model import (
    BONES,
    CAMERA,
    FLOOR,
    FRAME,
    GLOBALS,
    JOINTS,
    LENGTHS,
    SCALE,
    SPAN_STD_M,
)
from drocap_ros.reconstruction.world.world_residuals import CAMERA_COLUMNS, GAUGE_M, OF_CAMERA, WorldResiduals

_BODY = 3 * JOINTS
#: (17, 18) whether a joint is an end of a span.
_ENDS = np.array([[float(joint in span) for span in SPANS] for joint in range(JOINTS)])
#: Couplings reach two frames on.
WIDTH = 2 * FRAME + 1


def normal_matrix(r: WorldResiduals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Band (F * FRAME, WIDTH), border (F * FRAME, GLOBALS) and corner (GLOBALS, GLOBALS).

    Element [i, d] of the band couples unknowns i and i + d.  It needs double precision: the small weight that holds
    body and camera together in their place is what remains of large elements.
    """
    frames = len(r.state.joints)
    band, border = np.zeros((frames, FRAME, WIDTH)), np.zeros((frames, FRAME, GLOBALS))
    corner = np.zeros((GLOBALS, GLOBALS))
    # In the band's memory, element [r, c] of a frame's block is r (WIDTH - 1) + c.
    step = band.itemsize
    blocks = as_strided(band, (frames, FRAME, FRAME), (FRAME * WIDTH * step, (WIDTH - 1) * step, step))
    _set_image_part(r, blocks, border, corner)
    _add_body(r, blocks, border, corner)
    # Elements below the diagonal, of the camera's block at most, lie here, in the rows before theirs.
    band[:, :, 1 - CAMERA :] = 0.0
    _add_time(r, band)
    corner[:BONES, :BONES] += r.weights.body * GAUGE_M**-2
    prior = r.weights.shared.copy()
    prior[SCALE] /= r.state.globals[SCALE]
    prior[:, SCALE] /= r.state.globals[SCALE]
    corner += prior
    return band.reshape(frames * FRAME, WIDTH), border.reshape(frames * FRAME, GLOBALS), corner


def _set_image_part(r: WorldResiduals, blocks: np.ndarray, border: np.ndarray, corner: np.ndarray) -> None:
    """Set the part of the reprojection, and that of the depths that the camera has, of blocks, border and corner."""
    _, by_joint, camera = r.image_derivatives
    frames = len(by_joint)
    turned, along = r.depth_derivatives, (r.weights.depth / r.rounded)[..., None]
    own = np.swapaxes(camera, 1, 2) @ camera + np.swapaxes(turned, 1, 2) @ (along * turned)
    blocks[:, :CAMERA, :CAMERA] = own[:, :CAMERA, :CAMERA]
    border[:, :CAMERA, OF_CAMERA] = own[:, :CAMERA, CAMERA_COLUMNS]
    corner[np.ix_(OF_CAMERA, OF_CAMERA)] = own[:, CAMERA_COLUMNS[:, None], CAMERA_COLUMNS].sum(axis=0)
    rows = by_joint.reshape(frames, JOINTS, 2, 3)
    joint = rows[:, :, 0, :, None] * rows[:, :, 0, None, :] + rows[:, :, 1, :, None] * rows[:, :, 1, None, :]
    for j in range(JOINTS):
        at = slice(CAMERA + 3 * j, CAMERA + 3 * j + 3)
        blocks[:, at, at] = joint[:, j]
    both = camera.reshape(frames, JOINTS, 2, 9)
    coupling = rows[:, :, 0, :, None] * both[:, :, 0, None, :] + rows[:, :, 1, :, None] * both[:, :, 1, None, :]
    by_depth = r.view[:, None, :, None] * (along * turned)[:, :, None]
    coupling += by_depth
    coupling[:, 0] -= by_depth.sum(axis=1)
    coupling = coupling.reshape(frames, _BODY, 9)
    blocks[:, :CAMERA, CAMERA:] = np.swapaxes(coupling[..., :CAMERA], 1, 2)
    border[:, CAMERA:, OF_CAMERA] = coupling[..., CAMERA_COLUMNS]


def _add_body(r: WorldResiduals, blocks: np.ndarray, border: np.ndarray, corner: np.ndarray) -> None:
    """Add the terms within a frame, in upper triangles: depths, bones, feet and floor."""
    frames = len(blocks)
    own = np.zeros((frames, JOINTS, 3, 3))
    along = r.weights.depth / r.rounded
    depth = along[:, 1:, None, None] * (r.view[:, :, None] * r.view[:, None, :])[:, None]
    own[:, 1:] += depth
    own[:, 0] += depth.sum(axis=1)
    precision = r.weights.body * SPAN_STD_M**-2
    slope = precision[:, None] * r.direction
    # A bone that is too long is stiff across, too: without this term its turn and its length take turns for many steps.
    across = (precision * np.maximum(r.excess, 0.0))[..., None]
    outer = (slope - across * r.direction)[..., :, None] * r.direction[..., None, :] + across[..., None] * np.eye(3)
    own += (_ENDS @ outer.reshape(frames, len(SPANS), 9)).reshape(own.shape)
    for i, foot in enumerate(FEET):
        step, height = r.step_weight[:, i], 0.25 * r.height_weight[:, i]
        for part in (slice(1, None), slice(None, -1)):
            own[part, foot] += step[:, None, None] * np.eye(3)
            own[part, foot, 2, 2] += height
            border[part, CAMERA + 3 * foot + 2, FLOOR] -= 2 * height
    for j in range(JOINTS):
        at = slice(CAMERA + 3 * j, CAMERA + 3 * j + 3)
        blocks[:, at, at] += own[:, j]
        if j:
            blocks[:, CAMERA : CAMERA + 3, at] -= depth[:, j - 1]
    for k, (a, b) in enumerate(np.sort(SPANS, axis=1)):
        blocks[:, CAMERA + 3 * a : CAMERA + 3 * a + 3, CAMERA + 3 * b : CAMERA + 3 * b + 3] -= outer[:, k]
    for k, (a, b) in enumerate(SPANS):
        border[:, CAMERA + 3 * b : CAMERA + 3 * b + 3, k] -= slope[:, k]
        border[:, CAMERA + 3 * a : CAMERA + 3 * a + 3, k] += slope[:, k]
    corner[LENGTHS, LENGTHS] += np.diag(frames * precision)
    corner[FLOOR, FLOOR] += float(r.height_weight.sum())


def _add_time(r: WorldResiduals, band: np.ndarray) -> None:
    """Add the couplings between frames: accelerations, contacts, wander of the camera's errors."""
    # Of every unknown with itself, and with itself one frame on: the band's memory is passed once.
    own, after = np.zeros((2, len(band), FRAME))
    steady = np.full(FRAME, r.weights.acceleration)
    steady[:CAMERA] = np.repeat([r.weights.camera_acceleration, 0.0], 3)
    count = len(band) - 2
    if count > 0:
        for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
            own[offset : count + offset] += factor * steady
        after[:count] -= 2 * steady
        after[1:-1] -= 2 * steady
        band[:count, :, 2 * FRAME] = steady
    for i, foot in enumerate(FEET):
        at = CAMERA + 3 * foot
        after[:-1, at : at + 3] -= r.step_weight[:, i, None]
        after[:-1, at + 2] += 0.25 * r.height_weight[:, i]
    own[1:, :CAMERA] += r.weights.wander
    own[:-1, :CAMERA] += r.weights.wander
    after[:-1, :CAMERA] -= r.weights.wander
    own[0, :CAMERA] += r.weights.first
    band[:, :, 0] += own
    band[:, :, FRAME] = after
