"""Rendered and degraded images for the training of the simulation's networks.

A sample is a person of any build and clothes in any pose of the simulation, in any scenery, from any side, from -5 to
60 degrees above and from 2.5 to 25 m away; then occluders, light, blur, noise and JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.perception.models.network_input import crop_around, cut, letterbox
from drocap_ros.simulation.pinhole import project
from drocap_ros.simulation.render.body import dress
from drocap_ros.simulation.render.renderer import draw
from drocap_ros.simulation.render.scenery import Scenery, draw_background, make_scenery
from drocap_ros.simulation.simulated_person import ACTIONS, simulate_person
from lab.simulation.orbit import look_at

#: Input sizes of the networks (width, height) px, and the pose crop's side over that of the box.
DETECTOR_SIZE = (320, 192)
POSE_SIZE = (96, 128)
POSE_PADDING = 1.25
#: Smallest seed of sceneries, persons and clothes of the training: all below are unseen.
FIRST_SEED = 1_000_000

_TAKES_PER_ACTION = 16
_POSES_PER_TAKE = 64
_TAKE_S = 22.0


class View(NamedTuple):
    """A camera: matrix (3, 3) px, rotation (3, 3) world -> camera, position (3,) m, image size (width, height)."""

    matrix: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    size: tuple[int, int]


@dataclass
class World:
    """Poses (N, 15, 3) m with the pelvis above the origin, and sceneries that are replaced in turn."""

    poses: np.ndarray
    scenes: list[Scenery]
    next_seed: int

    def renew(self) -> None:
        """Replace the oldest scenery."""
        self.scenes = [*self.scenes[1:], make_scenery(self.next_seed)]
        self.next_seed += 1


class DetectorSample(NamedTuple):
    """image (192, 320, 3) uint8 BGR; box (4,) input px x_min y_min x_max y_max, NaN without a person."""

    image: np.ndarray
    box: np.ndarray


class PoseSample(NamedTuple):
    """image (128, 96, 3) uint8 BGR; joints (15, 2) px; seen (15,) bool inside image and crop; box_px its side."""

    image: np.ndarray
    joints: np.ndarray
    seen: np.ndarray
    box_px: float


def make_world(rng: np.random.Generator, scenes: int = 12, takes: int = _TAKES_PER_ACTION) -> World:
    """Poses of all actions by persons of 1.35 to 2 m, and sceneries."""
    first = FIRST_SEED + int(rng.integers(1_000_000_000))
    poses = []
    for take in range(takes):
        for number, action in enumerate(ACTIONS):
            t = rng.uniform(0, _TAKE_S, _POSES_PER_TAKE)
            joints = simulate_person(t, action, first + take * len(ACTIONS) + number, rng.uniform(1.35, 2.0))
            joints[..., :2] -= joints[:, :1, :2]
            poses.append(joints)
    return World(np.concatenate(poses), [make_scenery(first + i) for i in range(scenes)], first + scenes)


def _view(
    rng: np.random.Generator, joints: np.ndarray, size: tuple[int, int], fraction: float, shift: np.ndarray
) -> View:
    """Camera in which the person has a fraction of the image's height, off the centre by a share of the image."""
    distance = 2.5 * 10 ** rng.uniform(0, 1)
    tilt = np.deg2rad(rng.uniform(-5, 60))
    bearing = rng.uniform(-np.pi, np.pi)
    target = joints.mean(axis=0)
    away = np.array([np.cos(tilt) * np.cos(bearing), np.cos(tilt) * np.sin(bearing), np.sin(tilt)])
    position = target + distance * away
    position[2] = max(position[2], 0.25)
    rotation = look_at(position[None], target[None])[0]
    roll = np.deg2rad(rng.normal(0, 4))
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ rotation
    local = (joints - position) @ rotation.T
    flat = local[:, :2] / np.maximum(local[:, 2:], 0.5)
    low, high = flat.min(axis=0), flat.max(axis=0)
    side = max(high[1] - low[1], 0.6 * (high[0] - low[0]), 1e-3) * 1.15
    focal = min(fraction * size[1] / side, 12.0 * max(size))
    # A rotation of the camera moves the person off the centre, as on a drone.
    middle = 0.5 * (low + high) - shift * np.array(size) / focal
    turn = look_at(np.zeros((1, 3)), np.array([[middle[0], 1.0, -middle[1]]]))[0]
    turn = turn @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    matrix = np.array([[focal, 0, 0.5 * (size[0] - 1)], [0, focal, 0.5 * (size[1] - 1)], [0, 0, 1.0]])
    return View(matrix, turn @ rotation, position, size)


def _scene(world: World, rng: np.random.Generator) -> Scenery:
    return world.scenes[int(rng.integers(len(world.scenes)))]


def _person(world: World, rng: np.random.Generator) -> np.ndarray:
    """(15, 3) m, a random pose within 12 m of the origin."""
    joints: np.ndarray = world.poses[int(rng.integers(len(world.poses)))].copy()
    turn = rng.uniform(-np.pi, np.pi)
    cos, sin = np.cos(turn), np.sin(turn)
    joints = joints @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])
    joints[:, :2] += rng.uniform(-12, 12, 2)
    return joints


def detector_sample(world: World, rng: np.random.Generator) -> DetectorSample:
    """One image, or a window around the person, in the detector's input."""
    joints = _person(world, rng)
    whole = rng.random() < 0.5
    if whole:
        size = ((640, 360), (600, 400), (512, 384))[int(rng.choice(3, p=[0.7, 0.15, 0.15]))]
        fraction = 0.07 * (1.15 / 0.07) ** rng.random()
    else:
        side = int(rng.integers(220, 400))
        size, fraction = (side, side), 0.1 * 10 ** rng.random()
    view = _view(rng, joints, size, fraction, rng.uniform(-0.48, 0.48, 2) * (1.0 if whole else 0.5))
    scene = _scene(world, rng)
    arguments = (view.matrix, *view.size, view.rotation, view.position)
    box = None
    if rng.random() < 0.1:
        image = draw_background(scene, *arguments)
    else:
        look = dress(FIRST_SEED + int(rng.integers(1_000_000_000)))
        image, box = draw(scene, look, view.matrix, view.size, joints, view.rotation, view.position)
    for _ in range(int(rng.integers(0, 4)) if rng.random() < 0.4 else 0):
        _occlude(rng, image, box)
    image = degrade(rng, image)
    canvas, place = letterbox(image, (0, 0, *view.size), DETECTOR_SIZE)
    if box is None:
        return DetectorSample(canvas, np.full(4, np.nan, np.float32))
    in_canvas = (box.reshape(2, 2) * place.scale + np.array(place.offset)).reshape(4)
    if min(in_canvas[2] - in_canvas[0], in_canvas[3] - in_canvas[1]) < 3:  # too thin to learn from
        return detector_sample(world, rng)
    return DetectorSample(canvas, in_canvas.astype(np.float32))


def pose_sample(world: World, rng: np.random.Generator, degraded: bool = True) -> PoseSample:
    """One crop around a person, by an inexact box; degraded as in :func:`degrade`, covered or cut, or as rendered."""
    joints = _person(world, rng)
    scale = 1.1 * (2.6 / 1.1) ** rng.random()
    size = (int(1.7 * POSE_SIZE[0] * scale), int(1.5 * POSE_SIZE[1] * scale))
    view = _view(rng, joints, size, 0.55, rng.uniform(-0.05, 0.05, 2))
    look = dress(FIRST_SEED + int(rng.integers(1_000_000_000)))
    image, box = draw(_scene(world, rng), look, view.matrix, size, joints, view.rotation, view.position)
    if box is None:
        return pose_sample(world, rng, degraded)
    px = project(joints[None], view.rotation[None], view.position[None], view.matrix)[0]
    if degraded:
        if rng.random() < 0.15:
            _occlude(rng, image, box)
        image = degrade(rng, image)
        box = _cut_by_the_border(rng, image, box)
    extent = box[2:] - box[:2]
    px_inside = (px > -0.5).all(axis=1) & (px < np.array(size) - 0.5).all(axis=1)
    px_inside &= _shown(image, px)
    middle = 0.5 * (box[:2] + box[2:]) + rng.normal(0, 0.04, 2) * extent
    half = 0.5 * extent * np.exp(rng.normal(0, 0.09, 2))
    guess = np.concatenate([middle - half, middle + half])
    crop = crop_around(guess, POSE_SIZE, POSE_PADDING)
    at = (px - np.array(crop.origin)) * crop.scale + np.array(crop.offset)
    seen = px_inside & (at > -0.5).all(axis=1) & (at < np.array(POSE_SIZE) - 0.5).all(axis=1)
    return PoseSample(cut(image, crop), at.astype(np.float32), seen, float(extent.max() * crop.scale))


def _cut_by_the_border(rng: np.random.Generator, image: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Box, in a quarter of the cases cut by the image's border within the person; black beyond the border."""
    box = box.copy()
    if rng.random() < 0.25:
        side = int(rng.integers(4))
        share = rng.uniform(0.05, 0.45)
        x0, y0, x1, y1 = box
        if side == 0:
            box[0] = x0 + share * (x1 - x0)
            image[:, : int(box[0])] = 0
        elif side == 1:
            box[1] = y0 + share * (y1 - y0)
            image[: int(box[1])] = 0
        elif side == 2:
            box[2] = x1 - share * (x1 - x0)
            image[:, int(box[2]) :] = 0
        else:
            box[3] = y1 - share * (y1 - y0)
            image[int(box[3]) :] = 0
    return box


def _shown(image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """(15,) bool, whether points (15, 2) px lie inside the border, where the image is not black."""
    height, width = image.shape[:2]
    at = np.clip(np.round(np.nan_to_num(px)), 0, [width - 1, height - 1]).astype(int)
    inside: np.ndarray = image[at[:, 1], at[:, 0]].any(axis=1)
    return inside


def _occlude(rng: np.random.Generator, image: np.ndarray, box: np.ndarray | None) -> None:
    """Draw a post, a board or a ball; it covers at most a part of the person."""
    import cv2

    height, width = image.shape[:2]
    colour = tuple(float(v) for v in rng.uniform(0, 255, 3))
    centre = rng.uniform([0, 0], [width, height])
    half = np.exp(rng.uniform(np.log(0.01), np.log(0.12), 2)) * height
    if box is not None:
        extent = box[2:] - box[:2]
        inside = ((centre + half > box[:2]) & (centre - half < box[2:])).all()
        if inside:
            half = np.minimum(half, 0.18 * extent.max())
    at = (int(centre[0]), int(centre[1]))
    if rng.random() < 0.4:
        cv2.ellipse(image, at, (int(half[0]) + 1, int(half[1]) + 1), 0, 0, 360, colour, -1)
    else:
        low, high = (centre - half).astype(int), (centre + half).astype(int) + 1
        cv2.rectangle(image, tuple(low.tolist()), tuple(high.tolist()), colour, -1)


def degrade(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Image (H, W, 3) uint8 with random changes of light, colour, blur, noise and JPEG."""
    import cv2

    if rng.random() < 0.7:
        gain = np.exp(rng.normal(0, 0.22)) * np.exp(rng.normal(0, 0.06, 3))
        lift = rng.normal(0, 12)
        level = np.arange(256)[:, None] / 255.0
        table = 255 * level ** np.exp(rng.normal(0, 0.2)) * gain + lift
        image = np.asarray(cv2.LUT(image, np.clip(table, 0, 255).astype(np.uint8)[None]))
    if rng.random() < 0.2:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.6)))
    elif rng.random() < 0.15:
        length = int(rng.integers(2, 7))
        kernel = np.zeros((length, length), np.float32)
        kernel[length // 2] = 1 / length
        image = np.asarray(cv2.filter2D(image, -1, kernel if rng.random() < 0.7 else kernel.T))
    if rng.random() < 0.35:
        noise = rng.standard_normal(image.shape, np.float32) * np.float32(rng.uniform(1, 12))
        image = np.clip(image + noise, 1, 255).astype(np.uint8)
    if rng.random() < 0.4:
        _, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))])
        image = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))
    marked: np.ndarray = np.maximum(image, 1)  # black marks the outside of the image
    return marked
