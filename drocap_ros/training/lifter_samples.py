"""Unlimited training samples for the lifter: varied MoCap in virtual orbiting cameras with imperfect 2D joints.

Lengths in metres, angles in rad, times in frames of 24 fps.  Arrays are (B, T, ...): B windows of T frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.bones import bone_lengths
from drocap_ros.mocap import load_mocap
from drocap_ros.reconstruction.lifted.lifter_input import LIFTER_FPS, normalise
from drocap_ros.skeleton import BODY_15

_J = {name: i for i, name in enumerate(BODY_15.joints)}
_UPPER = np.array([_J[j] for j in ("rknee", "lknee", "lelbow", "relbow")])
_LOWER = np.array([_J[j] for j in ("rankle", "lankle", "lwrist", "rwrist")])
_LEGS = np.array([_J[j] for j in ("rknee", "lknee", "rankle", "lankle")])
_ABOVE_PELVIS = np.arange(_J["neck"], len(BODY_15))
_SIDES = ((_J["rhip"], _J["lhip"]), (_J["rknee"], _J["lknee"]), (_J["rankle"], _J["lankle"]),
          (_J["lshoulder"], _J["rshoulder"]), (_J["lelbow"], _J["relbow"]), (_J["lwrist"], _J["rwrist"]))  # fmt: skip


@dataclass(frozen=True)
class MocapBank:
    """Concatenated sequences: joints (N, 15, 3) float32 m, z up; first frame, length and rate of each."""

    joints: np.ndarray
    start: np.ndarray
    length: np.ndarray
    fps: np.ndarray


def load_bank(paths: list[Path]) -> MocapBank:
    """Read MoCap ``.npz`` files (X in mm, joints, fps).

    Raises
    ------
    InputError
        When a file cannot be used or there is none.
    """
    if not paths:
        raise InputError("MoCap: expected at least one .npz file, found none; check the folder and the pattern")
    parts, rates = [], []
    for path in paths:
        x, fps = load_mocap(path)
        if len(x) < 2:
            raise InputError(f"{path}: expected at least 2 frames, got {len(x)}; leave the file out")
        parts.append(x.astype(np.float32) / 1000)
        rates.append(fps)
    length = np.array([len(p) for p in parts])
    return MocapBank(np.concatenate(parts), np.cumsum(length) - length, length, np.array(rates))


@dataclass(frozen=True)
class Batch:
    """features (B, T, 73); target (B, T, 15, 3) in the features' units, x and y in the image."""

    features: np.ndarray
    target: np.ndarray


def sample_batch(bank: MocapBank, rng: np.random.Generator, windows: int, frames: int) -> Batch:
    """Draw ``windows`` training windows of ``frames`` frames."""
    # Two cameras per body halve the cost of the bodies.
    body = _vary_body(_draw_motion(bank, rng, (windows + 1) // 2, frames), rng)
    return _project(np.concatenate([body, body])[:windows], rng)


def _draw_motion(bank: MocapBank, rng: np.random.Generator, windows: int, frames: int) -> np.ndarray:
    weight = bank.length**0.75
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
    flip = rng.random(windows) < 0.5
    mirrored = motion[flip][:, :, BODY_15.mirror]
    mirrored[..., 0] *= -1
    motion[flip] = mirrored
    return motion - motion[:, :, :1]


def _turn(vector: np.ndarray, rotvec: np.ndarray) -> np.ndarray:
    """Rodrigues' rotation of vectors (..., 3) by rotation vectors that broadcast to them."""
    angle = np.sqrt(np.square(rotvec).sum(axis=-1, keepdims=True)) + 1e-9
    axis = rotvec / angle
    cosine, sine = np.cos(angle), np.sin(angle)
    ax, ay, az = axis[..., 0], axis[..., 1], axis[..., 2]
    vx, vy, vz = vector[..., 0], vector[..., 1], vector[..., 2]
    cross = np.stack([ay * vz - az * vy, az * vx - ax * vz, ax * vy - ay * vx], axis=-1)
    along = (axis * vector).sum(axis=-1, keepdims=True)
    return vector * cosine + cross * sine + axis * along * (1 - cosine)


def _slow(rng: np.random.Generator, windows: int, frames: int, shape: tuple[int, ...]) -> np.ndarray:
    """(B, T, *shape) float32 of about unit variance: a constant plus a slow oscillation of random period."""
    tail = (1,) * len(shape)
    period = rng.uniform(24, 240, (windows, 1, *shape))
    phase = rng.uniform(0, 2 * np.pi, (windows, 1, *shape))
    time = np.arange(frames).reshape(1, frames, *tail)
    wave = np.sin(2 * np.pi * time / period + phase)
    constant = rng.standard_normal((windows, 1, *shape))
    return (0.8 * constant + 0.8 * wave).astype(np.float32)


def _vary_body(motion: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Other bones, slightly other poses, other attitudes; root-relative (B, T, 15, 3) in and out."""
    windows, frames, joints, _ = motion.shape
    bone = motion - motion[:, :, np.maximum(BODY_15.parents, 0)]

    # Poses: every limb is turned a little (the lower limb with the upper one), the trunk as a whole; postures
    # bend trunk, hips and knees about the axis of the hips.
    strength = np.where(rng.random(windows) < 0.5, rng.uniform(0, 0.22, windows), 0).astype(np.float32)
    turn = _slow(rng, windows, frames, (9, 3)) * strength[:, None, None, None]
    posture = _posture(rng, windows, frames)
    pitch = bone[:, :, _J["rhip"]] - bone[:, :, _J["lhip"]]
    pitch = (pitch / (np.linalg.norm(pitch, axis=-1, keepdims=True) + 1e-6))[:, :, None]
    hips = posture[:, :, (2, 3), None] * pitch
    knees = -posture[:, :, (4, 5), None] * pitch
    trunk = -posture[:, :, 1, None, None] * pitch
    bone[:, :, _ABOVE_PELVIS] = _turn(bone[:, :, _ABOVE_PELVIS], 0.6 * turn[:, :, 8:9] + trunk)
    bone[:, :, _LEGS] = _turn(bone[:, :, _LEGS], np.concatenate([hips, hips], axis=2))
    bone[:, :, _LEGS[2:]] = _turn(bone[:, :, _LEGS[2:]], knees)
    both = np.concatenate([_UPPER, _LOWER])
    bone[:, :, both] = _turn(bone[:, :, both], np.concatenate([turn[:, :, :4], turn[:, :, :4]], axis=2))
    bone[:, :, _LOWER] = _turn(bone[:, :, _LOWER], turn[:, :, 4:8])

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

    body = np.empty_like(bone)
    body[:, :, 0] = 0
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            body[:, :, joint] = body[:, :, parent] + bone[:, :, joint]

    # Attitude: mostly as recorded, sometimes leaning, and with a posture up to lying on the back or the belly.
    lean = np.where(rng.random(windows) < 0.2, 0.25 * rng.standard_normal(windows), 0.0)
    heading = rng.uniform(0, 2 * np.pi, windows)
    level = np.stack([np.cos(heading), np.sin(heading), np.zeros(windows)], axis=-1)
    body = _turn(body, (lean[:, None] * level).astype(np.float32)[:, None, None])
    pitch = body[:, :, _J["rhip"]] - body[:, :, _J["lhip"]]
    pitch = pitch.mean(axis=1, keepdims=True) + 1e-6
    pitch /= np.linalg.norm(pitch, axis=-1, keepdims=True)
    # Some lie on a side: the axis of the tilt is not that of the hips.
    aside = np.where(rng.random(windows) < 0.4, rng.uniform(-np.pi, np.pi, windows), 0.2 * rng.standard_normal(windows))
    pitch = _turn(pitch, (aside[:, None] * np.array([0.0, 0.0, 1.0])).astype(np.float32)[:, None])
    return _turn(body, (posture[:, :, 0, None] * pitch)[:, :, None])


def _posture(rng: np.random.Generator, windows: int, frames: int) -> np.ndarray:
    """(B, T, 6) float32 rad: pitch of the body (back > 0), flexion of trunk, right and left hip and knees.

    Zero in most windows; in the others the body sits, crouches, kneels, bends or lies down, and may get up again:
    postures that everyday MoCap lacks.
    """
    kind = rng.random(windows)
    low = np.array([-0.4, -0.4, -0.2, -0.2, 0.0, 0.0])
    high = np.array([0.4, 1.3, 1.9, 1.9, 2.0, 2.0])
    angle = rng.uniform(low, high, (windows, 6))
    lying = kind < 0.2
    flat = rng.choice([-1, 1], windows) * rng.normal(1.55, 0.15, windows)
    angle[lying, 0] = np.where(rng.random(windows) < 0.7, flat, rng.uniform(-1.5, 1.5, windows))[lying]
    angle[lying & (rng.random(windows) < 0.4), 1:] *= 0.2
    angle[kind > 0.36] = 0.0
    together = rng.random(windows) < 0.6
    for right, left in ((2, 3), (4, 5)):
        angle[together, left] = angle[together, right] * (1 + 0.2 * rng.standard_normal(together.sum()))
    time = np.arange(frames)[None, :, None]
    begin = rng.uniform(-1.2 * frames, 0.8 * frames, (windows, 1, 1)) + rng.uniform(-10, 10, (windows, 1, 6))
    rise = np.clip((time - begin) / rng.uniform(15, 60, (windows, 1, 6)), 0, 1)
    end = begin + rng.uniform(40, 300, (windows, 1, 1)) + rng.uniform(-10, 10, (windows, 1, 6))
    fall = np.clip((time - end) / rng.uniform(15, 60, (windows, 1, 6)), 0, 1)
    curve = rise * (1 - fall)
    return (angle[:, None] * curve**2 * (3 - 2 * curve)).astype(np.float32)


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
    speed = np.where(kind < 0.1, 0, np.where(kind < 0.3, rng.uniform(0, 12, windows), rng.uniform(8, 60, windows)))
    speed = np.radians(speed) / LIFTER_FPS * rng.choice([-1, 1], windows)
    wobble = _slow(rng, windows, frames, (3,)) * (rng.random((windows, 1, 1)) < 0.7)
    time = np.arange(frames)
    azimuth = rng.uniform(0, 2 * np.pi, (windows, 1)) + speed[:, None] * time + 0.03 * wobble[..., 0]
    level = np.where(rng.random(windows) < 0.75, rng.normal(0.33, 0.15, windows), rng.uniform(-0.2, 1.05, windows))
    elevation = np.clip(level, -0.25, 1.1)[:, None] + 0.03 * wobble[..., 1]
    return camera_rotation(azimuth, elevation, 0.04 * wobble[..., 2]).astype(np.float32)


def _project(body: np.ndarray, rng: np.random.Generator) -> Batch:
    windows, frames = body.shape[:2]
    seen = np.einsum("btij,btpj->btpi", _orbit(rng, windows, frames), body, optimize=True)

    # Half of the cameras are orthographic; the others are 3-15 m away, and the distance drifts.
    away = np.exp(rng.uniform(np.log(3), np.log(15), (windows, 1))) * (1 + 0.05 * _slow(rng, windows, frames, ()))
    inverse = np.where(rng.random((windows, 1)) < 0.6, 0, 1 / away).astype(np.float32)
    zoom = np.where(inverse > 0, inverse / np.maximum(inverse.mean(axis=1, keepdims=True), 1e-6), 1).astype(np.float32)
    exact = seen[..., :2] / (1 + inverse[..., None, None] * seen[..., 2:]) * zoom[..., None, None]
    truth = np.concatenate([exact, seen[..., 2:] * zoom[..., None, None]], axis=-1)

    keypoints, confidence = _detect(exact, rng)
    features, centre, scale = normalise(keypoints, confidence, _estimated_lengths(truth, rng))
    truth[..., :2] -= centre[:, :, None]
    truth /= scale[:, None, None, None]
    return Batch(features, truth.astype(np.float32))


def _estimated_lengths(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(B, 14) bone lengths with the errors of an estimate; unknown (NaN) in two windows of five."""
    length = np.median(bone_lengths(truth), axis=1)
    error = np.abs(0.025 * rng.standard_normal((len(length), 1))) * rng.standard_normal(length.shape)
    return np.where(rng.random((len(length), 1)) < 0.4, np.nan, length * np.exp(error))


def _runs(rng: np.random.Generator, shape: tuple[int, ...], frames: int, share: np.ndarray, longest: int) -> np.ndarray:
    """(B, T, *rest) bool: for a ``share`` of (B, *rest), one run of up to ``longest`` frames is True."""
    tail = (1,) * (len(shape) - 1)
    chosen = (rng.random(shape) < share.reshape(-1, *tail))[:, None]
    begin = rng.integers(0, max(frames, 1), shape)[:, None]
    length = rng.integers(1, longest + 1, shape)[:, None]
    time = np.arange(frames).reshape(1, frames, *tail)
    return chosen & (time >= begin) & (time < begin + length)


def _detect(exact: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A detector's output for exact 2D joints (B, T, 15, 2) m: keypoints with NaN, and confidences."""
    windows, frames, joints, _ = exact.shape

    def share(probability: float, most: float) -> np.ndarray:
        return np.where(rng.random(windows) < probability, rng.uniform(0, most, windows), 0)

    noise = rng.standard_normal(exact.shape, dtype=np.float32)
    keypoints = exact + noise * share(0.7, 0.02).astype(np.float32)[:, None, None, None]
    drift = _slow(rng, windows, frames, (joints, 2))
    keypoints += drift * share(0.3, 0.015).astype(np.float32)[:, None, None, None]

    swapped = _runs(rng, (windows, 2), frames, share(0.15, 0.6), 12)
    arms, legs = np.arange(_J["lshoulder"], joints), np.arange(_J["rhip"], _J["neck"])
    for group, swap in ((arms, swapped[..., 0]), (legs, swapped[..., 1])):
        both = keypoints[:, :, group]
        keypoints[:, :, group] = np.where(swap[..., None, None], keypoints[:, :, BODY_15.mirror[group]], both)

    gross = rng.random((windows, frames, joints)) < share(0.6, 0.09)[:, None, None]
    gross |= _runs(rng, (windows, joints), frames, share(0.15, 0.2), 10)
    where = np.nonzero(gross)
    keypoints[where] = exact[where] + rng.uniform(-0.3, 0.3, (len(where[0]), 2))

    missing = rng.random((windows, frames, joints)) < share(0.3, 0.2)[:, None, None]
    missing |= _runs(rng, (windows, joints), frames, share(0.3, 0.5), 48)
    missing |= _runs(rng, (windows, 1), frames, share(0.2, 0.7), 16)
    keypoints[missing] = np.nan

    # Confidences are informative in a third of the windows; otherwise every seen joint has the same.
    error = np.sqrt(np.square(keypoints - exact).sum(axis=-1))
    informative = np.exp(-error / 0.1) * rng.uniform(0.6, 1, error.shape)
    confidence = np.where(rng.random((windows, 1, 1)) < 0.33, informative, 1.0)
    return keypoints, confidence.astype(np.float32)
