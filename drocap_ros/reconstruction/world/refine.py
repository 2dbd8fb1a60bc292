"""From poses that telemetry has placed in the world to poses that are adjusted together with the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.contacts import ANKLES, ankles_seen
from drocap_ros.geometry.interpolation import MAX_GAP_S
from drocap_ros.geometry.rotations import exp_so3, project_to_so3
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.windows import fade_weights, windows
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.lifted.window_solver import difference_noise
from drocap_ros.reconstruction.world.calibration import MEASURED, Calibration
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.telemetry_checks import (
    frozen,
    jump_m,
    other_time,
    resting_feet_move,
    stops,
    turned_at_once,
)
from drocap_ros.reconstruction.world.world_adjustment import WorldSolution, adjust_in_world
from drocap_ros.reconstruction.world.world_model import (
    ATTITUDE_LATENCY,
    CALIBRATED,
    CAMERA,
    GLOBALS,
    MISALIGNMENT,
    POSITION_LATENCY,
    SCALE,
    WorldConfig,
    WorldInput,
    WorldState,
)
from drocap_ros.reconstruction.world.world_residuals import WANDER_S
from drocap_ros.tracks import Tracks

_LEAST_FRAMES = 12
#: Frames that are adjusted together, and that neighbouring windows of a long recording share.
_WINDOW, _OVERLAP = 960, 48
#: Frames whose solution a live window takes over from the one before: two hold place and speed.
_HELD = 2
_LEAST_NOISE_PX = 0.5
#: Weight of the lifter's image position of a joint that is not seen: its errors last for many frames.
_GUESS_WEIGHT = 0.1
#: Cost of the telemetry per frame that no camera's flight explains, and least share of contacts: jogging has 0.2,
#: a yaw off by 40 degrees less than 0.01.
_LARGEST_COST, _LEAST_CONTACT = 100.0, 0.03
#: Share of the time in which an ankle has to be seen for the feet to tell wrong telemetry.
_SEEN = 0.3
#: A part of a recording that is shorter may hold no step: its feet tell nothing.
_FEET_S = 4.0
#: Frames per second below which a step of a foot ends between two frames: contacts are not seen.
_CONTACTS_FPS = 8.0


@dataclass(frozen=True)
class RefinedWorld:
    """Poses and camera after the adjustment.

    joints : (F, 17, 3) m; rotation : (F, 3, 3) world -> camera; position : (F, 3) m
    metric : whether the scale was measured
    covariance : (F, 17, 6) m^2: xx, xy, xz, yy, yz, zz; NaN = unknown
    calibration : JSON-compatible, of every window: errors of the telemetry and their standard deviations
    found : findings of the last window; before : that window, for the next one
    """

    joints: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    metric: bool
    covariance: np.ndarray
    calibration: list[dict[str, Any]]
    found: Calibration
    before: Before


class Before(NamedTuple):
    """The solution of the window before, of N frames.

    stamp_ns : (N,); joints : (N, 17, 3) m in the world; wander : (N, 6) slow errors of the reported camera
    shared : (GLOBALS,)
    """

    stamp_ns: np.ndarray
    joints: np.ndarray
    wander: np.ndarray
    shared: np.ndarray


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


def refinable(tracks: Tracks) -> bool:
    """Whether there are a camera's finite matrix, rotations and positions, and twelve frames."""
    rotation, position = tracks.camera_rotation, tracks.camera_position
    if rotation is None or position is None or tracks.camera_matrix is None or len(tracks) < _LEAST_FRAMES:
        return False
    return bool(np.isfinite(rotation).all() and np.isfinite(position).all())


def refine_in_world(
    tracks: Tracks,
    keypoints: Keypoints2D,
    poses: PlacedPoses,
    config: WorldConfig | None = None,
    known: Calibration | None = None,
    before: Before | None = None,
) -> RefinedWorld | str | None:
    """Adjust poses and camera; None where the tracks are not :func:`refinable`.

    The answer is a reason, in words, where the telemetry cannot be true.  ``known`` : findings of earlier windows;
    ``before`` : the last of them, which a live window continues.
    """
    config = config or WorldConfig()
    rotation, position, matrix = tracks.camera_rotation, tracks.camera_position, tracks.camera_matrix
    if not refinable(tracks) or not np.isfinite(poses.joints).all():
        return None
    assert rotation is not None
    assert position is not None
    assert matrix is not None
    slot, fps = even_slots(tracks.stamp_ns)
    frames = int(slot[-1]) + 1
    # The scale turns about the origin: near the camera's path, or the held person.
    origin = position.mean(axis=0) if before is None else _held_pelvis(before, int(tracks.stamp_ns[0]))
    weight = np.zeros((frames, keypoints.xy.shape[1]))
    points = np.zeros((*weight.shape, 2))
    seen = np.zeros(weight.shape, bool)
    seen[slot] = keypoints.weights > 0
    weight[slot], points[slot] = _weights(keypoints, poses.image_sigma), _points(keypoints, poses.image)
    body = (poses.joints - origin) / poses.factor
    body, depth, sigma, path = (
        _at_all_slots(values, slot) for values in (body, poses.depth, poses.depth_sigma, position - origin)
    )
    turn = project_to_so3(_at_all_slots(rotation, slot))
    poses_at = body * poses.factor
    parts = _parts(tracks.stamp_ns, slot)
    for part in parts:
        if reason := frozen(turn[part], path[part], fps) or turned_at_once(turn[part], fps):
            return reason
    still = None if poses.still is None else _at_all_slots(poses.still, slot)
    ankles = ankles_seen(seen, fps)
    # Windows whose feet can tell wrong telemetry.
    all_windows = [faded for part in parts for faded in _windows(part)]
    of_feet = [
        rows
        for rows, _ in all_windows
        if config.feet and ankles[rows].mean() > _SEEN and rows.stop - rows.start >= min(frames, _FEET_S * fps)
    ]
    for rows in of_feet:
        if reason := other_time(poses_at[rows], turn[rows], path[rows], fps):
            return reason
        if still is not None and (reason := resting_feet_move(poses_at[rows], still[rows], fps)):
            return reason
    start, held = _start(tracks.stamp_ns, (poses.joints - origin) / poses.factor, origin, 1.0 / poses.factor, before)
    start = start._replace(joints=_at_all_slots(start.joints, slot), wander=_at_all_slots(start.wander, slot))
    joints: np.ndarray = np.zeros(body.shape)
    camera: np.ndarray = np.zeros((frames, CAMERA))
    wander: np.ndarray = np.zeros((frames, CAMERA))
    covariance: np.ndarray = np.zeros((*body.shape, 3))
    total, calibration = np.zeros(frames), []
    measured, cost, contact = True, 0.0, 1.0
    lengths, starts = np.median(span_lengths(body), axis=0), [part.start for part in parts]
    prior = gathered = known  # the findings of one part are known in the next
    for rows, fade in all_windows:
        if rows.start in starts:
            prior = gathered
        telemetry = CameraTelemetry(turn[rows], path[rows], fps)
        data = WorldInput(
            points[rows], weight[rows], depth[rows], sigma[rows], lengths, telemetry, matrix, config, seen[rows], prior,
            None if still is None else still[rows],
        )  # fmt: skip
        state = WorldState(start.joints[rows], start.wander[rows], start.shared)
        found = adjust_in_world(data, state, held if rows.start == 0 else 0)
        gathered = (gathered or Calibration.unknown()).later(found.calibration, 1.0, 0.0)
        joints[rows] += fade[:, None, None] * found.joints
        camera[rows] += fade[:, None] * _correction(found, telemetry)
        wander[rows] += fade[:, None] * found.state.camera
        covariance[rows] += fade[:, None, None, None] * found.covariance
        total[rows] += fade
        calibration.append(_calibration(found, config.stature_std, turn[rows], path[rows], fps))
        cost = max(cost, found.cost_terms["telemetry"] / len(found.joints))
        if rows in of_feet and fps >= _CONTACTS_FPS:
            contact = min(contact, float(found.contact[:, : len(ANKLES)].mean() / ankles[rows].mean()))
        measured &= bool(found.std[SCALE] < MEASURED * found.state.globals[SCALE])
    total[total == 0.0] = 1.0  # no window holds the slots of a pause
    covariance = (covariance / total[:, None, None, None])[slot][..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    joints, camera = joints / total[:, None, None] + origin, camera / total[:, None]
    corrected, moved = exp_so3(camera[slot, 3:]) @ rotation, position + camera[slot, :3]
    if reason := _rejection(cost, contact):
        return reason
    last = Before(tracks.stamp_ns, joints[slot], (wander / total[:, None])[slot], found.state.globals)
    return RefinedWorld(joints[slot], corrected, moved, measured, covariance, calibration, found.calibration, last)


def _parts(stamp_ns: np.ndarray, slot: np.ndarray) -> list[slice]:
    """Slots of the parts of a recording between its pauses, each of ``_LEAST_FRAMES`` images at least.

    A pause is a time without images that exceeds the usual one by ``MAX_GAP_S``.  The even grid holds a second of it:
    the camera would fly and turn through that second many times too fast.
    """
    step = np.diff(stamp_ns)
    begins = [0]
    for first in (np.flatnonzero(step > np.median(step) + MAX_GAP_S * 1e9) + 1).tolist():
        if min(first - begins[-1], len(stamp_ns) - first) >= _LEAST_FRAMES:
            begins.append(first)
    ends = [*begins[1:], len(stamp_ns)]
    return [slice(int(slot[begin]), int(slot[end - 1]) + 1) for begin, end in zip(begins, ends, strict=True)]


def _windows(part: slice) -> list[tuple[slice, np.ndarray]]:
    """Windows of a part, in slots of the recording, and the weights by which they fade into each other."""
    frames = part.stop - part.start
    return [
        (slice(part.start + rows.start, part.start + rows.stop), fade_weights(rows, frames, _OVERLAP))
        for rows in windows(frames, _WINDOW, _OVERLAP)
    ]


def _held_pelvis(before: Before, stamp_ns: int) -> np.ndarray:
    """(3,) m of the first held frame."""
    at = min(int(np.searchsorted(before.stamp_ns, stamp_ns)), len(before.stamp_ns) - 1)
    pelvis: np.ndarray = before.joints[at, 0]
    return pelvis


def _start(
    stamp_ns: np.ndarray, body: np.ndarray, origin: np.ndarray, scale: float, before: Before | None
) -> tuple[Before, int]:
    """The point to start from, joints in m of the body about ``origin``, and the number of held frames.

    Frames of the window before start from its solution, and the first ones keep it: the path goes on without a step.
    """
    wander, shared = np.zeros((len(body), CAMERA)), np.zeros(GLOBALS)
    shared[SCALE] = scale
    common = np.isin(stamp_ns, () if before is None else before.stamp_ns)
    if before is None or not common[:_HELD].all():
        return Before(stamp_ns, body, wander, shared), 0
    theirs = np.searchsorted(before.stamp_ns, stamp_ns[common])
    shared[CALIBRATED] = before.shared[CALIBRATED]
    joints, last = body.copy(), int(np.flatnonzero(common)[-1])
    joints[common] = (before.joints[theirs] - origin) * shared[SCALE]
    joints[last + 1 :] += joints[last, 0] - body[last, 0]
    passed_s = float(stamp_ns[-1] - before.stamp_ns[-1]) * 1e-9
    # The errors' steps from frame to frame have no pull to zero: without this they would drift on an endless stream.
    wander[common] = before.wander[theirs] * np.exp(-passed_s / WANDER_S)
    wander[last + 1 :] = wander[last]
    return Before(stamp_ns, joints, wander, shared), _HELD


def _rejection(cost: float, contact: float) -> str:
    if not cost <= _LARGEST_COST:
        return "the camera's position jumps as no camera flies; check the log's time and its frame"
    if contact < _LEAST_CONTACT:
        return (
            "no foot of the body ever rests on its path in the world; check that the log belongs to the video, its "
            "time offset and the gimbal's yaw (or the person glides)"
        )
    return ""


def _correction(found: WorldSolution, telemetry: CameraTelemetry) -> np.ndarray:
    """(F, 6) corrections of the reported position (m) and rotation (rad, camera axes)."""
    shared, state = found.state.globals, found.state
    path = state.path(telemetry)
    position = path.position - telemetry.position + state.camera[:, :3]
    turned = shared[MISALIGNMENT] + state.camera[:, 3:] + path.turn_rate * shared[ATTITUDE_LATENCY]
    return np.concatenate([position, turned], axis=1)


def _calibration(
    found: WorldSolution, stature_std: float, rotation: np.ndarray, position: np.ndarray, fps: float
) -> dict[str, Any]:
    shared, std = found.state.globals, found.std
    still_s = [(stop.stop - stop.start) / fps for stop in stops(rotation, position, fps)]
    return {
        "scale": 1.0 / float(shared[SCALE]),
        "scale_std": float(std[SCALE] / shared[SCALE]),
        "stature_std": stature_std,
        "misalignment_deg": np.degrees(found.turned).tolist(),
        "misalignment_std_deg": np.degrees(found.turned_std).tolist(),
        "attitude_latency_s": -float(shared[ATTITUDE_LATENCY]),
        "attitude_latency_std_s": float(std[ATTITUDE_LATENCY]),
        "position_latency_s": -float(shared[POSITION_LATENCY]),
        "position_latency_std_s": float(std[POSITION_LATENCY]),
        "ground_spread_m": None if np.isnan(found.ground_spread) else found.ground_spread,
        "contact_share": float(found.contact[:, : len(ANKLES)].mean()),
        "camera_moves": bool(np.ptp(position, axis=0).max() > 0),
        "camera_stops_s": max(still_s, default=0.0),
        "camera_jumps_m": jump_m(position, fps),
        "iterations": found.iterations,
        "stop_reason": found.stop_reason,
    }


def _points(keypoints: Keypoints2D, image: np.ndarray) -> np.ndarray:
    """(F, 17, 2) px; joints that are not seen, as toes by many networks, stand where the lifter expects them."""
    return np.where(keypoints.seen[..., None], keypoints.xy, image)


def _weights(keypoints: Keypoints2D, image_sigma: np.ndarray) -> np.ndarray:
    """(F, 17) 1/px^2; without a covariance the noise comes from the third difference in time.

    Errors of 2D joints last for some frames, which halves their differences.
    """
    xy, variance = keypoints.xy, keypoints.variance
    square = np.full(xy.shape[:2], max(2 * difference_noise(xy), _LEAST_NOISE_PX) ** 2)
    if variance is not None:
        square = np.where(np.isfinite(variance), np.maximum(variance, _LEAST_NOISE_PX**2), square)
    weights = np.clip(keypoints.weights, 0.0, 1.0) / square
    return np.where(keypoints.seen, weights, _GUESS_WEIGHT / np.square(np.maximum(image_sigma, _LEAST_NOISE_PX)))


def _at_all_slots(values: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Values (F, ...) at their slots, interpolated at the empty ones."""
    if slot[-1] + 1 == len(slot):
        return values
    flat, at = values.reshape(len(values), -1), np.arange(slot[-1] + 1)
    out = np.stack([np.interp(at, slot, column) for column in flat.T], axis=1)
    return out.reshape(-1, *values.shape[1:])
