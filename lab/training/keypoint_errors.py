"""What real 2D networks do to the joints of the training's windows: other places, errors that last, exchanges, gaps.

Lengths in metres at the person's distance, times in frames.  Arrays are (B, T, ...): B windows of T frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from drocap_ros.skeleton import BODY_17
from lab.training.slow_curves import runs, slow

_J = {name: i for i, name in enumerate(BODY_17.joints)}


def _places(*names: str) -> np.ndarray:
    return np.array([_J[name] for name in names])


_ARMS = np.arange(_J["lshoulder"], _J["rwrist"] + 1)
_LEGS = _places("rhip", "rknee", "rankle", "lhip", "lknee", "lankle", "rtoe", "ltoe")
_TOES = _places("rtoe", "ltoe")
#: Parts of the body that hide together.
_PARTS = (
    _places("relbow", "rwrist"),
    _places("lelbow", "lwrist"),
    _places("rknee", "rankle", "rtoe"),
    _places("lknee", "lankle", "ltoe"),
    _places("rknee", "rankle", "rtoe", "lknee", "lankle", "ltoe"),
    np.array([j for j in range(len(BODY_17)) if j not in set(_places("neck", "head", "lshoulder", "rshoulder"))]),
)
_BELOW_HIPS = _PARTS[4]
#: Longest time that a part is hidden.
_HIDDEN_FRAMES = 48


@dataclass(frozen=True)
class Detection:
    """keypoints (B, T, 17, 2), NaN = not seen; confidence (B, T, 17); covariance (B, T, 17, 3), NaN = not given."""

    keypoints: np.ndarray
    confidence: np.ndarray
    covariance: np.ndarray


def as_drawn(body: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bodies (B, T, 17, 3) with the joints where a 2D network draws them.

    Networks draw the hips at mid-shorts, knees and ankles by the clothes, and not alike from the front and from the
    side; neck and head are extrapolated from shoulders and ears, so that they swing with the head.
    """
    windows, frames = body.shape[:2]
    drawn = body.copy()
    biased = (rng.random((windows, 1, 1)) < 0.5).astype(np.float32)
    low = rng.uniform(0.0, 0.28, (windows, 1, 1)) + 0.05 * slow(rng, windows, frames, (1,))
    for side in "rl":
        hip, knee, ankle = (body[:, :, _J[side + part]] for part in ("hip", "knee", "ankle"))
        lower = np.clip(low + 0.04 * _normal(rng, windows), -0.05, 0.35).astype(np.float32) * biased
        drawn[:, :, _J[side + "hip"]] += lower * (knee - hip)
        # Networks draw a bent knee on the kneecap, up the shank: on three people with optical MoCap by 30 to 52 mm of a
        # right angle on each of six legs.
        thigh, shank = knee - hip, ankle - knee
        cosine = (thigh * shank).sum(-1) / np.maximum(
            np.linalg.norm(thigh, axis=-1) * np.linalg.norm(shank, axis=-1), 1e-6
        )
        bent = np.sqrt(np.clip(1.0 - cosine, 0.0, 2.0))[..., None].astype(np.float32)
        drawn[:, :, _J[side + "knee"]] -= (
            rng.uniform(0.0, 0.14, (windows, 1, 1)).astype(np.float32) * bent * biased * shank
        )
        for joint in ("knee", "ankle"):
            along = 0.04 * _normal(rng, windows) + 0.025 * slow(rng, windows, frames, (1,))
            drawn[:, :, _J[side + joint]] += along * biased * (ankle - knee)
    middle = 0.5 * (drawn[:, :, _J["rhip"]] + drawn[:, :, _J["lhip"]])
    drawn[:, :, _J["pelvis"]] = np.where(biased > 0, middle, drawn[:, :, _J["pelvis"]])
    head = (rng.random((windows, 1, 1, 1)) < 0.4) * slow(rng, windows, frames, (1, 3))
    drawn[:, :, _places("neck", "head")] += np.array([[0.02], [0.03]], np.float32) * head
    trunk = body[:, :, _J["neck"]] - body[:, :, _J["pelvis"]]
    drawn[:, :, _places("lshoulder", "rshoulder")] += (0.04 * _normal(rng, windows) * biased * trunk)[:, :, None]
    # Shoulders are drawn inside their centres; the map that widens them leaves an error of either sign.
    for pair, wider, spread in (("shoulder", 0.0, 0.1), ("hip", 0.1, 0.15)):
        line = 0.5 * (body[:, :, _J["r" + pair]] - body[:, :, _J["l" + pair]])
        outwards = (wider + spread * _normal(rng, windows)) * biased * line
        drawn[:, :, _J["r" + pair]] += outwards
        drawn[:, :, _J["l" + pair]] -= outwards
    return drawn


def _normal(rng: np.random.Generator, windows: int) -> np.ndarray:
    return rng.standard_normal((windows, 1, 1), dtype=np.float32)


def detect(exact: np.ndarray, rng: np.random.Generator) -> Detection:
    """A detector's output for exact 2D joints (B, T, 17, 2)."""
    windows, frames, joints, _ = exact.shape

    def share(probability: float, most: float) -> np.ndarray:
        drawn: np.ndarray = np.where(rng.random(windows) < probability, rng.uniform(0, most, windows), 0)
        return drawn

    hidden = _hidden(rng, windows, frames, joints)
    guessed = hidden & (rng.random((windows, 1, 1)) < 0.5)
    error, covariance = _errors(rng, guessed, share(0.7, 0.02), share(0.5, 0.022))
    keypoints = exact + error
    keypoints += slow(rng, windows, frames, (joints, 2)) * share(0.5, 0.02).astype(np.float32)[:, None, None, None]

    swapped = runs(rng, (windows, 2), frames, share(0.15, 0.6), 12)
    for group, swap in ((_ARMS, swapped[..., 0]), (_LEGS, swapped[..., 1])):
        both = keypoints[:, :, group]
        keypoints[:, :, group] = np.where(swap[..., None, None], keypoints[:, :, BODY_17.mirror[group]], both)

    gross = rng.random((windows, frames, joints)) < share(0.6, 0.09)[:, None, None]
    gross |= runs(rng, (windows, joints), frames, share(0.15, 0.2), 10)
    where = np.nonzero(gross)
    keypoints[where] = exact[where] + rng.uniform(-0.3, 0.3, (len(where[0]), 2))

    missing = rng.random((windows, frames, joints)) < share(0.3, 0.2)[:, None, None]
    missing |= runs(rng, (windows, joints), frames, share(0.3, 0.5), 48)
    missing |= runs(rng, (windows, 1), frames, share(0.2, 0.7), 16)
    missing |= hidden & ~guessed
    missing |= _never_seen(rng, windows, frames, joints)
    missing |= _low_rate(rng, windows, frames)
    keypoints[missing] = np.nan

    # Confidences are informative in a third of the windows; otherwise every seen joint has the same.
    distance = np.sqrt(np.square(keypoints - exact).sum(axis=-1))
    informative = np.exp(-distance / 0.1) * rng.uniform(0.6, 1, distance.shape)
    confidence = np.where(rng.random((windows, 1, 1)) < 0.33, informative, 1.0)
    covariance *= np.exp(0.4 * rng.standard_normal((windows, 1, 1, 1)))
    covariance[rng.random(windows) < 0.55] = np.nan
    return Detection(keypoints, confidence.astype(np.float32), covariance)


def _errors(
    rng: np.random.Generator, guessed: np.ndarray, white: np.ndarray, lasting: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (B, T, 17, 2), fresh in every frame and lasting for some, and their covariance (B, T, 17, 3).

    guessed : (B, T, 17) hidden joints, whose errors are several times as large
    white, lasting : (B,) standard deviations
    """
    windows, frames, joints = guessed.shape
    fresh = rng.standard_normal((windows, frames, joints, 2), dtype=np.float32)
    memory = np.exp(-1.0 / rng.uniform(1.0, 8.0, windows))
    start = rng.standard_normal((windows, 1, joints, 2))
    walk = np.stack(
        [
            lfilter([np.sqrt(1 - a * a)], [1.0, -a], noise, axis=0, zi=a * first)[0]
            for a, noise, first in zip(memory, rng.standard_normal((windows, frames, joints, 2)), start, strict=True)
        ]
    )
    # Lasting errors are larger along one direction: an ellipse per joint and window.
    angle = rng.uniform(0, np.pi, (windows, 1, joints))
    ratio = np.exp(0.5 * np.abs(rng.standard_normal((windows, 1, joints))))
    size = lasting[:, None, None] * np.exp(0.4 * rng.standard_normal((windows, 1, joints)))
    cos, sin, wide, narrow = np.cos(angle), np.sin(angle), size * np.sqrt(ratio), size / np.sqrt(ratio)
    factor = np.where(guessed, rng.uniform(3.0, 8.0, (windows, 1, 1)), 1.0)
    floor = np.where(guessed, 0.01, 0.0)
    along, across = walk[..., 0] * np.hypot(wide, floor), walk[..., 1] * np.hypot(narrow, floor)
    lasts = np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)
    error = factor[..., None] * (white[:, None, None, None] * fresh + lasts)
    a, b = np.square(np.hypot(wide, floor)), np.square(np.hypot(narrow, floor))
    shape = np.stack([a * cos**2 + b * sin**2, (a - b) * sin * cos, a * sin**2 + b * cos**2], axis=-1)
    shape[..., [0, 2]] += np.square(white)[:, None, None, None]
    return error.astype(np.float32), np.square(factor)[..., None] * shape + np.array([1e-6, 0, 1e-6])


def _hidden(rng: np.random.Generator, windows: int, frames: int, joints: int) -> np.ndarray:
    """(B, T, 17) bool: parts of the body hide for up to two seconds, once or again and again."""
    hidden = np.zeros((windows, frames, joints), bool)
    time = np.arange(frames)
    for part in _PARTS:
        chosen = rng.random(windows) < 0.08
        length = rng.integers(6, _HIDDEN_FRAMES + 1, (windows, 1))
        period = np.where(rng.random((windows, 1)) < 0.5, length + rng.integers(24, 96, (windows, 1)), 10**6)
        begin = rng.integers(0, max(frames, 1), (windows, 1))
        away = chosen[:, None] & ((time - begin) % period < length) & ((time >= begin) | (period < 10**6))
        hidden[:, :, part] |= away[..., None]
    return hidden


def _never_seen(rng: np.random.Generator, windows: int, frames: int, joints: int) -> np.ndarray:
    """(B, T, 17) bool: toes that the network does not know; legs below the border of the image."""
    never = np.zeros((windows, frames, joints), bool)
    never[:, :, _TOES] |= (rng.random(windows) < 0.45)[:, None, None]
    since = np.where(rng.random((windows, 1)) < 0.05, rng.integers(-frames, max(frames, 1), (windows, 1)), frames)
    never[:, :, _BELOW_HIPS] |= (np.arange(frames) >= since)[..., None]
    return never


def _low_rate(rng: np.random.Generator, windows: int, frames: int) -> np.ndarray:
    """(B, T, 1) bool: frames between those of a slower camera."""
    every = np.where(rng.random((windows, 1)) < 0.14, rng.integers(2, 7, (windows, 1)), 1)
    between: np.ndarray = (np.arange(frames) + rng.integers(0, 7, (windows, 1))) % every != 0
    return between[..., None]
