"""A recording on an even grid of slots, its parts between pauses, and the windows that are adjusted at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.contacts import ankles_seen
from drocap_ros.geometry.interpolation import MAX_GAP_S
from drocap_ros.geometry.rotations import project_to_so3
from drocap_ros.keypoints import Keypoints2D, difference_noise
from drocap_ros.reconstruction.common.windows import even_slots, fade_weights, windows
from drocap_ros.reconstruction.world.world_model import PlacedPoses

#: Least images of a part of a recording: with fewer no camera's motion shows.
LEAST_FRAMES = 12
#: Frames of one adjustment: 40 s at 24 Hz, which bounds memory;
_WINDOW = 960
#: and those that neighbouring windows share, 2 s.
_OVERLAP = 48
#: Least noise (px) of a keypoint: no network is better.
_LEAST_NOISE_PX = 0.5


class EvenCapture(NamedTuple):
    """A recording of F images on a grid of S slots; values at empty slots are interpolated, with no weight.

    slot : (F,) of each image; fps : slots per second; origin : (3,) m, subtracted from all places
    points : (S, 17, 2) px; weight : (S, 17) 1/px^2; seen : (S, 17) bool, by a network
    body : (S, 17, 3) m of the body; factor : metres of the world per m of the body
    depth, depth_sigma : (S, 17) m of the body
    turn : (S, 3, 3) world -> camera, and path : (S, 3) m, both as reported
    still : (S, 2) the lifter's probability that the right and the left foot rest; None = unknown
    parts : slots of the parts between pauses
    """

    slot: np.ndarray
    fps: float
    origin: np.ndarray
    points: np.ndarray
    weight: np.ndarray
    seen: np.ndarray
    body: np.ndarray
    factor: float
    depth: np.ndarray
    depth_sigma: np.ndarray
    turn: np.ndarray
    path: np.ndarray
    still: np.ndarray | None
    parts: list[slice]


class CaptureWindow(NamedTuple):
    """Slots that are adjusted together.

    fade : weights by which neighbouring windows fade into each other
    begins : it is the first of its part
    ankles_seen : share of the time; tells : its feet can tell wrong telemetry
    """

    rows: slice
    fade: np.ndarray
    begins: bool
    ankles_seen: float
    tells: bool


def even_capture(camera: CameraPath, keypoints: Keypoints2D, poses: PlacedPoses, origin: np.ndarray) -> EvenCapture:
    """The recording about an origin (3,) m, on the even grid."""
    rotation, position = camera.pose
    slot, fps = even_slots(camera.stamp_ns)
    weight = np.zeros((int(slot[-1]) + 1, keypoints.xy.shape[1]))
    points = np.zeros((*weight.shape, 2))
    seen = np.zeros(weight.shape, bool)
    seen[slot] = keypoints.weights > 0
    weight[slot] = keypoint_weights(keypoints, poses.image_sigma)
    # Joints that are not seen, as toes by many networks, stand where the lifter expects them.
    points[slot] = np.where(keypoints.seen[..., None], keypoints.xy, poses.image)
    return EvenCapture(
        slot=slot,
        fps=fps,
        origin=origin,
        points=points,
        weight=weight,
        seen=seen,
        body=at_all_slots((poses.joints - origin) / poses.factor, slot),
        factor=poses.factor,
        depth=at_all_slots(poses.depth, slot),
        depth_sigma=at_all_slots(poses.depth_sigma, slot),
        turn=project_to_so3(at_all_slots(rotation, slot)),
        path=at_all_slots(position - origin, slot),
        still=None if poses.still is None else at_all_slots(poses.still, slot),
        parts=capture_parts(camera.stamp_ns, slot),
    )


def capture_windows(capture: EvenCapture, feet: bool) -> list[CaptureWindow]:
    """Windows of all parts in order; ``feet`` : whether feet in contact keep their place."""
    # A shorter part may hold no step: its feet tell nothing.
    ankles, least = ankles_seen(capture.seen, capture.fps), min(len(capture.seen), 4.0 * capture.fps)
    out = []
    for part in capture.parts:
        frames = part.stop - part.start
        for inside in windows(frames, _WINDOW, _OVERLAP):
            rows = slice(part.start + inside.start, part.start + inside.stop)
            share = float(ankles[rows].mean())
            # An ankle has to be seen for 0.3 of the time for the feet to tell wrong telemetry.
            tells = feet and share > 0.3 and rows.stop - rows.start >= least
            fade = fade_weights(inside, frames, _OVERLAP)
            out.append(CaptureWindow(rows, fade, inside.start == 0, share, tells))
    return out


def at_all_slots(values: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Values (F, ...) at their slots, interpolated at the empty ones."""
    if slot[-1] + 1 == len(slot):
        return values
    flat, at = values.reshape(len(values), -1), np.arange(slot[-1] + 1)
    out = np.stack([np.interp(at, slot, column) for column in flat.T], axis=1)
    return out.reshape(-1, *values.shape[1:])


def capture_parts(stamp_ns: np.ndarray, slot: np.ndarray) -> list[slice]:
    """Slots of the parts of a recording between its pauses, each of ``LEAST_FRAMES`` images at least.

    A pause is a time without images that exceeds the usual one by ``MAX_GAP_S``.  The even grid holds a second of it:
    the camera would fly and turn through that second many times too fast.
    """
    step = np.diff(stamp_ns)
    begins = [0]
    for first in (np.flatnonzero(step > np.median(step) + MAX_GAP_S * 1e9) + 1).tolist():
        if min(first - begins[-1], len(stamp_ns) - first) >= LEAST_FRAMES:
            begins.append(first)
    ends = [*begins[1:], len(stamp_ns)]
    return [slice(int(slot[begin]), int(slot[end - 1]) + 1) for begin, end in zip(begins, ends, strict=True)]


def keypoint_weights(keypoints: Keypoints2D, image_sigma: np.ndarray) -> np.ndarray:
    """(F, 17) 1/px^2; without a covariance the noise comes from the third difference in time.

    Errors of 2D joints last for some frames, which halves their differences.
    """
    xy, variance = keypoints.xy, keypoints.variance
    square = np.full(xy.shape[:2], max(2 * difference_noise(xy), _LEAST_NOISE_PX) ** 2)
    if variance is not None:
        square = np.where(np.isfinite(variance), np.maximum(variance, _LEAST_NOISE_PX**2), square)
    weights = np.clip(keypoints.weights, 0.0, 1.0) / square
    # Weight of the lifter's image position of a joint that is not seen: its errors last for many frames.
    return np.where(keypoints.seen, weights, 0.1 / np.square(np.maximum(image_sigma, _LEAST_NOISE_PX)))
