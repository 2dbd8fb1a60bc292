"""Rendered scenes that are hard for a subject tracker: strong shadows, canopies, crossings, small and steep persons.

The truth is known: box and joints of the subject in every image, and the share of it that is in view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.detection.nms import iou
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.render.body import dress
from drocap_ros.simulation.render.renderer import draw_people
from drocap_ros.simulation.render.scenery import make_scenery
from drocap_ros.simulation.simulated_person import simulate_person
from lab.simulation.orbit import look_at

SIZE = (1280, 720)
#: On the subject: least number of keypoints, their least share inside the true box, the margin of that, and the least
#: overlap of the boxes.
_FEWEST, _INSIDE, _MARGIN, _SAME_BOX = 8, 0.75, 0.1, 0.3
#: Least share of the subject's joints in view.
_IN_VIEW = 0.6


@dataclass(frozen=True)
class FieldScene:
    """A scene of a walking subject.

    name : what is hard; seed : of scenery, looks and paths; elevation_deg : of the camera above the subject
    height_px : approximate height of a standing person in a level view; shadow : low sun and dark shadows
    canopies : crowns of trees over the path, each hides the subject for two to three seconds; crossing : a second
    person crosses the subject's path in front of the camera, twice
    """

    name: str
    seed: int
    elevation_deg: float = 40.0
    height_px: float = 160.0
    shadow: bool = False
    canopies: bool = False
    crossing: bool = False
    duration_s: float = 9.0
    rate_hz: float = 10.0


class FieldImage(NamedTuple):
    """image (H, W, 3) uint8 BGR, its stamp, the subject's box (4,) px and joints (15, 2) px, whether it is in view.

    shadow, other : (4,) px boxes of the subject's shadow and of the passer-by, None where there is none
    """

    image: np.ndarray
    stamp_ns: int
    box: np.ndarray | None
    joints: np.ndarray
    in_view: bool
    shadow: np.ndarray | None = None
    other: np.ndarray | None = None


SCENES = (
    *(FieldScene("shadow", seed, 35.0 + 6 * i, shadow=True) for i, seed in enumerate((0, 1, 2, 3, 15, 16))),
    *(FieldScene("canopy", seed, 50.0, canopies=True) for seed in (4, 5, 21, 27)),
    *(FieldScene("crossing", seed, 20.0, crossing=True) for seed in (7, 8, 9)),
    *(FieldScene("small, steep", 11 + i, 45 + 8.0 * i, (60, 90, 120, 130)[i], shadow=True) for i in range(4)),
)


def field_images(scene: FieldScene) -> Iterator[FieldImage]:
    """Images of a scene; the same scene gives the same images."""
    rng = np.random.default_rng([scene.seed, 0xF1E])
    t = 1.0 + np.arange(round(scene.duration_s * scene.rate_hz)) / scene.rate_hz
    joints = simulate_person(t, "walk", scene.seed)
    people = [(joints, dress(scene.seed))]
    scenery = make_scenery(scene.seed)
    bearing = rng.uniform(-np.pi, np.pi) + np.deg2rad(12.0) * t
    root = joints[:, 0] * [1, 1, 0] + [0, 0, 0.9]
    smooth = np.stack([np.convolve(np.pad(c, 15, mode="edge"), np.ones(31) / 31, "valid") for c in root.T], axis=1)
    tilt = np.deg2rad(scene.elevation_deg)
    matrix = pinhole_matrix(*SIZE, 60)
    distance = 1.75 * matrix[0, 0] / scene.height_px
    away = np.stack([np.cos(tilt) * np.cos(bearing), np.cos(tilt) * np.sin(bearing), np.full(len(t), np.sin(tilt))], 1)
    position = smooth + distance * away
    sway = 0.1 * distance * np.stack([np.sin(0.9 * t), np.sin(1.3 * t + 1), 0.3 * np.sin(1.1 * t + 2)], axis=1)
    rotation = look_at(position, smooth + sway)
    if scene.shadow:
        height, side = np.deg2rad(rng.uniform(32, 50)), rng.uniform(-np.pi, np.pi)
        sun = np.array([np.cos(height) * np.cos(side), np.cos(height) * np.sin(side), np.sin(height)])
        scenery = dataclasses.replace(scenery, sun=sun, sunlight=0.6, shade=0.35)
    if scene.crossing:
        people += [(_passer_by(scene, t, smooth, away), dress(scene.seed + 100))]
    crowns = _crowns(rng, t, root, position) if scene.canopies else np.empty((0, 4))
    for i in range(len(t)):
        shown = [(person[i], look) for person, look in people]
        image, boxes = draw_people(scenery, shown, matrix, SIZE, rotation[i], position[i])
        px = project(joints[i][None], rotation[i][None], position[i][None], matrix)[0]
        cover = np.zeros(SIZE[::-1], np.uint8)
        for crown in crowns:
            _draw_crown(image, cover, crown, matrix, rotation[i], position[i], scene.seed)
        at = np.clip(np.round(np.nan_to_num(px)), 0, np.array(SIZE) - 1).astype(int)
        free = ((px >= 0) & (px < SIZE)).all(axis=1) & (cover[at[:, 1], at[:, 0]] == 0)
        if scene.crossing and boxes[1] is not None and np.linalg.norm(people[1][0][i, 0] - position[i]) < distance:
            other = boxes[1]
            free &= ~((px > other[:2]) & (px < other[2:])).all(axis=1)
        shadow = None
        if scene.shadow:
            fallen = joints[i] - scenery.sun * (joints[i][:, 2:] / scenery.sun[2])
            at = project(fallen[None], rotation[i][None], position[i][None], matrix)[0]
            shadow = np.concatenate([at.min(axis=0), at.max(axis=0)])
        other = boxes[1] if scene.crossing else None
        yield FieldImage(image, round(t[i] * 1e9), boxes[0], px, bool(free.mean() >= _IN_VIEW), shadow, other)


def _passer_by(scene: FieldScene, t: np.ndarray, root: np.ndarray, away: np.ndarray) -> np.ndarray:
    """(F, 15, 3) m, a person who walks to and fro across the line of sight, a metre before the subject."""
    walker = simulate_person(t, "walk", scene.seed + 50, 1.7)
    across = np.stack([-away[:, 1], away[:, 0], np.zeros(len(t))], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    towards = away * [1, 1, 0] / np.linalg.norm(away[:, :2], axis=1)[:, None]
    side = 3.0 * np.cos(2 * np.pi * (t - t[0]) / scene.duration_s)
    target = root * [1, 1, 0] + towards + side[:, None] * across
    # The walk keeps its gait and turns into the direction of the path.
    step, own = np.gradient(target, t, axis=0), np.gradient(walker[:, 0], t, axis=0)
    turn = np.arctan2(step[:, 1], step[:, 0]) - np.arctan2(own[:, 1], own[:, 0])
    cos, sin = np.cos(turn), np.sin(turn)
    local = walker - walker[:, :1] * [1, 1, 0]
    turned = np.stack([cos[:, None] * local[..., 0] - sin[:, None] * local[..., 1],
                       sin[:, None] * local[..., 0] + cos[:, None] * local[..., 1], local[..., 2]], axis=2)  # fmt: skip
    return turned + target[:, None] * [1, 1, 0]


def _crowns(rng: np.random.Generator, t: np.ndarray, root: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(2, 4) m, centre and radius of crowns between the camera and the path."""
    crowns = []
    for share in (0.35, 0.75):
        i = int(share * len(t))
        centre = root[i] + (position[i] - root[i]) * 0.3
        crowns.append([*centre, rng.uniform(0.6, 0.8)])
    return np.array(crowns)


def _draw_crown(
    image: np.ndarray,
    cover: np.ndarray,
    crown: np.ndarray,
    matrix: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
    seed: int,
) -> None:
    """Leaves of a crown over the image, and their cover (H, W) uint8."""
    rng = np.random.default_rng([seed, 0x7EE])
    leaves = rng.normal(0, 1, (500, 3))
    leaves = crown[:3] + crown[3] * leaves / np.linalg.norm(leaves, axis=1)[:, None] * rng.random((500, 1)) ** (1 / 3)
    local = (leaves - position) @ rotation.T
    px = (local @ matrix.T)[:, :2] / local[:, 2:]
    shade = rng.uniform(0.5, 1.2, 500)
    for k in np.argsort(-local[:, 2]):
        at, radius = np.round(px[k]).astype(int).tolist(), round(0.1 * matrix[0, 0] / local[k, 2])
        colour = [float(v) for v in np.array([40.0, 90, 60]) * shade[k]]
        cv2.circle(image, at, radius, colour, -1, cv2.LINE_AA)
        cv2.circle(cover, at, radius, 255, -1)


def on_subject(observation: PoseObservation, image: FieldImage) -> bool:
    """Whether box and keypoints are the subject's, not a shadow's, a bystander's or those of several."""
    if not observation.has_subject or image.box is None:
        return False
    keypoints = observation.keypoints.astype(float)
    keypoints = keypoints[np.isfinite(keypoints).all(axis=1)]
    if len(keypoints) < _FEWEST or iou(observation.roi[None].astype(float), image.box[None])[0, 0] < _SAME_BOX:
        return False
    margin = _MARGIN * (image.box[2:] - image.box[:2]).max()
    inside = (keypoints >= image.box[:2] - margin) & (keypoints <= image.box[2:] + margin)
    return bool(inside.all(axis=1).mean() >= _INSIDE)
