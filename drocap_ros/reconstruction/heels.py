"""Heels in 3D where a 2D network sees them: rigid feet through the adjusted ankles and toes.

A heel lies in the plane of shank and foot.  Its place in the triangle with ankle and toe is the same in all frames and
on both sides; the heels in the images determine it by least squares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.skeleton import BODY_17, BODY_19, indices

_KNEES, _ANKLES, _TOES = (
    np.array(indices(BODY_17.joints, (f"r{part}", f"l{part}"))) for part in ("knee", "ankle", "toe")
)
#: Usual place in lengths of the bone from ankle to toe, along it and away from the knee.
_USUAL = np.array([-0.3, 0.25])
#: Its spread over persons, in the same unit.
_SPREAD = 0.15
#: Error of a heel in the image at which its weight is a half, in the same unit.
_OUTLIER = 0.2


def foot_axes(joints: np.ndarray) -> np.ndarray:
    """(F, 2, 2, 3) of the right and the left foot: from ankle to toe, and as long across it, away from the knee."""
    along = joints[:, _TOES] - joints[:, _ANKLES]
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    unit = along / np.maximum(length, 1e-9)
    down = joints[:, _ANKLES] - joints[:, _KNEES]
    across = down - (down * unit).sum(axis=-1, keepdims=True) * unit
    across *= length / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    return np.stack([along, across], axis=2)


def heel_place(image_joints: np.ndarray, heels: Keypoints2D) -> tuple[np.ndarray, float]:
    """Place (2,) of the heels by :func:`foot_axes`, and the RMS error in the image over the foot's length.

    image_joints : (F, 17, 3) px, x and y in the image
    heels : (F, 2) keypoints, right and left, at least one of them seen
    """
    axes = foot_axes(image_joints)
    length = np.linalg.norm(axes[:, :, 0], axis=-1)
    seen = heels.weights > 0
    factor = 1.0 / np.maximum(length, 1e-9)[seen]
    design = np.swapaxes(axes[seen][..., :2], 1, 2) * factor[:, None, None]
    target = (heels.xy - image_joints[:, _ANKLES, :2])[seen] * factor[:, None]
    place, weight = _USUAL, heels.weights[seen]
    # Rounds of the robust fit, chosen by hand.
    for _ in range(4):
        error = design @ place - target
        used = weight / np.square(1 + np.square(error).sum(axis=-1) / _OUTLIER**2)
        matrix = np.einsum("nki,n,nkj->ij", design, used, design) + np.eye(2) * (_OUTLIER / _SPREAD) ** 2
        right = np.einsum("nki,n,nk->i", design, used, target) + _USUAL * (_OUTLIER / _SPREAD) ** 2
        place = np.linalg.solve(matrix, right)
    square = np.square(design @ place - target).sum(axis=-1)
    return place, float(np.sqrt((used * square).sum() / max(float(used.sum()), 1e-9)))


def with_heels(motion: Motion, heels: Keypoints2D, image_joints: np.ndarray) -> Motion:
    """The motion of ``BODY_17`` with the heels, ``BODY_19``; unchanged when no image shows one.

    heels : (F, 2) keypoints, right and left
    image_joints : (F, 17, 3) px, the adjusted joints, x and y in the image
    """
    if not (heels.weights > 0).any():
        return motion
    place, error = heel_place(image_joints, heels)
    added, in_image = (
        joints[:, _ANKLES] + np.einsum("k,fski->fsi", place, foot_axes(joints))
        for joints in (motion.joints3d, image_joints)
    )
    covariance = motion.covariance
    if covariance is not None:
        foot = np.median(np.linalg.norm(motion.joints3d[:, _TOES] - motion.joints3d[:, _ANKLES], axis=-1))
        spread = (1 - place[0]) ** 2 * covariance[:, _ANKLES] + float(place @ place) * covariance[:, _TOES]
        spread[..., [0, 3, 5]] += (error * foot) ** 2
        covariance = np.concatenate([covariance, spread], axis=1)
    gap = np.linalg.norm(in_image[..., :2] - heels.xy, axis=-1)
    return replace(
        motion,
        joints3d=np.concatenate([motion.joints3d, added], axis=1),
        joints=BODY_19.joints,
        parents=BODY_19.parents,
        confidence=np.concatenate([motion.confidence, heels.weights], axis=1),
        keypoints=np.concatenate([motion.keypoints, heels.xy], axis=1),
        reprojection_px=np.concatenate([motion.reprojection_px, gap], axis=1),
        covariance=covariance,
    )
