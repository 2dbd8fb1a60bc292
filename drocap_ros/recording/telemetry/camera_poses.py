"""The camera's pose at each image, from the recorded states of the vehicle."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.vehicle import camera_rotation, quaternion_from_euler
from drocap_ros.geometry.interpolation import interpolate, true_runs, without_steps
from drocap_ros.geometry.rotations import quaternion_multiply
from drocap_ros.recording.telemetry.log import VehicleTrack
from drocap_ros.tracks import Tracks

#: Interpolation over longer gaps than this is reported.
REPORTED_GAP_S = 1.0
#: Share of the images that must have a pose; with fewer the telemetry is left out, not the images.
MIN_SHARE = 0.5


class CameraPoses(NamedTuple):
    """Camera poses of the images that stay.

    rotation : (F, 3, 3) world ENU -> optical, or None
    position : (F, 3) m, or None
    keep : index of the images that stay, one slice where they follow each other; the others have no telemetry
    reason : text, what is missing or was left out
    """

    rotation: np.ndarray | None
    position: np.ndarray | None
    keep: slice | np.ndarray
    reason: str


def camera_attitude(track: VehicleTrack, mount_pitch_deg: float | None = None) -> np.ndarray:
    """(N, 4) x y z w camera FLU -> ENU of each state: the gimbal's.

    Without a gimbal, ``mount_pitch_deg`` (negative = down) gives the attitude of a camera fixed to the body; without
    either all is NaN.
    """
    if mount_pitch_deg is None or np.isfinite(track.gimbal).all(axis=1).any():
        return track.gimbal
    # FLU: positive about y (left) turns the nose down.
    return quaternion_multiply(track.orientation, quaternion_from_euler(0.0, -np.deg2rad(mount_pitch_deg), 0.0))


def camera_poses(track: VehicleTrack, stamp_ns: np.ndarray, mount_pitch_deg: float | None = None) -> CameraPoses:
    """Camera pose at the stamps (F,) of images: attitude on SO(3), position linearly, by :func:`interpolate`.

    Images without a pose are left out where at least half of the images have poses; else all images stay, without
    telemetry.
    """
    attitude = camera_attitude(track, mount_pitch_deg)
    missing = "gimbal" if mount_pitch_deg is None else "attitude"
    keep, place = np.ones(len(stamp_ns), bool), _without_steps(track, stamp_ns)
    rotation, keep, reasons = _series(track.stamp_ns, attitude, stamp_ns, keep, missing, spherical=True)
    position, keep, more = _series(track.stamp_ns, place, stamp_ns, keep, "position", spherical=False)
    runs = true_runs(keep)
    return CameraPoses(
        None if rotation is None else camera_rotation(rotation[keep]),
        None if position is None else position[keep],
        slice(*runs[0].tolist()) if len(runs) == 1 else keep,
        "; ".join(reasons + more),
    )


def with_camera(
    tracks: Tracks, vehicle: VehicleTrack, at_ns: np.ndarray, mount_pitch_deg: float | None = None
) -> tuple[Tracks, str]:
    """Tracks with the camera's pose at each image, and as text what is missing; see :func:`camera_poses`.

    at_ns : (F,) times of the images by the clock of the vehicle's states
    """
    poses = camera_poses(vehicle, at_ns, mount_pitch_deg)
    kept = dataclasses.replace(tracks, camera_rotation=None, camera_position=None).of_frames(poses.keep)
    changed = dataclasses.replace(kept, camera_rotation=poses.rotation, camera_position=poses.position)
    return changed, poses.reason


def _without_steps(track: VehicleTrack, stamp_ns: np.ndarray) -> np.ndarray:
    """(N, 3) m: the track's positions about the time of the images, without the steps in which they are reported.

    Interpolated at the images, steps would no longer stand alone.
    """
    place, reach_ns = track.position.copy(), round(REPORTED_GAP_S * 1e9)
    if len(stamp_ns):
        about = (track.stamp_ns >= stamp_ns[0] - reach_ns) & (track.stamp_ns <= stamp_ns[-1] + reach_ns)
        about &= np.isfinite(place).all(axis=1)
        if about.any():
            place[about] = without_steps(place[about], track.stamp_ns[about])
    return place


def _series(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, keep: np.ndarray, name: str, *, spherical: bool
) -> tuple[np.ndarray | None, np.ndarray, list[str]]:
    """Values at the images, those of the images ``keep`` (F,) that have one, and what is missing, in words."""
    if not np.isfinite(values).all(axis=1).any() or not len(stamp_ns):
        return None, keep, [f"the states of the vehicle hold no {name}"]
    word = "attitude" if spherical else name
    found, gap_s = interpolate(known_ns, values, stamp_ns, spherical=spherical)
    known = keep & np.isfinite(found).all(axis=1)
    article = "an" if word[0] in "aeiou" else "a"
    if known.sum() < MIN_SHARE * len(stamp_ns):
        return None, keep, [f"images are up to {gap_s[keep].max():.1f} s from {article} {word}"]
    words = []
    first, last = np.flatnonzero(known)[[0, -1]]
    lost = keep & ~known
    in_gaps = lost.copy()
    in_gaps[:first] = in_gaps[last:] = False
    at_ends = lost & ~in_gaps
    if at_ends.any():
        far = f"up to {gap_s[at_ends].max():.1f} s from {article} {word}"
        words.append(f"{at_ends.sum()} images at the start or end are {far}: left out")
    if in_gaps.any():
        words.append(f"{in_gaps.sum()} images in gaps of the {word} of up to {gap_s[in_gaps].max():.1f} s: left out")
    if gap_s[known].max() > REPORTED_GAP_S:
        words.append(f"the {word} was interpolated over gaps of up to {gap_s[known].max():.1f} s")
    return found, known, words
