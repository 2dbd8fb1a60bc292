"""Rendered scenes of three people before one drone: they walk, cross and hug; the truth of each is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from drocap_ros.perception.sources.base import Frame
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.render.body import dress
from drocap_ros.simulation.render.renderer import draw_people
from drocap_ros.simulation.render.scenery import make_scenery
from drocap_ros.simulation.simulated_person import simulate_person, two_bone
from drocap_ros.skeleton import BODY_15
from lab.simulation.orbit import look_at

SIZE = (1280, 720)
_GAIT_M_S = 1.2  # mean speed of the simulated walk
_HUG_M = 0.34  # between two who hug: their trunks touch
#: A joint is another person's when it is this near to that person's, and this far from the own, lengths in the image.
_ON_OTHER, _OFF_OWN = 0.06, 0.1


@dataclass(frozen=True)
class PeopleScene:
    """name : what the three do, "walk", "cross", "hug"; seed : of scenery, looks and gaits; orbit : the drone flies."""

    name: str
    seed: int
    duration_s: float = 8.0
    rate_hz: float = 12.5
    elevation_deg: float = 20.0
    distance_m: float = 8.0
    orbit: bool = True

    @property
    def times(self) -> np.ndarray:
        """(F,) s."""
        return np.arange(round(self.duration_s * self.rate_hz)) / self.rate_hz


SCENES = tuple(PeopleScene(name, seed) for name in ("hug", "cross", "walk") for seed in (1,))


def people_of(scene: PeopleScene) -> list[np.ndarray]:
    """(F, 15, 3) m of each of the three, on the ground."""
    t, u = scene.times, 2 * np.pi * scene.times / scene.duration_s
    rng = np.random.default_rng([scene.seed, 0xBEE])
    phase = rng.uniform(0, 2 * np.pi, 3)
    circle = np.stack([1.6 * np.cos(u + phase[2]), 2.2 + 0.8 * np.sin(u + phase[2])], axis=1)
    if scene.name == "walk":
        paths = [
            np.stack([2.0 * np.cos(u + a + phase[0]), 1.4 * np.sin(u + a + phase[0])], axis=1) for a in (0.0, 2.1, 4.2)
        ]
        return [_along(t, path, scene.seed + 10 * i) for i, path in enumerate(paths)]
    if scene.name == "cross":
        side = 2.2 * np.cos(2 * u + phase[0])
        paths = [np.stack([side, 0.3 + 0.0 * u], 1), np.stack([-side, -0.3 + 0.0 * u], 1), circle - [0.0, 1.0]]
        return [_along(t, path, scene.seed + 10 * i) for i, path in enumerate(paths)]
    # Two walk up to each other, hug for two seconds and part; the third passes by.
    apart = _HUG_M / 2 + 1.8 * np.clip(np.abs(t - scene.duration_s / 2) - 1.0, 0.0, None) ** 2 / 6.0
    axis = np.array([np.cos(phase[0]), np.sin(phase[0])])
    pair = [
        _along(t, sign * apart[:, None] * axis, scene.seed + 10 * i, -sign * axis) for i, sign in enumerate((1, -1))
    ]
    near = np.clip(2.0 - (apart - _HUG_M / 2) / 0.15, 0.0, 1.0)
    hugging = [_with_arms_around(one, other, near) for one, other in zip(pair, pair[::-1], strict=True)]
    return [*hugging, _along(t, circle, scene.seed + 20)]


def _along(t: np.ndarray, path: np.ndarray, seed: int, facing: np.ndarray | None = None) -> np.ndarray:
    """A walk along a path (F, 2) m: the gait goes on with the way, so that feet rest; or with a direction faced."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    gait = 2.0 + np.concatenate([[0.0], np.cumsum(step)]) / _GAIT_M_S
    stature = 1.6 + 0.08 * (seed % 4)
    walker = simulate_person(gait, "walk", seed, stature)
    later = (
        simulate_person(gait + 0.5, "walk", seed, stature),
        simulate_person(np.maximum(gait - 0.5, 0.0), "walk", seed, stature),
    )
    own = (later[0] - later[1])[:, 0, :2]
    way = np.gradient(path, t, axis=0) if facing is None else np.tile(facing, (len(t), 1))
    turn = np.arctan2(way[:, 1], way[:, 0]) - np.arctan2(own[:, 1], own[:, 0])
    cos, sin, local = np.cos(turn)[:, None], np.sin(turn)[:, None], walker - walker[:, :1] * [1, 1, 0]
    x, y = cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]
    return np.stack([x + path[:, :1], y + path[:, 1:], local[..., 2]], axis=2)


def _with_arms_around(one: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(F, 15, 3) with the arms around another person's back, by shares (F,)."""
    joints, at = one.copy(), BODY_15.index
    ahead = other[:, 0] - one[:, 0]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-6)[:, None]
    across = np.cross([0.0, 0.0, 1.0], ahead)
    back = 0.3 * other[:, at("pelvis")] + 0.7 * other[:, at("neck")] + 0.14 * ahead
    for letter, side in (("l", 1.0), ("r", -1.0)):
        shoulder, elbow, wrist = (one[:, at(letter + name)] for name in ("shoulder", "elbow", "wrist"))
        first, second = (float(np.linalg.norm(b[0] - a[0])) for a, b in ((shoulder, elbow), (elbow, wrist)))
        goal = wrist + share[:, None] * (back + 0.08 * side * across + [0.0, 0.0, 0.05 * side] - wrist)
        pole = side * across + np.array([0.0, 0.0, -0.6])
        bent, end = two_bone(shoulder, goal, pole, first, second)
        keep = (share == 0.0)[:, None]
        joints[:, at(letter + "elbow")] = np.where(keep, elbow, bent)
        joints[:, at(letter + "wrist")] = np.where(keep, wrist, end)
    return joints


@dataclass(frozen=True)
class SceneCamera:
    """matrix (3, 3) px; rotation (F, 3, 3) world -> camera; position (F, 3) m."""

    matrix: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def pixels(self, joints: np.ndarray) -> np.ndarray:
        """(F, P, 2) px of joints (F, P, 3) m."""
        found: np.ndarray = project(joints, self.rotation, self.position, self.matrix)
        return found


def camera_of(scene: PeopleScene) -> SceneCamera:
    """A drone that flies about the three, or a camera that stands."""
    rng = np.random.default_rng([scene.seed, 0xCA3])
    t = scene.times if scene.orbit else 0.0 * scene.times
    bearing = rng.uniform(-np.pi, np.pi) + np.deg2rad(9.0) * t + 0.05 * np.sin(0.9 * t)
    tilt = np.deg2rad(scene.elevation_deg) + 0.03 * np.sin(0.7 * t)
    away = np.stack([np.cos(tilt) * np.cos(bearing), np.cos(tilt) * np.sin(bearing), np.sin(tilt)], axis=1)
    target = np.stack([0.2 * np.sin(0.5 * t), 0.4 + 0.2 * np.cos(0.6 * t), np.full(len(t), 0.9)], axis=1)
    position = target + scene.distance_m * away
    return SceneCamera(pinhole_matrix(*SIZE, 60), look_at(position, target), position)


def images_of(scene: PeopleScene, people: Sequence[np.ndarray], who: Sequence[int] = (0, 1, 2)) -> Iterator[Frame]:
    """Images of the scene with some of its people; the same arguments give the same images."""
    camera, scenery = camera_of(scene), make_scenery(scene.seed)
    for i, t in enumerate(scene.times):
        shown = [(people[k][i], dress(scene.seed + 100 * k)) for k in who]
        image, _ = draw_people(scenery, shown, camera.matrix, SIZE, camera.rotation[i], camera.position[i])
        yield Frame(round((1.0 + float(t)) * 1e9), image)


def of_another(keypoints: np.ndarray, truth: Sequence[np.ndarray], who: int) -> np.ndarray:
    """(F, 15) bool: keypoints (F, 15, 2) px of a person that lie on a joint of another, the same or the other side's.

    truth : (F, 15, 2) px of everybody; who : index of the person
    """
    own = truth[who]
    length = np.ptp(own, axis=1).max(axis=1)[:, None]

    def off(person: np.ndarray) -> np.ndarray:
        both = [np.linalg.norm(keypoints - p, axis=2) for p in (person, person[:, BODY_15.mirror])]
        return np.minimum(*both) / length

    others = np.min([off(person) for k, person in enumerate(truth) if k != who], axis=0)
    found: np.ndarray = (others < _ON_OTHER) & (off(own) > _OFF_OWN)
    return found


def write_video(path: Path, scene: PeopleScene) -> None:
    """An .avi of a scene, 640x360, on ground with stones: what is rendered has hardly any texture."""
    people = people_of(scene)
    ground = next(images_of(scene, people, ())).image
    rng = np.random.default_rng(1)
    stones = ground.copy()
    for x, y in rng.integers((0, 0), SIZE, (400, 2)).tolist():
        cv2.circle(stones, (x, y), 4, (0.8 * ground[y, x]).tolist(), -1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), scene.rate_hz, (640, 360))
    for frame in images_of(scene, people):
        bare = (frame.image == ground).all(axis=2, keepdims=True)
        image = np.where(bare, stones, frame.image)
        writer.write(cv2.resize(image, (640, 360), interpolation=cv2.INTER_AREA))
    writer.release()
