"""A clip with cuts: the shots between them, and the one motion that theirs make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.geometry.ellipsoids import pack_covariance, unpack_covariance
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import Motion
from drocap_ros.parameters import Values
from drocap_ros.reconstruction.camera.cuts import cuts
from drocap_ros.reconstruction.common.poses import Progress
from drocap_ros.reconstruction.world.even_capture import LEAST_FRAMES
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

#: Shortest shot (s): what a camera does shows in images a second apart.
_LEAST_S = 1.5
#: Share of the joints with which an image shows the person.
_SHOWN = 0.5
#: Time (s) on both sides of a cut over which the body's heading is averaged: hips of single images are noisy.
_HEADING_S = 0.2
_PELVIS, _RIGHT, _LEFT = (BODY_15.index(name) for name in ("pelvis", "rhip", "lhip"))
#: Arrays of a motion by image, and by image and joint.
_IMAGES = ("stamp_ns", "camera_rotation", "camera_position")
_JOINTS = ("joints3d", "confidence", "keypoints", "reprojection_px", "covariance")


class Shots(NamedTuple):
    """Images at which further shots begin, and the tracks of the shots; no cut = the clip as it is."""

    cuts: list[int]
    tracks: list[Tracks]


def shots_of(tracks: Tracks) -> Shots:
    """The shots of a clip without telemetry; their images are those of the clip.

    A shot that is too short for a camera, or shows the person in too few images, belongs without its fixed points to
    the one before it, at the beginning to that after it.  A clip of such shots alone stays as it is.
    """
    points = tracks.background
    if points is None or tracks.camera_rotation is not None:
        return Shots([], [tracks])
    time_s = (tracks.stamp_ns - tracks.stamp_ns[0]) * 1e-9
    begins = cuts(points, time_s)
    shown = np.isfinite(tracks.keypoints).all(axis=2).mean(axis=1) >= _SHOWN
    long = [
        (begin, end)
        for begin, end in pairwise([0, *begins, len(tracks)])
        if time_s[end - 1] - time_s[begin] >= _LEAST_S and shown[begin:end].sum() >= LEAST_FRAMES
    ]
    if not begins or not long:
        return Shots([], [tracks])
    kept = np.any([(points.frame >= begin) & (points.frame < end) for begin, end in long], axis=0)
    fixed = replace(tracks, background=Background(points.frame[kept], points.track[kept], points.point[kept]))
    edges = pairwise([0, *(begin for begin, _ in long[1:]), len(tracks)])
    return Shots(begins, [fixed.of_frames(slice(*edge)) for edge in edges])


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress of one of several shots, told as that of all."""
    if progress is None:
        return None
    return lambda stage, done: progress(stage, (number + done) / count)


def shots_meta(tracks: Tracks, shots: Shots, motions: Sequence[Motion]) -> Values:
    """For ``meta``: times of the cuts, and of each shot its time (s) and camera."""
    begin_ns = tracks.stamp_ns[0]
    told = [
        {"span_s": ((motion.stamp_ns[[0, -1]] - begin_ns) * 1e-9).tolist(), "camera": motion.meta["camera"]}
        for motion in motions
    ]
    return {"cuts_s": ((tracks.stamp_ns[shots.cuts] - begin_ns) * 1e-9).tolist(), "shots": told}


def joined(motions: Sequence[Motion]) -> Motion:
    """The motion of a clip from those of its shots, each in a world of its own.

    No picture relates two shots.  The person goes on from place and heading before the cut, on the same floor; the
    covariance is that within a shot.
    """
    parts = list(accumulate(motions, _continued))
    # A shot that shows no heel has no heels.
    fewest = min(motions, key=lambda motion: len(motion.joints))
    arrays = {}
    for name in (*_IMAGES, *_JOINTS):
        use = np.s_[:, : len(fewest.joints)] if name in _JOINTS else np.s_[:]
        values = [getattr(part, name) for part in parts]
        known = all(value is not None for value in values)
        arrays[name] = np.concatenate([value[use] for value in values]) if known else None
    return replace(fewest, meta=_meta(motions, fewest), **arrays)  # type: ignore[arg-type]


def _meta(motions: Sequence[Motion], fewest: Motion) -> Values:
    """What made the motion with the fewest joints, with what differs from shot to shot of all."""
    stages = dict.fromkeys(stage for motion in motions for stage in motion.meta["seconds"])
    seconds = {stage: sum(motion.meta["seconds"].get(stage, 0.0) for motion in motions) for stage in stages}
    meta = {**fewest.meta, "frames": sum(len(motion.stamp_ns) for motion in motions), "seconds": seconds}
    if windows := [window for motion in motions for window in motion.meta.get("calibration", [])]:
        # The covariance of a shot's mean place is in the axes of that shot.
        meta["calibration"] = [{**window, "place_covariance_m2": None} for window in windows]
    if any(motion.meta.get("covariance_about") == "pelvis" for motion in motions):
        meta["covariance_about"] = "pelvis"  # that about the origin is larger
    return meta


def _continued(before: Motion, motion: Motion) -> Motion:
    """A motion turned about the vertical and moved across it, so that the person goes on from before."""
    near = [np.abs(m.stamp_ns - m.stamp_ns[at]) <= 1e9 * _HEADING_S for m, at in ((before, -1), (motion, 0))]
    angle = _heading(before.joints3d[near[0]]) - _heading(motion.joints3d[near[1]])
    turn = exp_so3(np.array([0.0, 0.0, angle]))
    shift = before.joints3d[-1, _PELVIS] - turn @ motion.joints3d[0, _PELVIS]
    shift[2] = 0.0
    place, covariance = motion.camera_position, motion.covariance
    return replace(
        motion,
        joints3d=motion.joints3d @ turn.T + shift,
        camera_rotation=motion.camera_rotation @ turn.T,
        camera_position=None if place is None else place @ turn.T + shift,
        covariance=None if covariance is None else pack_covariance(turn @ unpack_covariance(covariance) @ turn.T),
    )


def _heading(joints: np.ndarray) -> float:
    """Angle (rad) of the way from the right to the left hip in the level plane, mean of joints (F, P, 3)."""
    across = (joints[:, _LEFT] - joints[:, _RIGHT]).mean(axis=0)
    return float(np.arctan2(across[1], across[0]))
