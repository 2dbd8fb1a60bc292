"""Unlimited training samples for the lifter: varied MoCap in virtual orbiting cameras with imperfect 2D joints.

Lengths in metres, angles in rad, times in frames of 24 fps.  Arrays are (B, T, ...): B windows of T frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.contacts import TRUE_REST_M_S
from drocap_ros.geometry.alignment import pair_lengths
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.common.windows import LIFTER_FPS
from drocap_ros.reconstruction.lifted.lifter_input import BONES, normalise
from drocap_ros.skeleton import BODY_17
from lab.training.keypoint_errors import as_drawn, detect
from lab.training.mocap_bank import MocapBank, straighten_legs
from lab.training.postures import balance, bend, draw_postures, tilt, turn
from lab.training.slow_curves import slow

_J = {name: i for i, name in enumerate(BODY_17.joints)}
_UPPER = np.array([_J[j] for j in ("rknee", "lknee", "lelbow", "relbow")])
_LOWER = np.array([_J[j] for j in ("rankle", "lankle", "lwrist", "rwrist")])
_FEET = np.array([_J[j] for j in ("rtoe", "ltoe")])
_ABOVE_PELVIS = np.arange(_J["neck"], _J["rwrist"] + 1)
_SIDES = ((_J["rhip"], _J["lhip"]), (_J["rknee"], _J["lknee"]), (_J["rankle"], _J["lankle"]),
          (_J["lshoulder"], _J["rshoulder"]), (_J["lelbow"], _J["relbow"]), (_J["lwrist"], _J["rwrist"]),
          (_J["rtoe"], _J["ltoe"]))  # fmt: skip
#: Share of the people who go from posture to posture.
_POSED = 0.45
#: Share of the windows whose shoulders are placed anew, as those of people: a third of the MoCap is on figures whose
#: shoulders are 0.23 m apart.
_SHOULDERED = 0.6
#: Distance of the shoulders over thigh and shank, and its spread: between that of the joints' centres (0.36 m of
#: 0.83 m) and the breadth over both acromia (0.42 m of men, 0.37 m of women: ANSUR II, 2012).
_SHOULDERS, _SHOULDERS_SPREAD = 0.46, 0.05
#: Height of the neck above their middle over the same (0.135 m), and its spread.
_NECK, _NECK_SPREAD = 0.163, 0.03
#: Share of hand-held cameras among those of unknown attitude, and their roll, rad: most below 20 degrees, up to 40.
_HELD, _ROLL, _MOST_ROLL = 0.4, 0.26, 0.7
#: Share of distant cameras; the nearest and farthest of the others, m.
_DISTANT, _NEAREST_M, _FARTHEST_M = 0.4, 2.0, 30.0
#: Least distance of a joint from the camera, share of the pelvis'.
_NEAREST_SHARE = 0.2
#: Spread of an assumed focal length, share of it.
_LENS_SPREAD = 0.12


@dataclass(frozen=True)
class Batch:
    """features (B, T, 143); target (B, T, 17, 3) in the features' units, x and y in the image, NaN = unknown toe.

    still : (B, T, 2) 1 where the right and the left foot of the recorded motion are slower than 0.1 m/s, 0 where not,
        NaN = unknown; the window plays it at 0.7 to 1.4 of its pace
    """

    features: np.ndarray
    target: np.ndarray
    still: np.ndarray


@dataclass(frozen=True)
class Bodies:
    """joints (B, T, 17, 3) about the pelvis, z up; still as of :class:`Batch`."""

    joints: np.ndarray
    still: np.ndarray


def sample_batch(bank: MocapBank, rng: np.random.Generator, windows: int, frames: int) -> Batch:
    """Draw ``windows`` training windows of ``frames`` frames."""
    # Two cameras per body halve the cost of the bodies.
    bodies = _vary_body(_draw_motion(bank, rng, (windows + 1) // 2, frames), rng)
    twice = Bodies(*(np.concatenate([part, part])[:windows] for part in (bodies.joints, bodies.still)))
    return _project(twice, rng)


def _draw_motion(bank: MocapBank, rng: np.random.Generator, windows: int, frames: int) -> Bodies:
    # Few recorded people bend, crouch or lie: their sequences are drawn more often.
    weight = bank.length**0.75 * (1 + 5 * bank.low)
    pick = rng.choice(len(weight), size=windows, p=weight / weight.sum())
    step = bank.fps[pick] / LIFTER_FPS * np.exp(rng.uniform(np.log(0.7), np.log(1.4), windows))
    last = bank.length[pick] - 1.0
    spare = last - step * (frames - 1)
    begin = rng.uniform(0, np.where(spare > 0, spare, last))
    time = begin[:, None] + step[:, None] * np.arange(frames)
    # Short sequences run forth and back; some windows run backwards as a whole.
    time = np.abs((time + last[:, None]) % (2 * last[:, None]) - last[:, None])
    back = rng.random(windows) < 0.2
    time[back] = time[back, ::-1]
    low = np.minimum(np.floor(time), last[:, None] - 1).astype(np.int64)
    part = (time - low).astype(np.float32)[..., None, None]
    at = bank.start[pick][:, None] + low
    motion = bank.joints[at] * (1 - part) + bank.joints[at + 1] * part
    still = (bank.foot_speed[at] < TRUE_REST_M_S).astype(np.float32)
    motion = straighten_legs(motion, bank.reach[pick], rng)
    flip = rng.random(windows) < 0.5
    flipped = motion[flip][:, :, BODY_17.mirror]
    flipped[..., 0] *= -1
    motion[flip] = flipped
    still[flip] = still[flip][..., ::-1]
    return Bodies(motion - motion[:, :, :1], still)


def _vary_body(bodies: Bodies, rng: np.random.Generator) -> Bodies:
    """Other bones, slightly other poses, other attitudes."""
    motion = bodies.joints
    windows, frames, joints, _ = motion.shape
    bone = motion - motion[:, :, np.maximum(BODY_17.parents, 0)]

    # Poses: every limb is turned a little (the lower limb with the upper one), the trunk as a whole.
    strength = np.where(rng.random(windows) < 0.5, rng.uniform(0, 0.22, windows), 0).astype(np.float32)
    little = slow(rng, windows, frames, (11, 3)) * strength[:, None, None, None]
    bone[:, :, _ABOVE_PELVIS] = turn(bone[:, :, _ABOVE_PELVIS], 0.6 * little[:, :, 8:9])
    whole = np.concatenate([_UPPER, _LOWER, _FEET])
    limb = little[:, :, :4]
    bone[:, :, whole] = turn(bone[:, :, whole], np.concatenate([limb, limb, limb[:, :, :2]], axis=2))
    lower = np.concatenate([_LOWER, _FEET])
    bone[:, :, lower] = turn(bone[:, :, lower], np.concatenate([little[:, :, 4:8], little[:, :, 4:6]], axis=2))
    bone[:, :, _FEET] = turn(bone[:, :, _FEET], little[:, :, 9:11])
    # Others go from posture to posture.
    posed = np.nonzero(rng.random(windows) < _POSED)[0]
    angles = draw_postures(rng, len(posed), frames)
    bone[posed] = bend(bone[posed], angles)
    # A foot of a changed pose slides where the recorded one stood.
    changed = strength > 0
    changed[posed] = True
    still = np.where(changed[:, None, None], np.float32(np.nan), bodies.still)

    # Proportions: one size, then each kind of bone, then a trace of asymmetry.
    size = np.exp(0.08 * rng.standard_normal((windows, 1, 1, 1)) + 0.08 * rng.standard_normal((windows, 1, joints, 1)))
    for left, right in _SIDES:
        size[:, :, right] = size[:, :, left] * np.exp(0.01 * rng.standard_normal((windows, 1, 1)))
    bone *= size.astype(np.float32)

    # Marker sets differ in the positions of neck, head, shoulders and hips: shift them in the trunk's frame.
    up = bone[:, :, _J["neck"]]
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    right = bone[:, :, _J["rhip"]] - bone[:, :, _J["lhip"]]
    right = right - (right * up).sum(axis=-1, keepdims=True) * up
    right /= np.linalg.norm(right, axis=-1, keepdims=True) + 1e-6
    front = np.cross(up, right)
    shift = (0.02 * rng.standard_normal((windows, 1, 4, 3, 1))).astype(np.float32)
    places = (("neck", 0), ("head", 0), ("rshoulder", 1), ("lshoulder", -1), ("rhip", 1), ("lhip", -1))
    for (joint_name, side), k in zip(places, (0, 1, 2, 2, 3, 3), strict=True):
        across, along, high = shift[:, :, k, 0], shift[:, :, k, 1], shift[:, :, k, 2]
        bone[:, :, _J[joint_name]] += side * across * right + along * front + high * up
    _place_shoulders(bone, right, up, rng)

    body = np.empty_like(bone)
    body[:, :, 0] = 0
    for joint, parent in enumerate(BODY_17.parents):
        if parent >= 0:
            body[:, :, joint] = body[:, :, parent] + bone[:, :, joint]

    # Attitude: as recorded, sometimes leaning, or that of the posture.
    lean = np.where(rng.random(windows) < 0.2, 0.25 * rng.standard_normal(windows), 0.0)
    heading = rng.uniform(0, 2 * np.pi, windows)
    level = np.stack([np.cos(heading), np.sin(heading), np.zeros(windows)], axis=-1)
    body = turn(body, (lean[:, None] * level).astype(np.float32)[:, None, None])
    body[posed] = balance(tilt(body[posed], angles))
    return Bodies(body, still)


def _place_shoulders(bone: np.ndarray, right: np.ndarray, up: np.ndarray, rng: np.random.Generator) -> None:
    """Move the shoulders of most bones (B, T, 17, 3) to the width and height of people; the arms go along."""
    windows = len(bone)
    leg = np.median(np.linalg.norm(bone[:, :, [_J["rknee"], _J["rankle"]]], axis=-1).sum(axis=-1), axis=1)
    left, other = (bone[:, :, _J[name]] for name in ("lshoulder", "rshoulder"))
    width = np.median(((other - left) * right).sum(axis=-1), axis=1)
    drop = np.median(-(0.5 * (other + left) * up).sum(axis=-1), axis=1)
    chosen = rng.random(windows) < _SHOULDERED
    wider = np.where(chosen, leg * rng.normal(_SHOULDERS, _SHOULDERS_SPREAD, windows) - width, 0.0)
    higher = np.where(chosen, drop - leg * rng.normal(_NECK, _NECK_SPREAD, windows), 0.0)
    for name, side in (("rshoulder", 0.5), ("lshoulder", -0.5)):
        shift = side * wider[:, None, None] * right + higher[:, None, None] * up
        bone[:, :, _J[name]] += shift.astype(np.float32)


def camera_rotation(azimuth: np.ndarray, elevation: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(..., 3, 3) world (z up) -> camera (x right, y down, z forward), towards the origin from a direction, rolled."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    zero = np.zeros_like(ca)
    right = np.stack([-sa, ca, zero], axis=-1)
    forward = np.stack([-ce * ca, -ce * sa, -se], axis=-1)
    down = np.cross(forward, right)
    cr, sr = np.cos(roll)[..., None], np.sin(roll)[..., None]
    return np.stack([cr * right + sr * down, -sr * right + cr * down, forward], axis=-2)


def _orbit(rng: np.random.Generator, windows: int, frames: int) -> np.ndarray:
    """(B, T, 3, 3) rotations of orbiting cameras: still, slow and fast, both ways, of every height."""
    kind = rng.random(windows)
    speed = np.where(kind < 0.25, 0, np.where(kind < 0.4, rng.uniform(0, 12, windows), rng.uniform(8, 60, windows)))
    speed = np.radians(speed) / LIFTER_FPS * rng.choice([-1, 1], windows)
    wobble = slow(rng, windows, frames, (3,)) * (rng.random((windows, 1, 1)) < 0.7)
    time = np.arange(frames)
    azimuth = rng.uniform(0, 2 * np.pi, (windows, 1)) + speed[:, None] * time + 0.03 * wobble[..., 0]
    # Drones, phones at the height of a chest, and all others.
    view = rng.random(windows)
    level = np.where(view < 0.5, rng.normal(0.33, 0.17, windows), rng.normal(0.05, 0.12, windows))
    level = np.where(view < 0.7, level, rng.uniform(-0.3, 1.3, windows))
    elevation = np.clip(level, -0.35, 1.3)[:, None] + 0.03 * wobble[..., 1]
    return camera_rotation(azimuth, elevation, 0.04 * wobble[..., 2]).astype(np.float32)


def _rolled(rotation: np.ndarray, known: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotations (B, T, 3, 3) with the roll of hand-held cameras in some windows; where it is known it is taken away."""
    windows = len(rotation)
    held = ~known & (rng.random(windows) < _HELD)
    roll = np.where(held, np.clip(_ROLL * rng.standard_normal(windows), -_MOST_ROLL, _MOST_ROLL), 0.0)
    about_axis = np.zeros((windows, 1, 3))
    about_axis[..., 2] = roll[:, None]
    rolled: np.ndarray = (exp_so3(about_axis) @ rotation).astype(np.float32)
    return rolled


def _known_rotation(rotation: np.ndarray, known: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a gimbal reports: turned by 1.5 degrees and slowly wandering; NaN where it is not ``known`` (B,)."""
    windows, frames = rotation.shape[:2]
    error = 0.026 * rng.standard_normal((windows, 1, 3)) + 0.006 * slow(rng, windows, frames, (3,))
    reported: np.ndarray = exp_so3(error) @ rotation
    reported[~known] = np.nan
    return reported


def _project(bodies: Bodies, rng: np.random.Generator) -> Batch:
    body = bodies.joints
    windows, frames = body.shape[:2]
    known = rng.random(windows) < 0.5
    rotation = _rolled(_orbit(rng, windows, frames), known, rng)
    seen = np.einsum("btij,btpj->btpi", rotation, body, optimize=True)
    drawn = np.einsum("btij,btpj->btpi", rotation, as_drawn(body, rng), optimize=True)

    # Many cameras are orthographic; the distance of the others drifts.
    away = np.exp(rng.uniform(np.log(_NEAREST_M), np.log(_FARTHEST_M), (windows, 1)))
    away = np.maximum(away * (1 + 0.05 * slow(rng, windows, frames, ())), 0.9 * _NEAREST_M)
    inverse = np.where(rng.random((windows, 1)) < _DISTANT, 0, 1 / away).astype(np.float32)
    zoom = np.where(inverse > 0, inverse / np.maximum(inverse.mean(axis=1, keepdims=True), 1e-6), 1).astype(np.float32)

    def image(points: np.ndarray) -> np.ndarray:
        # Of those who lie, hands may reach the camera.
        distance = np.maximum(1 + inverse[..., None, None] * points[..., 2:], _NEAREST_SHARE)
        flat: np.ndarray = points[..., :2] / distance * zoom[..., None, None]
        return flat

    truth = np.concatenate([image(seen), seen[..., 2:] * zoom[..., None, None]], axis=-1)
    found = detect(image(drawn), rng)
    # At the mean distance a length in metres is a share of the focal length.
    focal = np.where(inverse[:, 0] > 0, 1 / np.maximum(inverse.mean(axis=1), 1e-6), np.inf)
    # Some lenses are assumed by the make of the camera.
    focal *= np.exp(np.where(rng.random(windows) < 0.4, _LENS_SPREAD, 0.0) * rng.standard_normal(windows))
    focal[rng.random(windows) < 0.5] = np.nan
    features, centre, scale = normalise(
        found.keypoints,
        found.confidence,
        _estimated_lengths(truth, rng),
        found.covariance,
        _known_rotation(rotation, known, rng),
        focal,
    )
    truth[..., :2] -= centre[:, :, None]
    truth /= scale[:, None, None, None]
    return Batch(features, truth.astype(np.float32), bodies.still)


def _estimated_lengths(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(B, 16) bone lengths with the errors of an estimate; unknown (NaN) in two windows of five."""
    length = np.median(pair_lengths(truth, BONES), axis=1)
    error = np.abs(0.025 * rng.standard_normal((len(length), 1))) * rng.standard_normal(length.shape)
    return np.where(rng.random((len(length), 1)) < 0.4, np.nan, length * np.exp(error))
