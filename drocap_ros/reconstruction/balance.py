"""Lean of a lifted body along the view, taken off by balance: nobody's mass is beside his feet for long.

2D networks draw people whom a drone sees from above longer or narrower than they are, and a lifter makes of it a body
that leans away from the camera: by 10 degrees on real pictures from 47 degrees above.  It leans so from every side, as
no body does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.contacts import ANKLES
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.skeleton import BODY_15, indices

#: Share of the body's mass and of the way to the centre of mass between two joints (Winter, Biomechanics and Motor
#: Control of Human Movement, 2009, table 4.1).
_SEGMENTS = (
    ("neck", "head", 0.081, 0.5), ("pelvis", "neck", 0.497, 0.5),
    ("rshoulder", "rwrist", 0.05, 0.53), ("lshoulder", "lwrist", 0.05, 0.53),
    ("rhip", "rknee", 0.1, 0.433), ("lhip", "lknee", 0.1, 0.433),
    ("rknee", "rankle", 0.061, 0.606), ("lknee", "lankle", 0.061, 0.606),
)  # fmt: skip
_MASS = np.zeros(len(BODY_15))
for _from, _to, _mass, _way in _SEGMENTS:
    _MASS[indices(BODY_15.joints, (_from, _to))] += [_mass * (1.0 - _way), _mass * _way]
_THIGHS = tuple(indices(BODY_15.joints, pair) for pair in (("rknee", "rhip"), ("lknee", "lhip")))
_TRUNK = indices(BODY_15.joints, ("pelvis", "neck"))
#: Cosine of the view with the vertical above which depth is no lean, and the largest shear.
_STEEP = 0.95
_LARGEST = 1.0


def balanced(poses: ImagePoses, rotation: np.ndarray, stamp_ns: np.ndarray) -> ImagePoses:
    """Poses without the lean along the view that they have in the mean, as far as it is an error.

    Depths are sheared along the image's upright; places in the image stay.

    poses : of a camera that looks at the person, in the middle of an upright image
    rotation : (F, 3, 3) world (z up) -> camera
    stamp_ns : (F,)
    """
    shape, up = poses.joints_px - poses.joints_px[:, :1], rotation[:, :, 2]
    body = shape[:, : len(BODY_15)]
    arm = np.einsum("p,fpc->fc", _MASS / _MASS.sum(), body) - body[:, ANKLES].mean(axis=1)
    with np.errstate(invalid="ignore"):
        thigh = np.maximum(*(_rise(body, pair, up) for pair in _THIGHS))
        # Trunk and one thigh rise by 0.7 of their length: who sits, lies or bends is not on his feet.
        stands = (np.minimum(thigh, _rise(body, _TRUNK, up)) > 0.7) & (np.abs(up[:, 2]) < _STEEP)
    seconds = stands.mean() * (stamp_ns[-1] - stamp_ns[0]) * 1e-9
    if stands.mean() < 0.5 or seconds < 5.0:  # too little on the feet to tell a lean
        return poses
    arm, up = arm[stands], up[stands]
    level = np.array([0.0, 0.0, 1.0]) - up * up[:, 2:]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    shear, leans = 0.0, list[float]()
    for _ in range(10):
        leaning = arm + np.outer(arm[:, 1], [0.0, 0.0, shear])
        ahead, high = (leaning * level).sum(axis=1), np.maximum((leaning * up).sum(axis=1), 1e-9)
        lean, slope = ahead / high, arm[:, 1] * (level[:, 2] * high - up[:, 2] * ahead) / high**2
        # A lean of 0.25 rad has a quarter of the weight.
        weight = 1.0 / (1.0 + np.square(lean / 0.25)) ** 2
        leans.append(float(weight @ lean / weight.sum()))
        shear = float(np.clip(shear - (weight * slope) @ lean / max(weight @ slope**2, 1e-9), -_LARGEST, _LARGEST))
    # What exceeds the leans of people is the poses' own (the estimate of James and Stein): in the mean of 10 s on the
    # feet the centre of mass is 0.057 rad off the vertical, by MoCap of mocap/train and mocap/dev.
    share = max(1.0 - 0.057**2 / max(leans[0] ** 2, 1e-9), 0.0)
    joints = poses.joints_px.copy()
    joints[..., 2] += share * shear * shape[..., 1]
    origin = poses.report.origin | {"lean_taken_off_deg": round(float(np.degrees(share * leans[0])), 1) + 0.0}
    return replace(poses, joints_px=joints, report=replace(poses.report, origin=origin))


def _rise(body: np.ndarray, pair: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(F,) cosine of a bone's direction, from its first joint to the second one, with up."""
    bone = body[:, pair[1]] - body[:, pair[0]]
    return np.asarray((bone * up).sum(axis=1) / np.linalg.norm(bone, axis=1))
