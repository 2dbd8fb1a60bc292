"""Poses of every image by another system, out of a file: evidence of depth beside 2D tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints.orders import joint_name
from drocap_ros.skeleton import BODY_17
from drocap_ros.stamps import as_stamps
from drocap_ros.tracks import Tracks, read_npz

#: Names of the file's array of joints, in the order of preference.
_ARRAYS = ("evidence", "joints3d", "world")
#: Our part -> the words of SMPL, MHR and SOMA (and Mixamo) for it, the clearest first: a foot is a toe's end where an
#: ankle is named, a shoulder is a collar bone where an arm is named, a leg is a thigh where a shin is named.
_WORDS = {
    "pelvis": ("pelvis", "hips", "root", "hip"),
    "neck": ("neck", "c_neck", "neck1"),
    "head": ("head", "c_head"),
    "hip": ("hip", "upleg", "up_leg", "thigh", "leg"),
    "knee": ("knee", "lowleg", "low_leg", "shin", "leg"),
    "ankle": ("ankle", "foot"),
    "toe": ("ball", "toe_base", "big_toe", "toes", "foot"),
    "shoulder": ("uparm", "up_arm", "upper_arm", "arm", "shoulder"),
    "elbow": ("elbow", "lowarm", "low_arm", "fore_arm", "forearm"),
    "wrist": ("wrist",),
}
#: Stamps (ns) of file and tracks may differ by so much: a quarter of a frame at 30 Hz.
_SAME_NS = 8_000_000


def with_evidence(tracks: Tracks, path: Path) -> Tracks:
    """Tracks with the poses of an ``.npz`` file: ``joints`` (J) names, ``evidence`` (N, J, 3) in the camera's axes.

    ``joints3d`` is another name of the latter; ``evidence_sigma`` (N, J) is its expected error in the same unit.  The
    N images are those of the tracks, or ``stamp_ns`` (N) says which.
    """
    arrays = read_npz(path, ("joints",))
    name = next((name for name in _ARRAYS if name in arrays), None)
    if name is None:
        raise InputError(f"{path}: expected an array {' or '.join(_ARRAYS)} of joints; found none; add it")
    theirs = np.atleast_1d(arrays["joints"]).astype(str).tolist()
    poses = np.asarray(arrays[name], dtype=np.float64)
    sigma = np.asarray(arrays.get("evidence_sigma", np.full(poses.shape[:2], np.nan)), dtype=np.float64)
    if poses.shape[1:] != (len(theirs), 3) or sigma.shape != poses.shape[:2]:
        raise InputError(f"{path}: expected {name} (N, {len(theirs)}, 3), got {poses.shape}; one joint per name")
    rows = _rows(path, arrays, len(poses), tracks)
    places = body_places(theirs)
    if len(places) < len(BODY_17) // 2:
        raise InputError(f"{path}: expected joints of SMPL, MHR or SOMA by name, got {', '.join(theirs[:8])}; rename")
    out, error = np.full((*tracks.keypoints.shape[:2], 3), np.nan), np.full(tracks.keypoints.shape[:2], np.nan)
    for column, joint in enumerate(tracks.joints):
        place = places.get(_short(joint))
        if place is not None:
            out[rows >= 0, column] = poses[rows[rows >= 0], place]
            error[rows >= 0, column] = sigma[rows[rows >= 0], place]
    return dataclasses.replace(tracks, evidence=out, evidence_sigma=error)


def body_places(names: Iterable[str]) -> dict[str, int]:
    """Joint of ``BODY_17`` -> its place among another system's names."""
    spelled = {joint_name(name): place for place, name in enumerate(names)}
    found: dict[str, int] = {}
    for joint in BODY_17.joints:
        side = {"l": "left_", "r": "right_"}.get(joint[0], "") if joint[1:] in _WORDS else ""
        words = [f"{side}{word}" for word in _WORDS[joint[1:] if side else joint]]
        place = next((spelled[w] for w in words if w in spelled and spelled[w] not in found.values()), None)
        if place is not None:
            found[joint] = place
    return found


def _short(joint: str) -> str:
    """Our name of a joint of any of our sets."""
    name = joint_name(joint)
    for side in ("left_", "right_"):
        if name.startswith(side):
            return side[0] + name.removeprefix(side).replace("big_toe", "toe")
    return name


def _rows(path: Path, arrays: dict[str, np.ndarray], count: int, tracks: Tracks) -> np.ndarray:
    """(F,) the file's row of every frame, -1 = none."""
    if "stamp_ns" in arrays:
        stamps = as_stamps(arrays["stamp_ns"])
        nearest = np.clip(np.searchsorted(stamps, tracks.stamp_ns - _SAME_NS), 0, len(stamps) - 1)
        rows = np.where(np.abs(stamps[nearest] - tracks.stamp_ns) <= _SAME_NS, nearest, -1)
        if len(stamps) == count and (rows >= 0).any():
            return rows
        raise InputError(f"{path}: expected stamp_ns of the tracks' images, one a pose; found others; correct them")
    if count != len(tracks):
        raise InputError(f"{path}: expected poses of {len(tracks)} images, got {count}; add stamp_ns (N)")
    return np.arange(count)
