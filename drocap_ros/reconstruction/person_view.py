"""The view in which a method sees the person: upright, by a camera that looks at it; and the way back to the image.

Rays of the image are turned by a rotation of each frame.  What a pose has to do with its place in the picture and with
the camera's roll is gone then; the results are turned back, so that the image is explained as before.  Where the person
is in the middle and the camera is upright, the view is the image itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.geometry.rotations import centred_camera, exp_so3, towards
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.lifted.lifter_input import centre_of
from drocap_ros.tracks import Tracks

#: Share of gravity across the view between which its roll is turned away: seen from straight above there is none.
_STEEP, _SLANTED = 0.15, 0.35
#: Least depth of a joint, share of the pelvis': what is nearer is an error of the pose.
_NEAREST = 0.1


def assumed_focal_px(size: tuple[int, int], share: float) -> float | None:
    """Focal length assumed for images of ``size`` (width, height) px: a share of their longer side; None for 0."""
    return share * max(size) if share > 0.0 else None


def with_lens(tracks: Tracks, share: float) -> Tracks:
    """Tracks of real pictures with the lens that is assumed where none is given; it has no place in the world."""
    focal = assumed_focal_px(tracks.image_size, share)
    if focal is None or not tracks.real_lens or tracks.camera_matrix is not None:
        return tracks
    return replace(tracks, camera_matrix=centred_camera(tracks.image_size, focal), camera_position=None)


def lens_word(given: Tracks, used: Tracks) -> str:
    """Where the lens comes from, for a motion's ``meta``: "given", "assumed", "unknown"."""
    if used.camera_matrix is None:
        return "unknown"
    return "assumed" if given.camera_matrix is None else "given"


@dataclass(frozen=True)
class PersonView:
    """A turn of every image's rays.

    turn : (F, 3, 3) camera -> view
    focal, centre : (2,) px, of image and view
    lens : whether these are the camera's; else the turns are about the axis alone
    """

    turn: np.ndarray
    focal: np.ndarray
    centre: np.ndarray
    lens: bool

    def keypoints(self, seen: Keypoints2D) -> Keypoints2D:
        """Keypoints of the image, px, as the view shows them."""
        ray = self._rays(seen.xy) @ np.swapaxes(self.turn, 1, 2)
        flat = ray[..., :2] / ray[..., 2:]
        covariance = seen.covariance
        if covariance is not None:
            # Derivative of the view's px by those of the image.
            turned = self.turn[:, None, :2, :2] - flat[..., None] * self.turn[:, None, 2:, :2]
            step = turned / ray[..., 2:, None] * self.focal[:, None] / self.focal
            full = step @ covariance[..., [[0, 1], [1, 2]]] @ np.swapaxes(step, -1, -2)
            covariance = full[..., [0, 0, 1], [0, 1, 1]]
        return replace(seen, xy=flat * self.focal + self.centre, covariance=covariance)

    def rotation(self, rotation: np.ndarray | None) -> np.ndarray | None:
        """(F, 3, 3) world -> view, from world -> camera."""
        return None if rotation is None else self.turn @ rotation

    def in_image(self, poses: ImagePoses) -> ImagePoses:
        """Poses of the view, px, as the image shows them: depth in the scale of the pelvis there."""
        seen, back = poses.in_image, np.swapaxes(self.turn, 1, 2)
        if not self.lens:
            xy = (seen[..., :2] - self.centre) @ np.swapaxes(back[:, :2, :2], 1, 2) + self.centre
            return _with_joints(poses, np.concatenate([xy, seen[..., 2:]], axis=-1), np.ones(len(seen)))
        focal = float(self.focal.mean())
        place = self._rays(seen[..., :2]) * _depth(seen[..., 2], focal)[..., None] @ self.turn
        xy = place[..., :2] / np.maximum(place[..., 2:], _NEAREST * focal) * self.focal + self.centre
        scale = focal / np.maximum(place[:, 0, 2], _NEAREST * focal)
        depth = (place[..., 2] - place[:, :1, 2]) * scale[:, None]
        return _with_joints(poses, np.concatenate([xy, depth[..., None]], axis=-1), scale)

    def _rays(self, xy: np.ndarray) -> np.ndarray:
        flat = (xy - self.centre) / self.focal
        return np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)


def person_view(
    keypoints: Keypoints2D, matrix: np.ndarray | None, rotation: np.ndarray | None, size: tuple[int, int]
) -> PersonView | None:
    """The view of a sequence; None where neither lens nor attitude of the camera is known: the image itself.

    keypoints : (F, P) px in the image, of a body set of 17 joints at most
    matrix : (3, 3) px of the camera; None = unknown
    rotation : (F, 3, 3) world (z up) -> camera; None = unknown
    size : width and height of the image, px
    """
    if matrix is None and rotation is None:
        return None
    focal: np.ndarray = np.full(2, float(max(size))) if matrix is None else np.diagonal(matrix)[:2]
    centre: np.ndarray = 0.5 * np.array(size) if matrix is None else matrix[:2, 2]
    away = np.zeros((len(keypoints), 2)) if matrix is None else (_place(keypoints) - centre) / focal
    turn = towards(away)
    if rotation is not None:
        turn = _upright(turn, -rotation[:, :, 2])
    return PersonView(turn, focal, centre, matrix is not None)


def _place(keypoints: Keypoints2D) -> np.ndarray:
    """(F, 2) px, smooth, of the pelvis, as in the training; of the torso where it is not seen."""
    from scipy.ndimage import gaussian_filter1d

    seen = np.where((keypoints.weights > 0.0)[..., None], keypoints.xy, np.nan)
    place = np.where(np.isfinite(seen[:, 0]), seen[:, 0], centre_of(seen[:, :15]))
    # Standard deviation, frames, of the average of the person's place: the view follows the person, not its noise.
    return np.asarray(gaussian_filter1d(place, min(6.0, len(place)), axis=0, mode="nearest"))


def _upright(turn: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The turns with the roll that brings gravity (F, 3), in camera axes, to the view's lower side."""
    seen = np.einsum("fij,fj->fi", turn, down)
    across = np.hypot(seen[:, 0], seen[:, 1])
    share = np.clip((across - _STEEP) / (_SLANTED - _STEEP), 0.0, 1.0)
    roll = np.zeros_like(seen)
    roll[:, 2] = share * np.arctan2(seen[:, 0], seen[:, 1])
    upright: np.ndarray = exp_so3(roll) @ turn
    return upright


def _depth(behind: np.ndarray, focal: float) -> np.ndarray:
    """(F, P) px from the camera, of joints behind a pelvis at the focal length's distance: a px there is a px."""
    depth: np.ndarray = np.maximum(focal + behind - behind[:, :1], _NEAREST * focal)
    return depth


def _with_joints(poses: ImagePoses, in_image: np.ndarray, scale: np.ndarray) -> ImagePoses:
    sigma = None if poses.sigma_px is None else poses.sigma_px * scale[:, None, None]
    return replace(poses, joints_px=in_image, translation_px=np.zeros((len(in_image), 2)), sigma_px=sigma)


def aside(poses: ImagePoses, matrix: np.ndarray) -> ImagePoses:
    """Poses of a person that a method took as in the middle of the picture, with depths along the camera's axis."""
    shape = true_shape(poses.in_image, matrix, about_pelvis=True)
    return _with_joints(poses, np.concatenate([poses.in_image[..., :2], shape[..., 2:]], axis=-1), np.ones(len(shape)))


def true_shape(in_image: np.ndarray, matrix: np.ndarray | None, *, about_pelvis: bool = False) -> np.ndarray:
    """(F, P, 3) px about the pelvis, in camera axes, without what the perspective of a known lens does to a pose.

    in_image : (F, P, 3) px, x and y in the image, depth in the scale of the pelvis
    about_pelvis : whether a method took the person as in the middle of the picture: the shape is that of a camera that
        looks at the pelvis, and is turned as its ray is
    """
    if matrix is None:
        return np.asarray(in_image - in_image[:, :1])
    focal = np.diagonal(matrix)[:2]
    length = float(focal.mean())
    depth = _depth(in_image[..., 2], length)
    centre = in_image[:, :1, :2] if about_pelvis else matrix[:2, 2]
    place = np.concatenate([(in_image[..., :2] - centre) / focal * depth[..., None], depth[..., None]], axis=-1)
    about: np.ndarray = place - place[:, :1]
    return about @ towards((in_image[:, 0, :2] - matrix[:2, 2]) / focal) if about_pelvis else about
