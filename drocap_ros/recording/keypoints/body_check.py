"""Whether 2D keypoints are those of a body: the check of an order that nobody states, and of every motion's keypoints.

The likelihood of a body is that of its bones as vectors in the image, in the unit that suits the whole figure best: a
wrong order joins far points, needs a large unit and so a small likelihood.  No exchange of a body's joints is likelier
than the body, and over a while the limbs of both sides are about as long.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from drocap_ros.skeleton import LIMB_JOINTS

#: Joints -> their weights in a vector of the image (right, down), its mean for a person who stands about, and its
#: deviations, as shares of the stature; a judgement, tried on MoCap of every kind, seen from the side and from above.
_VECTORS: list[tuple[dict[str, float], tuple[float, float, float, float]]] = [
    ({"lhip": 1, "rhip": -1}, (0.0, 0.0, 0.11, 0.05)),
    ({"lshoulder": 1, "rshoulder": -1}, (0.0, 0.0, 0.15, 0.07)),
    ({"lhip": 1, "rhip": -1, "lshoulder": -0.75, "rshoulder": 0.75}, (0.0, 0.0, 0.06, 0.05)),
    *(
        ({f"{side}{begin}": -1.0, f"{side}{end}": 1.0}, vector)
        for begin, end, vector in (
            ("hip", "shoulder", (0.0, -0.22, 0.1, 0.1)),
            ("hip", "knee", (0.0, 0.17, 0.1, 0.1)),
            ("knee", "ankle", (0.0, 0.17, 0.1, 0.1)),
            ("shoulder", "elbow", (0.0, 0.09, 0.08, 0.09)),
            ("elbow", "wrist", (0.0, 0.02, 0.09, 0.09)),
        )
        for side in "rl"
    ),
    ({"face": 1, "rshoulder": -0.5, "lshoulder": -0.5}, (0.0, -0.11, 0.06, 0.06)),
]
_MODEL = np.array([vector for _, vector in _VECTORS])
_PLACES = (*LIMB_JOINTS, "face")
_WEIGHTS = np.array([[of.get(joint, 0.0) for joint in _PLACES] for of, _ in _VECTORS])
#: A person who stands, as shares of the stature: parts of a body are less spread than all of it.
_STANDING = np.array(
    [(side * across, down) for part, side in ((name[1:], 1 if name[0] == "l" else -1) for name in LIMB_JOINTS)
     for across, down in [{"hip": (0.05, 0.0), "knee": (0.05, 0.17), "ankle": (0.05, 0.34), "shoulder": (0.07, -0.22),
                           "elbow": (0.09, -0.13), "wrist": (0.09, -0.11)}[part]]] + [(0.0, -0.33)]
)  # fmt: skip
#: Points of the head, the one that is most often seen first.
_HEADS = ("nose", "head", "head_top", "left_eye", "right_eye", "left_ear", "right_ear", "crown")
#: Statures that are tried, as multiples of the points' deviation from their middle.
_UNITS = np.geomspace(1.0, 12.0, 32)
#: Degrees of freedom of the bones' distribution: few, so that a bad point counts little.
_FREEDOM = 3.0
#: Exchanges of joints: two of a side or of a kind, parts of both arms and legs, arms for legs, left for right.
_LIMBS, _SIDES = (["shoulder", "elbow", "wrist"], ["hip", "knee", "ankle"]), "lr"
_EXCHANGES = [
    *([(a, b)] for a, b in itertools.combinations(LIMB_JOINTS, 2) if a[0] == b[0] or a[1:] == b[1:]),
    *(
        [(f"{side}{a}", f"{side}{b}") for side in _SIDES]
        for pairs in (*(itertools.pairwise(limb) for limb in _LIMBS), zip(*_LIMBS, strict=True))
        for a, b in pairs
    ),
    [(f"{side}{a}", f"{side}{b}") for side in _SIDES for a, b in zip(*_LIMBS, strict=True)],
    *([(f"l{joint}", f"r{joint}") for joint in limb] for limb in _LIMBS),
]
#: Greatest lead of an exchange, and least likelihood: for names that are stated, and for an order that is only likely.
#: Of 150 takes of MoCap of every kind from up to 45 degrees above 2 % pass neither; of shuffled joints none passes.
_MOST_LEAD, _LEAST = (0.12, 0.1), (0.3, 0.4)


def limbs_of(names: Sequence[str]) -> dict[str, int]:
    """Place of each of the twelve limb joints, and of a point of the head as ``face``, among the names."""
    place = {name: i for i, name in enumerate(names)}
    found = {}
    for joint in LIMB_JOINTS:
        long = f"{'left' if joint[0] == 'l' else 'right'}_{joint[1:]}"
        if (at := place.get(joint, place.get(long))) is not None:
            found[joint] = at
    if (face := next((place[name] for name in _HEADS if name in place), None)) is not None:
        found["face"] = face
    return found


def body_likelihood(xy: np.ndarray, names: Sequence[str]) -> float:
    """Mean logarithm of the likelihood of a bone of points (F, P, 2), NaN unknown; -inf where too few are seen.

    It is relative to the spread of all points: that of all orders of the same points compares.
    """
    frames, joints = _limb_points(xy, names)
    return float(_likelihood(joints, _spread(frames)).mean()) if len(frames) else -np.inf


def is_no_body(xy: np.ndarray, names: Sequence[str], *, strict: bool = False) -> bool:
    """Whether points (F, P, 2) with names are none of a body; False where too few are seen to tell.

    strict : for an order that nobody states: it has to be clear that they are of a body
    """
    frames, joints = _limb_points(xy, names)
    if not len(frames):
        return strict
    seen = np.isfinite(joints[..., 0])
    spread = _spread(joints) / _spread(np.where(seen[..., None], _STANDING, np.nan)) * _spread(_STANDING[None])
    found = _likelihood(joints, spread)
    uneven = max((abs(np.log(_length(joints, "l", *bone) / _length(joints, "r", *bone))) for limb in _LIMBS
                  for bone in itertools.pairwise(limb)), default=0.0)  # fmt: skip
    uneven = uneven if len(joints) >= 8 else 0.0  # fewer frames say nothing of it
    # Lengths of both sides that differ by more (logarithm) take off a share: a hand near the camera reaches it.
    if found.mean() - 0.6 * max(np.nan_to_num(uneven) - 0.6, 0.0) < _LEAST[strict]:
        return True
    for pairs in _EXCHANGES:
        order = np.arange(len(_PLACES))
        for a, b in pairs:
            order[[_PLACES.index(a), _PLACES.index(b)]] = _PLACES.index(b), _PLACES.index(a)
        moved = order != np.arange(len(_PLACES))
        both = seen[:, moved].all(axis=1)  # without those the number of known bones would differ
        if both.sum() >= min(4, len(both)):  # by so many frames an exchange is judged
            exchanged = _likelihood(joints[both][:, order], spread[both])
            known = (~(~seen[both] @ (_WEIGHTS != 0).T)).mean()  # where few bones are seen each counts more
            margin = _MOST_LEAD[strict] * (1 + 2 / both.sum()) / known  # one pose says less than many
            if exchanged.mean() > found[both].mean() + margin:
                return True
    return False


def _limb_points(xy: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Frames (F, P, 2) that show enough, and the points of limbs and head (F, 13, 2) in them."""
    places = limbs_of(names)
    seen = np.isfinite(xy[:, list(places.values())]).all(axis=2).sum(axis=1) if places else np.zeros(len(xy), int)
    frames = xy[seen >= 6]  # of the twelve limbs and the head: fewer tell nothing
    # Frames that are looked at, even steps of all.
    frames = frames[:: max(1, len(frames) // 32)]
    joints = np.full((len(frames), len(_PLACES), 2), np.nan)
    for joint, at in places.items():
        joints[:, _PLACES.index(joint)] = frames[:, at]
    return frames, joints


def _spread(points: np.ndarray) -> np.ndarray:
    """(F, 1, 1) deviation of points (F, P, 2) from their middle."""
    return np.asarray(np.maximum(np.sqrt(np.nanvar(points, axis=1).sum(axis=1)), 1e-9)[:, None, None])


def _likelihood(joints: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """(F,) of each frame."""
    known = ~(np.isnan(joints[..., 0]) @ (_WEIGHTS != 0).T)
    bones = np.where(known[..., None], _WEIGHTS @ np.nan_to_num(joints), np.nan) / spread
    units = _UNITS[:, None, None, None]
    off = ((bones - units * _MODEL[:, :2]) / (units * _MODEL[:, 2:])) ** 2
    like = -(_FREEDOM / 2 + 1) * np.log1p(off.sum(axis=3) / _FREEDOM) - np.log(_MODEL[:, 2:]).sum(axis=1)
    total = np.nansum(like - 2 * np.log(units[..., 0]), axis=2)  # (U, F)
    return np.asarray((total / np.maximum(known.sum(axis=1), 1)).max(axis=0))


def _length(joints: np.ndarray, side: str, begin: str, end: str) -> float:
    a, b = (joints[:, _PLACES.index(f"{side}{joint}")] for joint in (begin, end))
    lengths = np.linalg.norm(a - b, axis=1)
    return float(lengths[np.isfinite(lengths)].mean()) + 1e-9 if np.isfinite(lengths).any() else np.nan
