"""A capture of more frames than one window of the adjustment in the world holds."""

from __future__ import annotations

import dataclasses

import numpy as np

from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.studies.protocol import Sequence
from lab.studies.world_protocol import FPS, world_view


def test_windows_of_a_long_capture_join_without_a_step() -> None:
    frames = 1100
    person = simulate_person(np.arange(frames) / FPS, action="walk", seed=0)
    view = world_view(Sequence("walk", 1000.0 * person))
    motion = reconstruct(view.tracks)
    assert motion.frame == "world"
    assert len(motion.meta["calibration"]) == 2
    body = motion.joints3d[:, : len(BODY_15)]
    assert np.linalg.norm(body - view.truth, axis=-1).mean() < 0.2
    # The windows share the frames about the middle of the capture.
    step = np.linalg.norm(np.diff(body[:, 0], n=2, axis=0), axis=-1)
    seam = slice(frames // 2 - 40, frames // 2 + 40)
    assert step[seam].max() <= np.delete(step, np.r_[seam]).max()


def test_ten_seconds_without_images_leave_the_telemetry_in_use() -> None:
    frames = 720
    person = simulate_person(np.arange(frames) / FPS, action="walk", seed=0)
    view = world_view(Sequence("walk", 1000.0 * person))
    seen = np.r_[0:240, 480:frames]
    arrays = ("keypoints", "stamp_ns", "camera_rotation", "camera_position")
    tracks = dataclasses.replace(view.tracks, **{name: getattr(view.tracks, name)[seen] for name in arrays})
    motion = reconstruct(tracks)
    assert motion.meta.get("telemetry_rejected") is None
    first, second = motion.meta["calibration"]
    assert second["scale_std"] < first["scale_std"]
    error = np.linalg.norm(motion.joints3d[:, : len(BODY_15)] - view.truth[seen], axis=-1).mean(axis=1)
    assert error.mean() < 0.2
    assert error[215:265].max() < 0.4
