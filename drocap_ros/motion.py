"""A reconstructed motion and its ``motion.npz`` file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.tracks import read_npz


@dataclass(frozen=True)
class Motion:
    """3D joints of one subject over F frames, P joints.

    joints3d : (F, P, 3) float64, m.  In frame "world" z is up and the pelvis moves through the world; in
        frame "camera" each pose is in the optical frame of its own image (x right, y down, z forward) with
        the pelvis at the origin.
    joints, parents : P names; P parent indices, -1 at the root
    stamp_ns : (F,) int64
    frame : "world" or "camera"
    metric : whether the scale was measured (True) or assumed (False)
    scale_source : "assumed_height", "telemetry", ...
    camera_rotation : (F, 3, 3), of that frame -> camera; the identity in frame "camera"
    confidence : (F, P) in [0, 1]
    keypoints : (F, P, 2) px, those used, NaN where not seen
    reprojection_px : (F, P) px, distance of the projected joint from its keypoint, NaN where not seen
    meta : JSON-compatible: versions, revision, parameters, seconds per stage, solver's outcome
    """

    joints3d: np.ndarray
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    stamp_ns: np.ndarray
    frame: str
    metric: bool
    scale_source: str
    camera_rotation: np.ndarray
    confidence: np.ndarray
    keypoints: np.ndarray
    reprojection_px: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)


def save_motion(path: str | Path, motion: Motion) -> None:
    """Write ``motion.npz``."""
    np.savez_compressed(
        path,
        joints3d=motion.joints3d.astype(np.float64),
        joints=np.array(motion.joints),
        parents=np.array(motion.parents, dtype=np.int64),
        stamp_ns=motion.stamp_ns.astype(np.int64),
        frame=np.array(motion.frame),
        metric=np.array(motion.metric),
        scale_source=np.array(motion.scale_source),
        camera_rotation=motion.camera_rotation,
        confidence=motion.confidence,
        keypoints=motion.keypoints,
        reprojection_px=motion.reprojection_px,
        meta=np.array(json.dumps(motion.meta, sort_keys=True)),
    )


_ARRAYS = (
    "joints3d", "joints", "parents", "stamp_ns", "frame", "metric", "scale_source",
    "camera_rotation", "confidence", "keypoints", "reprojection_px", "meta",
)  # fmt: skip


def load_motion(path: str | Path) -> Motion:
    """Read a ``motion.npz``.

    Raises
    ------
    InputError
        When the file cannot be used.
    """
    path = Path(path)
    a = read_npz(path, _ARRAYS)
    joints3d = a["joints3d"]
    if joints3d.ndim != 3 or joints3d.shape[2] != 3 or joints3d.shape[1] != a["joints"].size:
        raise InputError(f"{path}: joints3d: expected (F, {a['joints'].size}, 3), got {joints3d.shape}")
    try:
        meta = json.loads(str(a["meta"]))
    except ValueError:
        raise InputError(f"{path}: meta: expected JSON text; was the file written by drocap?") from None
    return Motion(
        joints3d=joints3d,
        joints=tuple(str(j) for j in a["joints"]),
        parents=tuple(int(p) for p in a["parents"]),
        stamp_ns=a["stamp_ns"],
        frame=str(a["frame"]),
        metric=bool(a["metric"]),
        scale_source=str(a["scale_source"]),
        camera_rotation=a["camera_rotation"],
        confidence=a["confidence"],
        keypoints=a["keypoints"],
        reprojection_px=a["reprojection_px"],
        meta=meta,
    )
