"""Adjustment of body and camera together in the world, by Gauss-Newton with a search along each step.

Every step has three parts: the probability that a foot is in contact at the present point, the normal equations, and
their solution with the frames eliminated; a step that raises the cost is shortened.  After the last step, feet in
contact are locked in their places while the unknowns of the whole recording stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.contacts import ANKLE_M, ANKLES, FEET, HEIGHT_STD_M, MOVING, MOVING_LOCKED, RestingFeet, step_height
from drocap_ros.reconstruction.common.engine import Covariances, Equations, descend
from drocap_ros.reconstruction.common.poses import CONVERGED, ITERATIONS, NO_DESCENT
from drocap_ros.reconstruction.world.world_model import (
    CALIBRATED,
    FLOOR,
    GLOBALS,
    JOINTS,
    LENGTHS,
    MISALIGNMENT,
    SCALE,
    Findings,
    WorldConfig,
    WorldInput,
    WorldState,
    joint_columns,
)
from drocap_ros.reconstruction.world.world_residuals import Contacts, WorldResiduals, weights_of


def posterior(equations: Equations, state: WorldState) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Covariances at a unit variance of every residual, from the equations at the solution; None = not definite.

    That is of the mean place of all joints of all frames in the world, (3, 3) m^2, of the joints about it,
    (F, 17, 3, 3) m^2, and of the shared unknowns.
    """
    found = Covariances.of(equations)
    if found is None:
        return None
    frames, scale, size = len(state.joints), float(state.globals[SCALE]), len(found.shared)
    cameras = state.camera.shape[1]
    lever = found.lever.reshape(frames, -1, size)[:, cameras:].reshape(frames, JOINTS, 3, -1) / scale
    lever[..., SCALE] += state.joints / scale**2
    joints = np.empty((frames, JOINTS, 3, 3))
    blocks, _ = found.blocks(cameras + 3 * JOINTS, np.float32)
    for joint in range(JOINTS):
        at = slice(cameras + 3 * joint, cameras + 3 * joint + 3)
        joints[:, joint] = blocks[:, at, at] / scale**2
    weighted = (lever.reshape(-1, size) @ found.shared).reshape(lever.shape)
    joints += weighted @ np.swapaxes(lever, -1, -2)
    # Of the joints with their mean place.
    mean = np.zeros((frames, cameras + 3 * JOINTS, 3))
    mean[:, cameras:] = np.tile(np.eye(3), (JOINTS, 1)) / (frames * JOINTS * scale)
    own = found.of_frames(mean.reshape(-1, 3)).reshape(mean.shape)[:, cameras:] / scale
    with_place = own.reshape(frames, JOINTS, 3, 3) + lever @ (found.shared @ lever.mean(axis=(0, 1)).T)
    place = with_place.mean(axis=(0, 1))
    return place, joints - with_place - np.swapaxes(with_place, -1, -2) + place, found.shared


#: Standard deviation (m/s) of the speed of feet in contact, step by step: at first the body slides; the last one stays.
_CONTACT_SPEEDS_M_S = (0.6, 0.4, 0.3, 0.2, 0.15)
#: Errors of the shared unknowns over their formal standard deviations, from the scale errors of 36 runs: contacts are
#: chosen by the same data.
_STD_FACTOR = 1.25


@dataclass(frozen=True)
class WorldSolution:
    """Result of the adjustment.

    joints : (F, 17, 3) m in the world
    state : of all views; std : of the first one's
    contact : (F - 1, 4) of ``FEET``, right and left ankle, right and left toe
    std : (GLOBALS,) posterior standard deviations of the shared unknowns, NaN = unknown
    turned, turned_std : (3,) rad about the gimbal's axes: pitch, yaw, roll
    place : (3, 3) m^2 of the mean place of all joints, NaN = unknown
    covariance : (F, 17, 3, 3) m^2 of the joints about it
    ground_spread : m, of the heights of resting feet; NaN = no foot rests
    findings : of this adjustment's measurements, without those known before
    """

    joints: np.ndarray
    state: WorldState
    contact: np.ndarray
    std: np.ndarray
    turned: np.ndarray
    turned_std: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    ground_spread: float
    findings: Findings
    cost_terms: dict[str, float]
    iterations: int
    stop_reason: str


def initial_state(data: WorldInput, start: WorldState) -> WorldState:
    """The point to start from, with the lifter's lengths and a floor under the feet."""
    shared = start.globals.copy()
    shared[LENGTHS] = data.lengths
    ankles = start.joints[:, ANKLES, 2]
    shared[FLOOR] = ANKLE_M if data.config.ground_m else np.percentile(ankles, 10)
    return WorldState(start.joints, start.camera, shared).with_views(len(data.further))


class _Stage(NamedTuple):
    """One step of the adjustment.

    locking : feet in contact are locked, the shared unknowns stay
    speed_std_m_s : of feet in contact
    moving : likelihood of a foot that moves
    weight : of feet in contact
    finds_floor : the body does not slide any more: feet in contact tell how level the ground is
    """

    locking: bool
    speed_std_m_s: float
    moving: float
    weight: float
    finds_floor: bool


def _stages(config: WorldConfig, held: int) -> Iterator[_Stage]:
    """The steps in order; a window that continues another one does not slide, and its scale and camera are known."""
    last = len(_CONTACT_SPEEDS_M_S) - 1
    for number in range(config.iterations + config.locking_iterations):
        locking = number >= config.iterations
        stage = number + (last if held else 0)
        yield _Stage(
            locking=locking,
            speed_std_m_s=_CONTACT_SPEEDS_M_S[min(stage, last)],
            moving=MOVING_LOCKED if locking or held else MOVING,
            weight=config.locked_weight if locking else config.contact_weight,
            finds_floor=stage == last,
        )


def adjust_in_world(data: WorldInput, start: WorldState, held: int = 0) -> WorldSolution:
    """Adjust from a point.

    start : its lengths and floor do not matter
    held : so many frames at the begin keep their joints and their camera's errors
    """
    config, weights = data.config, weights_of(data)
    state = initial_state(data, start)
    stop, done, ground, floor_std = ITERATIONS, 0, float("nan"), HEIGHT_STD_M
    contact: np.ndarray = np.zeros((len(start.joints) - 1, len(FEET)))
    outlier = WorldResiduals(data, weights, state, Contacts(contact, 0.0)).usual_outlier()
    seen = np.any([view.weight > 0 if view.seen is None else view.seen for view in data.views], axis=0)
    feet = RestingFeet(seen, data.fps, _still(data), start.joints)
    for stage in _stages(config, held):
        done += 1
        if config.feet:
            contact = feet.probability(state.joints, float(state.globals[FLOOR]), stage.speed_std_m_s, stage.moving)
        if stage.finds_floor:
            ground = _ground_spread(state, contact)
            floor_std = _floor_std(ground)
        near = _near_ground(state, config.ground_m)
        here = WorldResiduals(data, weights, state, Contacts(contact, stage.weight, near, outlier, floor_std))
        there = _improved(here, held, stage.locking)
        if there is None:
            stop = NO_DESCENT
            break
        state, outlier = there.state, there.usual_outlier()
        # Relative decrease of the cost below which the adjustment has converged.
        if stage.locking and here.cost - there.cost <= 1e-4 * here.cost:
            stop = CONVERGED
            break
    final = WorldResiduals(data, weights, state, Contacts(contact, config.contact_weight, near, floor_std=floor_std))
    return _solution(final, ground, done, stop)


def _still(data: WorldInput) -> np.ndarray | None:
    """(F, 2) probability that a foot rests, the mean of the views'."""
    known = [view.still for view in data.views if view.still is not None]
    return np.mean(known, axis=0) if known else None


def _improved(here: WorldResiduals, held: int, locking: bool) -> WorldResiduals | None:
    """The point after one step of Gauss-Newton, shortened until the cost falls; None = there is none."""
    equations = here.equations()
    # Weight of a held unknown, per m^2 or rad^2: a hundred thousand times that of a clear keypoint.
    equations.band[: held * joint_columns(len(here.views)).stop, 0] += 1e10

    def moved(frames: np.ndarray, shared: np.ndarray) -> WorldResiduals | None:
        there = here.moved(frames, shared)
        # Scale below which a step of the adjustment goes astray: no person measures five times the assumed stature.
        return there if there.state.globals[SCALE] > 0.2 else None

    return descend(here, equations, moved, locking)


def _solution(final: WorldResiduals, ground: float, iterations: int, stop_reason: str) -> WorldSolution:
    """The solution with its errors, by the posterior covariance where the normal equations have one."""
    data, state = final.data, final.state
    prior, expected = final.weights.shared[:GLOBALS, :GLOBALS], final.weights.expected[:GLOBALS]
    fact = data.config.frames_per_fact
    known = _with_terms_that_last(final) if data.config.corrected and not data.further else final
    found = posterior(known.equations(), state)
    axes = data.telemetry.gimbal_axes()
    std, turned_std = np.full(GLOBALS, np.nan), np.full(3, np.nan)
    place: np.ndarray = np.full((3, 3), np.nan)
    covariance = np.full((*state.joints.shape, 3), np.nan)
    findings = Findings.unknown()
    if found is not None:
        widest = np.sqrt(fact * np.diag(np.linalg.inv(prior)))
        place, covariance = fact * found[0], fact * found[1]
        shared = found[2][:GLOBALS, :GLOBALS]
        std = np.minimum(_STD_FACTOR * np.sqrt(fact * np.diag(shared)), widest)
        turns = _STD_FACTOR**2 * fact * axes @ shared[MISALIGNMENT, MISALIGNMENT] @ axes.T
        least = fact * axes @ np.linalg.inv(prior[MISALIGNMENT, MISALIGNMENT]) @ axes.T
        turned_std = np.sqrt(np.minimum(np.diag(turns), np.diag(least)))
        findings = _findings(fact * shared, prior / fact, expected, state.globals[:GLOBALS])
    return WorldSolution(
        joints=state.joints / state.globals[SCALE],
        state=state,
        contact=final.contacts.probability,
        std=std,
        turned=axes @ state.globals[MISALIGNMENT],
        turned_std=turned_std,
        place=place,
        covariance=covariance,
        ground_spread=ground,
        findings=findings,
        cost_terms=final.terms,
        iterations=iterations,
        stop_reason=stop_reason,
    )


def _with_terms_that_last(final: WorldResiduals) -> WorldResiduals:
    """Residuals in which only the image's errors and the telemetry's count once in ``frames_per_fact`` frames.

    Weights of contacts and of the lifter's depths contain that they last, and accelerations are what they are.  Without
    points these terms stay wide: a camera that is turned wrongly bends them all in the same way.
    """
    fact, weights = final.data.config.frames_per_fact, final.weights
    views = tuple(v._replace(acceleration=fact * v.acceleration, depth=fact * v.depth) for v in weights.views)
    weights = weights._replace(acceleration=fact * weights.acceleration, views=views)
    contact, weight, near, _, floor_std = final.contacts
    wide = Contacts(contact, fact * weight, fact * near, floor_std=floor_std / float(np.sqrt(fact)))
    return WorldResiduals(final.data, weights, final.state, wide)


def _ground_spread(state: WorldState, contact: np.ndarray) -> float:
    """Standard deviation (m) of the heights of feet in contact (F - 1, 4) above the floor; NaN = no contact."""
    height = step_height(state.joints[:, FEET], float(state.globals[FLOOR]))
    total = float(contact.sum())
    return float(np.sqrt((contact * np.square(height)).sum() / total)) if total > 1.0 else float("nan")


def _near_ground(state: WorldState, ground_m: float) -> np.ndarray:
    """(F - 1, 4) 1/m^2, weights of the lower ankle's height above ground that is seen: one who jumps is above it."""
    height = step_height(state.joints[:, FEET], float(state.globals[FLOOR]))
    near = np.zeros(height.shape)
    if not ground_m:
        return near
    rows, lower = np.arange(len(near)), height[:, : len(ANKLES)].argmin(axis=1)
    # Height (m) at which a foot counts a quarter as one on the ground.
    near[rows, lower] = 1.0 / (ground_m * (1.0 + np.square(height[rows, lower] / 0.3))) ** 2
    return near


def _floor_std(spread: float) -> float:
    """Standard deviation (m) of the floor's term: tight on level ground, loose on steps or a slope."""
    if not np.isfinite(spread):
        return HEIGHT_STD_M
    # The body's errors leave 25 mm on level ground; on steps heights spread by a third of a stair's riser.
    return max(0.025, HEIGHT_STD_M * (spread / 0.06) ** 2)


def _findings(covariance: np.ndarray, prior: np.ndarray, expected: np.ndarray, at: np.ndarray) -> Findings:
    """What the measurements add to the prior, from the posterior covariance and point of the shared unknowns."""
    by_log = np.ones(GLOBALS)
    by_log[SCALE] = at[SCALE]
    point = at.copy()
    point[SCALE] = np.log(at[SCALE])
    after = np.linalg.inv((covariance / by_log / by_log[:, None])[CALIBRATED, CALIBRATED])
    before = prior[CALIBRATED, CALIBRATED]
    return Findings(
        (after - before) / _STD_FACTOR**2,
        (after @ point[CALIBRATED] - before @ expected[CALIBRATED]) / _STD_FACTOR**2,
    )
