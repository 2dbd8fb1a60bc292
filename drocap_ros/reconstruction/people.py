"""Several persons in the same images: one camera, and a motion of each in its world."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.motion import Motion
from drocap_ros.parameters import Values
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import Progress
from drocap_ros.reconstruction.reconstruct import solve
from drocap_ros.tracks import Tracks


def reconstruct_people(
    people: Mapping[int, Tracks],
    *,
    method: str = "ba",
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
) -> dict[int, Motion]:
    """Motions of persons by their numbers.

    The person whom most images show finds the camera, in all images, as :func:`~.reconstruct.reconstruct` does; its
    path and its metres are those of all.  The others' sizes are measured in it, and their motions last from the first
    to the last image that shows them.

    people : tracks of the same images by number, with the same camera and fixed points; what one has as vertical is so
        for all
    """
    seen = {number: np.flatnonzero(np.isfinite(tracks.keypoints).any(axis=(1, 2))) for number, tracks in people.items()}
    first = max(people, key=lambda number: (len(seen[number]), -number))
    settings: dict[str, Any] = {
        "method": method,
        "initializer": initializer,
        "adjuster": adjuster,
        "progress": progress,
    }
    vertical = [tracks.vertical for tracks in people.values() if tracks.vertical is not None]
    found = solve(
        dataclasses.replace(people[first], vertical=np.concatenate(vertical) if vertical else None), **settings
    )
    lead, camera = found.motion, found.shared_camera
    motions: dict[int, Motion] = {}
    for number, tracks in people.items():
        rows = slice(int(seen[number][0]), int(seen[number][-1]) + 1)
        motion = lead if number == first else _other(tracks.of_frames(rows), camera, lead, settings)
        motions[number] = dataclasses.replace(motion, meta={**motion.meta, "camera_found_with": first})
    return motions


def _other(tracks: Tracks, camera: CameraPath | None, lead: Motion, settings: Mapping[str, Any]) -> Motion:
    """The motion of another person than the one with whom the camera was found, where it was."""
    if camera is None:
        tracks = dataclasses.replace(tracks, background=None)
        if "telemetry_rejected" in lead.meta:
            tracks = dataclasses.replace(tracks, camera_rotation=None, camera_position=None)
    else:
        camera = camera.of_images(np.searchsorted(camera.stamp_ns, tracks.stamp_ns))
    motion = solve(tracks, shared_camera=camera, **settings).motion
    told: Values = {name: lead.meta[name] for name in ("camera", "telemetry_rejected") if name in lead.meta}
    return dataclasses.replace(motion, meta=motion.meta | told)
