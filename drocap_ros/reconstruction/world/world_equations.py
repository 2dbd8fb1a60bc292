"""Normal equations of the adjustment in the world: a band of the frames, bordered by the shared unknowns.

Gauss-Newton: second derivatives of the residuals are left out, and robust terms have the weight of the present point.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.lifted.adjustment import SPANS
from drocap_ros.reconstruction.world.world_model import (
    BONES,
    CAMERA,
    FEET,
    FLOOR,
    FRAME,
    GLOBALS,
    JOINTS,
    LENGTHS,
    SCALE,
    SPAN_STD_M,
)
from drocap_ros.reconstruction.world.world_residuals import GAUGE_M, Residuals

_BODY = 3 * JOINTS
#: Couplings reach two frames on.
WIDTH = 2 * FRAME + 1


def normal_matrix(r: Residuals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Band (F * FRAME, WIDTH), border (GLOBALS, F * FRAME) and corner (GLOBALS, GLOBALS).

    Element [i, d] of the band couples unknowns i and i + d.
    """
    blocks, border, corner = _image_part(r)
    _add_body(r, blocks, border, corner)
    frames = len(blocks)
    band = np.zeros((frames, FRAME, WIDTH))
    for i in range(FRAME):
        band[:, i, : FRAME - i] = blocks[:, i, i:]
    _add_time(r, band)
    corner[:BONES, :BONES] += GAUGE_M**-2
    prior = r.weights.shared.copy()
    prior[SCALE] /= r.state.globals[SCALE] ** 2
    corner[np.arange(GLOBALS), np.arange(GLOBALS)] += prior
    return band.reshape(frames * FRAME, WIDTH), border.reshape(GLOBALS, -1), corner


def _image_part(r: Residuals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks (F, FRAME, FRAME), border (GLOBALS, F, FRAME) and corner of the reprojection."""
    by_seen = r.image_by_seen()
    # The weight of a joint as a matrix in camera axes: every derivative below is one of the joint in these axes.
    information = np.einsum("fp,fpki,fpkj->fpij", r.image_weight(), by_seen, by_seen)
    frames = len(by_seen)
    turn = np.swapaxes(r.rotation, 1, 2)[:, None]
    by_joint = turn @ information  # (F, 17, 3, 3): rows in world axes
    camera = np.empty((frames, JOINTS, 3, CAMERA))
    camera[..., :3] = -r.state.globals[SCALE] * r.rotation[:, None]
    camera[..., 3:] = r.by_turn()
    shared, which = r.by_shared()
    blocks = np.zeros((frames, FRAME, FRAME))
    joint_blocks = by_joint @ r.rotation[:, None]
    for j in range(JOINTS):
        at = slice(CAMERA + 3 * j, CAMERA + 3 * j + 3)
        blocks[:, at, at] = joint_blocks[:, j]
    coupling = (by_joint @ camera).reshape(frames, _BODY, CAMERA)
    blocks[:, CAMERA:, :CAMERA] = coupling
    blocks[:, :CAMERA, CAMERA:] = np.swapaxes(coupling, 1, 2)
    weighted = information @ camera
    blocks[:, :CAMERA, :CAMERA] = np.einsum("fpij,fpik->fjk", camera, weighted)
    border = np.zeros((GLOBALS, frames, FRAME))
    border[which, :, CAMERA:] = (by_joint @ shared).reshape(frames, _BODY, -1).transpose(2, 0, 1)
    border[which, :, :CAMERA] = np.einsum("fpij,fpik->kfj", weighted, shared)
    corner = np.zeros((GLOBALS, GLOBALS))
    corner[np.ix_(which, which)] = np.einsum("fpij,fpik->jk", shared, information @ shared)
    return blocks, border, corner


def _add_body(r: Residuals, blocks: np.ndarray, border: np.ndarray, corner: np.ndarray) -> None:
    """Add the terms within a frame: depths, bones, feet and floor."""
    frames = len(blocks)
    body = np.zeros((frames, JOINTS, 3, JOINTS, 3))
    along = r.weights.depth / r.rounded
    view = r.view[:, :, None] * r.view[:, None, :]
    for j in range(1, JOINTS):
        m = along[:, j, None, None] * view
        body[:, j, :, j] += m
        body[:, 0, :, 0] += m
        body[:, j, :, 0] -= m
        body[:, 0, :, j] -= m
    precision = SPAN_STD_M**-2
    outer = precision[:, None, None] * r.direction[..., :, None] * r.direction[..., None, :]
    slope = precision[:, None] * r.direction
    by_length = border[LENGTHS, :, CAMERA:].reshape(len(SPANS), frames, JOINTS, 3)
    for k, (a, b) in enumerate(SPANS):
        m = outer[:, k]
        body[:, a, :, a] += m
        body[:, b, :, b] += m
        body[:, a, :, b] -= m
        body[:, b, :, a] -= m
        by_length[k, :, b] -= slope[:, k]
        by_length[k, :, a] += slope[:, k]
    border[LENGTHS, :, CAMERA:] = by_length.reshape(len(SPANS), frames, _BODY)
    corner[LENGTHS, LENGTHS] += np.diag(frames * precision)
    for i, foot in enumerate(FEET):
        step, height = r.step_weight[:, i], 0.25 * r.height_weight[:, i]
        for part in (slice(1, None), slice(None, -1)):
            body[part, foot, :, foot] += step[:, None, None] * np.eye(3)
            body[part, foot, 2, foot, 2] += height
            border[FLOOR, part, CAMERA + 3 * foot + 2] -= 2 * height
    corner[FLOOR, FLOOR] += float(r.height_weight.sum())
    blocks[:, CAMERA:, CAMERA:] += body.reshape(frames, _BODY, _BODY)


def _add_time(r: Residuals, band: np.ndarray) -> None:
    """Add the couplings between frames: accelerations, contacts, wander of the camera's errors."""
    for rows, weight in (
        (slice(CAMERA, None), r.weights.acceleration), (slice(0, 3), r.weights.camera_acceleration),
    ):  # fmt: skip
        count = len(band) - 2
        if count > 0:
            for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
                band[offset : count + offset, rows, 0] += factor * weight
            band[:count, rows, FRAME] -= 2 * weight
            band[1:-1, rows, FRAME] -= 2 * weight
            band[:count, rows, 2 * FRAME] += weight
    for i, foot in enumerate(FEET):
        at = CAMERA + 3 * foot
        band[:-1, at : at + 3, FRAME] -= r.step_weight[:, i, None]
        band[:-1, at + 2, FRAME] += 0.25 * r.height_weight[:, i]
    band[1:, :CAMERA, 0] += r.weights.wander
    band[:-1, :CAMERA, 0] += r.weights.wander
    band[:-1, :CAMERA, FRAME] -= r.weights.wander
    band[0, :CAMERA, 0] += r.weights.first
