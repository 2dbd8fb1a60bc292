"""Study of near cameras: MoCap seen in perspective from a few metres, with each part of the camera known or unknown."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks
from lab.studies.protocol import FPS, Sequence, orbit_rotations

#: Width and height px.
IMAGE_SIZE = (1280, 720)
#: Distances in m: a room, a garden, an orbit, and a camera whose perspective is not seen.
DISTANCES_M = (3.3, 6.0, 10.0, 100.0)


@dataclass(frozen=True)
class NearCamera:
    """A camera at ``distance_m`` from the pelvis, which it follows.

    speed_deg_s : of its orbit; 0 = still
    pitch_deg : how far it looks down; roll_deg : clockwise about its axis, as seen by it
    aside_deg : angle between its axis and the pelvis, to the side
    focal : focal length, share of the image's width; the usual one of phones and drones
    """

    distance_m: float
    speed_deg_s: float = 0.0
    pitch_deg: float = 17.0
    roll_deg: float = 0.0
    aside_deg: float = 0.0
    focal: float = 0.75

    def __str__(self) -> str:
        motion = f"orbiting at {self.speed_deg_s:g} deg/s" if self.speed_deg_s else "still"
        turns = {"rolled by": self.roll_deg, "aside by": self.aside_deg}
        words = [f"{word} {deg:g} deg" for word, deg in turns.items() if deg]
        return ", ".join([f"{self.distance_m:g} m, {motion}, {self.pitch_deg:g} deg down", *words])

    def tracks(self, sequence: Sequence) -> Tracks:
        """Exact keypoints in px with all that is to be known of the camera; the world's origin is the pelvis."""
        x = (sequence.x - sequence.x[:, :1]) / 1000.0
        looking = orbit_rotations(len(x), self.speed_deg_s, elevation_rad=np.deg2rad(self.pitch_deg))
        position = -self.distance_m * looking[:, 2]
        turn = exp_so3(np.deg2rad([[0.0, self.aside_deg, 0.0], [0.0, 0.0, -self.roll_deg]]))
        rotation = turn[1] @ turn[0] @ looking
        seen = (x - position[:, None]) @ np.swapaxes(rotation, 1, 2)
        focal, centre = self.focal * IMAGE_SIZE[0], np.array(IMAGE_SIZE) / 2
        return Tracks(
            keypoints=focal * seen[..., :2] / seen[..., 2:] + centre,
            joints=BODY_17.joints[: x.shape[1]],
            stamp_ns=np.round(np.arange(len(x)) * (1e9 / FPS)).astype(np.int64),
            image_size=IMAGE_SIZE,
            camera_rotation=rotation,
            camera_position=position,
            camera_matrix=np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]]),
        )


def known(tracks: Tracks, *, lens: bool, rotation: bool, position: bool) -> Tracks:
    """The tracks with what is known of the camera."""
    return replace(
        tracks,
        camera_matrix=tracks.camera_matrix if lens else None,
        camera_rotation=tracks.camera_rotation if rotation else None,
        camera_position=tracks.camera_position if position else None,
    )


def without_camera(tracks: Tracks) -> Tracks:
    """The tracks alone."""
    return known(tracks, lens=False, rotation=False, position=False)


def error_mm(
    sequences: Iterable[Sequence], camera: NearCamera, change: Callable[[Tracks], Tracks] = lambda tracks: tracks
) -> float:
    """Mean error after the best similarity of each image, in mm, over the 12 joints of the limbs and all sequences."""
    errors = [
        float(pa_mpjpe(reconstruct(change(camera.tracks(sequence))).joints3d, sequence.x / 1000.0).mean())
        for sequence in sequences
    ]
    return 1000.0 * float(np.mean(errors))
