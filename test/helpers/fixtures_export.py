"""A motion with constant bones, in the camera frame, and with gaps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drocap_ros.motion import Motion
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import simulate_capture


@pytest.fixture(scope="session")
def walker() -> Motion:
    """Two seconds of a simulated person in the world frame, 24 frames per second."""
    capture = simulate_capture(2.0, 24.0, seed=3)
    joints = capture.joints3d_world
    return Motion(
        joints3d=joints,
        joints=BODY_15.joints,
        parents=BODY_15.parents,
        stamp_ns=capture.tracks.stamp_ns,
        frame="world",
        metric=True,
        scale_source="truth",
        camera_rotation=capture.camera_rotation,
        confidence=np.ones(joints.shape[:2]),
        keypoints=capture.tracks.keypoints,
        reprojection_px=np.zeros(joints.shape[:2]),
        meta={"method": "truth"},
    )


@pytest.fixture(scope="session")
def in_camera(walker: Motion) -> Motion:
    """The same person in the camera's frame, pelvis at the origin."""
    centred = walker.joints3d - walker.joints3d[:, :1]
    joints = np.einsum("fij,fpj->fpi", walker.camera_rotation, centred)
    identity = np.tile(np.eye(3), (len(joints), 1, 1))
    return dataclasses.replace(walker, joints3d=joints, frame="camera", camera_rotation=identity, metric=False)


@pytest.fixture(scope="session")
def with_gaps(walker: Motion) -> Motion:
    """Unknown joints: a wrist in five frames, all joints in two, the head at the start."""
    joints = walker.joints3d.copy()
    joints[10:15, BODY_15.index("rwrist")] = np.nan
    joints[30:32] = np.nan
    joints[:3, BODY_15.index("head")] = np.nan
    return dataclasses.replace(walker, joints3d=joints)
