"""A synthetic motion that the reconstruction tests share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks
from lab.studies.protocol import orbit_rotations

PX_PER_M = 400.0
CENTRE = np.array([640.0, 512.0])


@dataclass(frozen=True)
class Walk:
    """A person who walks and turns on the spot, seen by an orbiting camera.

    shape : (F, 15, 3) m, torso frame; limb lengths constant
    rotation : (F, 3, 3) torso -> camera
    camera : (F, 3, 3) world -> camera
    """

    shape: np.ndarray
    rotation: np.ndarray
    camera: np.ndarray

    @property
    def in_camera(self) -> np.ndarray:
        """(F, 15, 3) m, camera axes."""
        return self.shape @ np.swapaxes(self.rotation, 1, 2)

    @property
    def keypoints(self) -> np.ndarray:
        """(F, 15, 2) px."""
        return self.in_camera[..., :2] * PX_PER_M + CENTRE

    def tracks(self, keypoints: np.ndarray | None = None, **more: np.ndarray) -> Tracks:
        """Tracks of it at 24 fps."""
        keypoints = self.keypoints if keypoints is None else keypoints
        return Tracks(keypoints, BODY_15.joints, stamps(len(keypoints)), (1280, 1024), **more)


def stamps(frames: int) -> np.ndarray:
    return np.round(np.arange(frames) * (1e9 / 24.0)).astype(np.int64)


def make_walk(frames: int, *, speed_deg_s: float = 40.0) -> Walk:
    """Limbs that swing about fixed joints, so that every limb keeps its length."""
    t = np.arange(frames) / 24.0
    phase = 2.0 * np.pi * 0.9 * t
    s = np.zeros((frames, 15, 3))

    def place(joint: str, parent: str, length: float, pitch: np.ndarray | float, sideways: float = 0.0) -> None:
        pitch = np.broadcast_to(pitch, (frames,))
        way = np.stack([np.sin(pitch), np.full(frames, np.sin(sideways)), -np.cos(pitch)], axis=-1)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        s[:, BODY_15.index(joint)] = s[:, BODY_15.index(parent)] + length * way

    s[:, BODY_15.index("neck")] = [0.0, 0.0, 0.55]
    s[:, BODY_15.index("head")] = [0.02, 0.0, 0.65]
    for side, sign in (("l", 1.0), ("r", -1.0)):
        s[:, BODY_15.index(side + "hip")] = [0.0, 0.09 * sign, 0.0]
        s[:, BODY_15.index(side + "shoulder")] = [-0.02, 0.17 * sign, 0.42]
        swing = sign * np.sin(phase)
        place(side + "knee", side + "hip", 0.42, 0.5 * swing, 0.05 * sign)
        place(side + "ankle", side + "knee", 0.42, 0.5 * swing - 0.5 - 0.3 * np.cos(phase) * sign, 0.02 * sign)
        place(side + "elbow", side + "shoulder", 0.28, -0.6 * swing, 0.2 * sign)
        place(side + "wrist", side + "elbow", 0.25, -0.6 * swing + 0.7, 0.1 * sign)
    camera = orbit_rotations(frames, speed_deg_s)
    heading = exp_so3(np.stack([0 * t, 0 * t, 0.5 * np.sin(0.3 * t)], axis=-1))
    return Walk(s - s.mean(1, keepdims=True), camera @ heading, camera)


def write_mocap(folder: Path, name: str, frames: int = 90, **changes: np.ndarray) -> None:
    arrays = {
        "X": 1000.0 * make_walk(frames).in_camera.astype(np.float32),
        "fps": np.array(30.0),
        "joints": np.array(BODY_15.joints),
        "licence": np.array("made here"),
        "source": np.array("synthetic"),
    }
    np.savez(folder / f"{name}.npz", **{**arrays, **changes})
