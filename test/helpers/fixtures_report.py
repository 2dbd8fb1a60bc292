"""A motion as a reconstruction gives it: joints with their truth's keypoints and a little error."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from report_motions import first_frames

from drocap_ros.motion import Motion
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import simulate_capture


@pytest.fixture(scope="session")
def person() -> Motion:
    """Four seconds of a simulated person seen by an orbiting camera, 15 frames per second."""
    capture = simulate_capture(4.0, 15.0, seed=3)
    joints = capture.joints3d_world
    error = np.linalg.norm(capture.tracks.keypoints - capture.keypoints_exact, axis=2)
    return Motion(
        joints3d=joints,
        joints=BODY_15.joints,
        parents=BODY_15.parents,
        stamp_ns=capture.tracks.stamp_ns,
        frame="world",
        metric=False,
        scale_source="assumed_height",
        camera_rotation=capture.camera_rotation,
        confidence=np.full(joints.shape[:2], 0.8),
        keypoints=capture.tracks.keypoints,
        reprojection_px=error,
        meta={
            "method": "ba",
            "input": "walk.mp4",
            "command": "drocap reconstruct walk.mp4",
            "assumed_height_m": 1.7,
            "seconds": {"pose2d": 3.0, "initial": 0.2, "ba": 0.1, "total": 0.3},
            "versions": {"drocap_ros": "0.1.0", "numpy": np.__version__},
            "git_revision": "0123456789abcdef",
            "iterations": 150,
            "stop_reason": "converged",
        },
    )


@pytest.fixture(scope="session")
def reported_in_camera(person: Motion) -> Motion:
    """The same person as each image saw it, pelvis at the origin."""
    centred = person.joints3d - person.joints3d[:, :1]
    joints = np.einsum("fij,fpj->fpi", person.camera_rotation, centred)
    identity = np.tile(np.eye(3), (len(joints), 1, 1))
    return dataclasses.replace(person, joints3d=joints, frame="camera", camera_rotation=identity)


@pytest.fixture(scope="session")
def one_frame(person: Motion) -> Motion:
    """A single frame."""
    return first_frames(person, 1)
