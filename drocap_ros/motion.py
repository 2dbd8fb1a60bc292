"""A reconstructed motion and its ``motion.npz`` file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.parameters import Values
from drocap_ros.stamps import as_stamps, check_stamps
from drocap_ros.tracks import MAX_FRAMES, read_npz

#: Name of a motion in its folder.
FILE = "motion.npz"
#: Joints farther than this from the origin are refused: no unit makes them a person's motion.
_FARTHEST_M = 1e6


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
    camera_position : (F, 3) m in that frame, None where unknown
    covariance : (F, P, 6) m^2 of the joints: xx, xy, xz, yy, yz, zz; None where unknown
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
    meta: Values = field(default_factory=dict)
    camera_position: np.ndarray | None = None
    covariance: np.ndarray | None = None


def beside(motion: Path, name: str) -> Path:
    """The file of a name that belongs to a motion's file; that of a further camera's has its name before."""
    return motion.with_name(name if motion.name == FILE else f"{motion.stem}_{name}")


def people_files(folder: Path, name: str = FILE) -> dict[int, Path]:
    """Files of a name in the folders ``person_N`` of a folder without a motion of its own, by number."""
    if not folder.is_dir() or (folder / FILE).exists():
        return {}
    files = {path.parent.name.removeprefix("person_"): path for path in folder.glob(f"person_*/{name}")}
    return {int(number): files[number] for number in sorted(filter(str.isdecimal, files), key=int)}


def upright_joints(motion: Motion) -> np.ndarray:
    """(F, P, 3) m, z up: frame "world" unchanged; frame "camera" as x right, y away from the camera, z up.

    The vertical of the latter is the camera's; gravity is unknown.
    """
    if motion.frame == "world":
        return motion.joints3d
    return np.asarray(motion.joints3d[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))


#: Optical axes of a level camera that looks along y in axes with z up: x right, y away, z up -> x right, y down, z on.
LEVEL_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def upright_camera_rotation(motion: Motion) -> np.ndarray:
    """(F, 3, 3) rows right, down, forward of the camera in the axes of :func:`upright_joints`."""
    if motion.frame == "world":
        return motion.camera_rotation
    return np.broadcast_to(LEVEL_CAMERA, motion.camera_rotation.shape)


def save_motion(path: str | Path, motion: Motion, **further: np.ndarray) -> None:
    """Write ``motion.npz``, an unknown covariance as NaN; :func:`load_motion` ignores ``further`` arrays."""
    if motion.camera_position is not None:
        further = {"camera_position": motion.camera_position, **further}
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
        covariance=np.full((*motion.joints3d.shape[:2], 6), np.nan) if motion.covariance is None else motion.covariance,
        meta=np.array(json.dumps(motion.meta, sort_keys=True)),
        **further,  # type: ignore[arg-type]
    )


#: Fields that a file may lack.
_OPTIONAL = ("camera_position", "covariance")
_REQUIRED = tuple(spec.name for spec in fields(Motion) if spec.name not in _OPTIONAL)


def motion_file(path: str | Path, *names: str) -> Path:
    """The path, or in a folder the first of ``names`` and ``motion.npz`` that exists."""
    path = Path(path)
    if not path.is_dir():
        return path
    for name in (*names, FILE):
        if (path / name).is_file():
            return path / name
    raise InputError(
        f"{path / FILE}: no such file; name the folder of a motion, or make one: `drocap reconstruct {path}`"
    )


def load_motion(path: str | Path) -> Motion:
    """Read a ``motion.npz``, by its path or that of its folder."""
    path = motion_file(path)
    a = read_npz(path, _REQUIRED)
    try:
        _check_kinds(a)
        motion = Motion(
            joints=tuple(str(j) for j in a["joints"]),
            parents=tuple(int(p) for p in a["parents"]),
            stamp_ns=as_stamps(a["stamp_ns"]),
            frame=str(a["frame"]),
            metric=bool(a["metric"]),
            scale_source=str(a["scale_source"]),
            meta=_read_meta(a["meta"]),
            camera_position=a.get("camera_position"),
            covariance=_known(a.get("covariance")),
            **{name: a[name] for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px")},
        )
        _check(motion)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return motion


def _check_kinds(a: dict[str, np.ndarray]) -> None:
    """Refuse arrays that are not of the kind of their field."""
    shape, count = a["joints3d"].shape, a["joints"].size
    if len(shape) != 3 or shape[1:] != (count, 3):
        raise InputError(f"joints3d: expected (F, {count}, 3), got {shape}")
    if a["parents"].ndim != 1 or a["parents"].dtype.kind not in "iu" or a["joints"].ndim != 1:
        raise InputError(f"joints, parents: expected (P) names and (P) integers, got {a['parents'].dtype}")
    if a["metric"].shape != () or a["metric"].dtype.kind not in "biu":
        raise InputError(f"metric: expected one truth value, got {a['metric'].dtype} {a['metric'].shape}")


def _read_meta(text: np.ndarray) -> Values:
    try:
        meta = json.loads(str(text))
    except ValueError:
        raise InputError("meta: expected JSON text; was the file written by drocap?") from None
    return meta if isinstance(meta, dict) else {}


def _known(values: np.ndarray | None) -> np.ndarray | None:
    """None where every value is NaN."""
    nothing = values is None or (values.dtype.kind == "f" and np.isnan(values).all())
    return None if nothing else values


def _check(m: Motion) -> None:
    frames, joints = m.joints3d.shape[:2]
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"joints3d: expected 1 to {MAX_FRAMES} frames, got {frames}; cut the motion")
    _check_arrays(m, frames, joints)
    if np.any(np.abs(m.joints3d) > _FARTHEST_M):
        raise InputError(f"joints3d: expected metres up to {_FARTHEST_M:g}, got larger; is the unit right?")
    check_stamps(m.stamp_ns)
    if m.frame not in ("world", "camera"):
        raise InputError(f"frame: expected 'world' or 'camera', got {m.frame[:40]!r}")
    _check_tree(m.joints, m.parents)


def _check_arrays(m: Motion, frames: int, joints: int) -> None:
    shapes = {
        "joints3d": (frames, joints, 3),
        "stamp_ns": (frames,),
        "camera_rotation": (frames, 3, 3),
        "confidence": (frames, joints),
        "keypoints": (frames, joints, 2),
        "reprojection_px": (frames, joints),
        "camera_position": (frames, 3),
        "covariance": (frames, joints, 6),
    }
    for name, shape in shapes.items():
        value = getattr(m, name)
        if value is None and name in _OPTIONAL:
            continue
        if value.shape != shape or value.dtype.kind not in "fiu":
            raise InputError(f"{name}: expected numbers of shape {shape}, got {value.dtype} {value.shape}")
        if value.dtype.kind == "f" and np.isinf(value).any():
            raise InputError(f"{name}: expected finite numbers or NaN, got infinity; use NaN for unknown")


def _check_tree(joints: tuple[str, ...], parents: tuple[int, ...]) -> None:
    if len(set(joints)) != len(joints):
        raise InputError("joints: expected distinct names, got a repeated one; rename it")
    if len(parents) != len(joints) or not all(-1 <= parent < len(joints) for parent in parents):
        raise InputError(f"parents: expected {len(joints)} joint indices, -1 at the root, got {parents[:40]}")
    reached = {-1}
    while grown := {j for j, parent in enumerate(parents) if parent in reached} - reached:
        reached |= grown
    if parents.count(-1) != 1 or len(reached) != len(joints) + 1:
        raise InputError("parents: expected one tree with one root, got a loop or several roots; correct them")
