"""Size of the person: mm per unit of the keypoints, bone lengths, and the zoom (relative size in the image over time).

A new person is measured by the lifter and a first adjustment; a known person's sizes come from an earlier window.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.geometry.alignment import bone_lengths
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import Evidence
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LiftedMotion, LifterInput
from drocap_ros.reconstruction.lifted.window_solver import (
    Cancelled,
    WindowModel,
    solve_signs_and_adjust,
    window_model,
)
from drocap_ros.skeleton import BODY_17

_BONES = BODY_17.bones
#: Bones whose total length defines the mm of an ordinary person.
YARDSTICK = [0, 1, 2, 6, 7]
#: That length of an ordinary person: it defines the mm of the weights in :class:`LiftedConfig`.
YARDSTICK_MM = 1550.0


@dataclass(frozen=True)
class BodySize:
    """Sizes that an earlier window found.

    lengths_mm : (18,) of :data:`~drocap_ros.reconstruction.lifted.adjustment.SPANS`, in mm of an ordinary person
    unit_per_mm : (F,) size in the image of each frame: units of the keypoints per such mm
    """

    lengths_mm: np.ndarray
    unit_per_mm: np.ndarray


@dataclass(frozen=True)
class EvenView:
    """Evenly spaced frames: keypoints of ``BODY_17``, frames per second, and what is known of the camera.

    focal : focal length in the keypoints' unit; None = unknown, the camera is taken as distant
    rotation : (F, 3, 3) world (z up) -> camera, NaN where unknown; None = unknown
    evidence : poses of these frames by another method; None = there are none
    """

    keypoints: Keypoints2D
    fps: float
    focal: float | None
    rotation: np.ndarray | None
    evidence: Evidence | None = None


@dataclass(frozen=True)
class SizedWindow:
    """A window with known size and bone lengths, before the final adjustment.

    flat : (F, 17, 2) mm, the keypoints in a distant camera about ``centre`` (F, 2)
    lifted : the lifter's joints in mm, from ``flat`` and the lengths (18,) mm
    zoom : (F,) the person's relative size; ``mm`` per unit of the keypoints at zoom 1
    seconds, iterations : of the first adjustment
    """

    model: WindowModel
    flat: np.ndarray
    lifted: LiftedMotion
    lengths: np.ndarray
    centre: np.ndarray
    zoom: np.ndarray
    mm: float
    seconds: float
    iterations: int


def measure_size(view: EvenView, config: LiftedConfig, lifter: Lifter, cancelled: Cancelled | None) -> SizedWindow:
    """Size of a new person: lift, adjust, and lift again with the lengths found."""
    keypoints, fps, focal = view.keypoints, view.fps, view.focal
    seen = LifterInput(keypoints.xy, keypoints.confidence, None, keypoints.covariance, view.rotation, focal)
    lift = lifter.lift_toes_apart if config.drawn_toes else lifter.lift
    lifted = lift(seen, fps)
    clock = time.perf_counter()
    mm = YARDSTICK_MM / max(float(np.median(bone_lengths(lifted.joints), axis=0)[YARDSTICK].sum()), 1e-12)
    model = window_model(keypoints, lifted.joints[..., :2], mm, fps, config, lifter.interleaved(fps))
    centre = np.median(lifted.joints[..., :2], axis=1)
    zoom = _zoom_of(lifted.joints, fps)
    prior = lifted.joints.copy()
    prior[..., :2] -= centre[:, None]
    prior *= mm / zoom[:, None, None]
    flat = _orthographic(keypoints.xy, prior[..., 2], centre, zoom, mm, focal)
    rough = replace(lifted, joints=prior, sigma=lifted.sigma * mm)
    found = solve_signs_and_adjust(model, flat, rough, None, config.first_iterations, cancelled, view.evidence)
    lengths = _without_noise(found.lengths, np.median(span_lengths(prior), axis=0), model)
    zoom = zoom * found.zoom
    flat = _orthographic(keypoints.xy, found.joints[..., 2] - found.joints[:, :1, 2], centre, zoom, mm, focal)
    seconds = time.perf_counter() - clock
    believed = without_outliers(flat, found.joints[..., :2], model.noise_mm, config)
    lifted = lift(_flattened(believed, view, mm / zoom, lengths), fps)
    return SizedWindow(model, flat, lifted, lengths, centre, zoom, mm, seconds, found.iterations)


def apply_size(known: BodySize, view: EvenView, config: LiftedConfig, lifter: Lifter) -> SizedWindow:
    """Size from an earlier window: one lift, no first adjustment."""
    keypoints, fps, focal = view.keypoints, view.fps, view.focal
    mm = 1.0 / float(np.median(known.unit_per_mm))
    zoom = known.unit_per_mm * mm
    frames, joints_count = keypoints.xy.shape[:2]
    rough = _orthographic(keypoints.xy, np.zeros((frames, joints_count)), np.zeros((frames, 2)), zoom, mm, None)
    seen = _flattened(rough, view, mm / zoom, known.lengths_mm)
    lift = lifter.lift_toes_apart if config.drawn_toes else lifter.lift
    lifted = lift(replace(seen, focal=None if focal is None else focal * mm), fps)
    middle = np.median(lifted.joints[..., :2], axis=1)
    centre = middle * (zoom / mm)[:, None]
    joints = lifted.joints.copy()
    joints[..., :2] -= middle[:, None]
    flat = _orthographic(keypoints.xy, joints[..., 2], centre, zoom, mm, focal)
    place = lifted.joints[..., :2] * (zoom / mm)[:, None, None]
    model = window_model(keypoints, place, mm, fps, config, lifter.interleaved(fps))
    lifted = replace(lifted, joints=joints)
    return SizedWindow(model, flat, lifted, known.lengths_mm, centre, zoom, mm, seconds=0.0, iterations=0)


def _flattened(flat: np.ndarray, view: EvenView, scale: np.ndarray, lengths: np.ndarray) -> LifterInput:
    """Keypoints in mm of a distant camera, ``scale`` (F,) mm per unit: the lens is known to be flat where it was."""
    keypoints = view.keypoints
    covariance = None if keypoints.covariance is None else keypoints.covariance * np.square(scale)[:, None, None]
    lens = None if view.focal is None else np.inf
    return LifterInput(flat, keypoints.confidence, lengths[: len(_BONES)], covariance, view.rotation, lens)


def magnification(depth_mm: np.ndarray, distance_mm: np.ndarray) -> np.ndarray:
    """(F, 17, 1) true over seen distance from the axis, for joints behind a pelvis at the distance (F,) mm."""
    factor: np.ndarray = np.maximum(1.0 + depth_mm / distance_mm[:, None], 0.2)[..., None]
    return factor


def _without_noise(found: np.ndarray, lifted: np.ndarray, model: WindowModel) -> np.ndarray:
    """Lengths (18,) mm between those of the adjustment and of the lifter.

    The depth of a bone is free: noise lengthens the bones that the adjustment finds, and hardly those of the network.
    """
    noise = model.lasting_noise_mm / model.config.lengthening_noise_mm
    mixed: np.ndarray = lifted + (found - lifted) / (1.0 + noise**2)
    return mixed


def without_outliers(flat: np.ndarray, place: np.ndarray, noise_mm: float, config: LiftedConfig) -> np.ndarray:
    """Keypoints (F, 17, 2) without those that are alone in their frame far from the adjusted places: NaN there.

    Where the distance lasts, the adjustment may be wrong instead.
    """
    from scipy.ndimage import median_filter

    gap = np.nan_to_num(flat - place)
    alone = np.linalg.norm(gap - median_filter(gap, size=(config.alone_frames, 1, 1), mode="nearest"), axis=-1)
    limit_mm = config.alone_stds * noise_mm + config.alone_mm
    return np.where((alone > limit_mm)[..., None], np.nan, flat)


def _orthographic(
    keypoints: np.ndarray, depth_mm: np.ndarray, centre: np.ndarray, zoom: np.ndarray, mm: float, focal: float | None
) -> np.ndarray:
    """(F, 17, 2) mm, positions in a distant camera about each frame's centre (F, 2).

    ``mm`` per unit of the keypoints at zoom 1.  With the focal length the scale gives the pelvis' distance: joints
    ``depth_mm`` (F, 17) behind the pelvis move outwards, those before it inwards.
    """
    flat: np.ndarray = (keypoints - centre[:, None]) * (mm / zoom)[:, None, None]
    if focal is not None:
        flat = flat * magnification(depth_mm, focal * mm / zoom)
    return flat


def _zoom_of(joints: np.ndarray, fps: float) -> np.ndarray:
    """(F,) relative size of the lifter's bodies (F, 17, 3) over time, smooth, of median 1."""
    from scipy.ndimage import gaussian_filter1d

    size = bone_lengths(joints).sum(axis=-1)
    smooth = gaussian_filter1d(size, 1.0 * fps, mode="nearest", truncate=3.0)
    change = np.log(np.maximum(smooth / max(float(np.median(smooth)), 1e-12), 1e-3))
    # The lifter's sizes err by some percent: the adjustment finds small changes better.
    zoom: np.ndarray = np.exp(np.sign(change) * np.maximum(np.abs(change) - 0.03, 0.0))
    return zoom
