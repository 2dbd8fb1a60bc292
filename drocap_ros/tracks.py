"""2D tracks of one subject: the input of every reconstruction, and its ``.npz`` file."""

from __future__ import annotations

import logging
import math
import zipfile
import zlib
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FARTHEST_PX, Background, read_background
from drocap_ros.errors import InputError, first_line
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.geometry.rotations import MOST_ASPECT, pixels_are_usual
from drocap_ros.stamps import as_stamps, check_stamps

#: Longest accepted sequence (10 h at 30 fps); longer ones are refused before memory runs out.
MAX_FRAMES = 1_080_000
#: Upper bound on the arrays of such a sequence, optional ones included.
MAX_BYTES = 4 * 2**30
#: Arrays of a file: its kinds have some twenty.
_MOST_ARRAYS = 1000
_NAMED = 5  # of them in a message
#: Keypoints that are all within it are shares of the image, not px.
_NORMALISED = 2.0
#: Share of the picture's size beyond its edge at which networks still place joints of a person who is cut off.
_OUTSIDE = 0.1
#: Scores a little above 1 are usual; COCO's flags end at 2.
_HIGHEST_SCORE = 2.0
#: Focal lengths as shares of the image's width or height: a view of 157 degrees, and of 0.6.
_FOCAL_SHARES = (0.1, 100.0)


@dataclass(frozen=True)
class Tracks:
    """Keypoints of one subject over F images, P joints.

    keypoints : (F, P, 2) float64, px, NaN where not seen
    joints : P joint names
    stamp_ns : (F,) int64, exposure times, strictly increasing
    image_size : (width, height) px
    confidence : (F, P) in [0, 1], or None
    covariance : (F, P, 3) px^2, xx xy yy, or None
    camera_rotation : (F, 3, 3) world (ENU) -> camera (x right, y down, z forward), or None
    camera_position : (F, 3) m ENU, or None
    camera_matrix : (3, 3) px, or None
    background : fixed points of the scene in the images, or None
    evidence, evidence_sigma : (F, P, 3) and (F, P), a 3D estimate of every image in its camera's axes, any unit, and
        its expected error; None
    real_lens : whether pictures of a lens were measured: one may be assumed where ``camera_matrix`` is None
    resting : (F, 2) whether the right and the left foot rest, 1 or 0, as somebody says; NaN where nobody does; None
    vertical : (N, 5) index of an image, lower and upper end px of something vertical in it, or None
    """

    keypoints: np.ndarray
    joints: tuple[str, ...]
    stamp_ns: np.ndarray
    image_size: tuple[int, int]
    confidence: np.ndarray | None = None
    covariance: np.ndarray | None = None
    camera_rotation: np.ndarray | None = None
    camera_position: np.ndarray | None = None
    camera_matrix: np.ndarray | None = None
    background: Background | None = None
    evidence: np.ndarray | None = None
    evidence_sigma: np.ndarray | None = None
    real_lens: bool = False
    resting: np.ndarray | None = None
    vertical: np.ndarray | None = None

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return len(self.keypoints)

    def of_frames(self, use: np.ndarray | slice) -> Tracks:
        """A choice of the frames, at least one: (F,) bool, distinct indices in any order, or a slice."""
        values = {name: getattr(self, name) for name in (*_PER_FRAME, "keypoints", "stamp_ns", "resting")}
        images = np.arange(len(self))[use]
        background = None if self.background is None else self.background.of_frames(images)
        vertical = self.vertical
        if vertical is not None:
            row, image = np.nonzero(vertical[:, :1] == images)
            vertical = np.column_stack([image, vertical[row, 1:]])
        return replace(
            self, background=background, vertical=vertical, **{k: v[use] for k, v in values.items() if v is not None}
        )

    def at_rate(self, rate_hz: float) -> Tracks:
        """The same frames with ``rate_hz`` of them a second, gaps kept: slow motion at its true speed."""
        step_ns = float(np.median(np.diff(self.stamp_ns))) if len(self) > 1 else 1.0
        since = (self.stamp_ns - self.stamp_ns[0]) / step_ns
        return replace(self, stamp_ns=self.stamp_ns[0] + np.round(since * 1e9 / rate_hz).astype(np.int64))


def _check(t: Tracks) -> None:
    k = t.keypoints
    if k.ndim != 3 or k.shape[2] != 2 or k.dtype.kind != "f":
        raise InputError(f"keypoints: expected float (F, P, 2), got {k.dtype} {k.shape}; add or move the axes")
    frames, joints = k.shape[:2]
    if frames == 0:
        raise InputError("keypoints: expected at least 1 frame, got 0")
    if frames > MAX_FRAMES:
        raise InputError(f"keypoints: expected at most {MAX_FRAMES} frames, got {frames}; cut the recording")
    if len(t.joints) != joints:
        raise InputError(f"joints: expected {joints} names, one per keypoint, got {len(t.joints)}")
    if len(set(t.joints)) != joints:
        raise InputError("joints: expected distinct names, got a repeated one; rename it")
    _check_shapes(t)
    if t.stamp_ns.dtype != np.int64:
        raise InputError(f"stamp_ns: expected int64 nanoseconds, got {t.stamp_ns.dtype}")
    check_stamps(t.stamp_ns)
    check_keypoints(k, t.covariance)
    if min(t.image_size) < 1:
        raise InputError(f"image_size: expected positive width and height, got {t.image_size}")
    _check_unit(k, t.image_size)
    _check_telemetry(t)
    if t.background is not None:
        t.background.check_frames(frames)


def _check_unit(keypoints: np.ndarray, image_size: tuple[int, int]) -> None:
    seen = np.abs(keypoints[np.isfinite(keypoints)])
    if seen.any() and seen.max() <= _NORMALISED and min(image_size) > 16 * _NORMALISED:
        width, height = image_size
        raise InputError(
            f"keypoints: expected px of an image of {width}x{height}, got none above {seen.max():g}; multiply"
            " normalised ones by the image's width and height"
        )


def _check_shapes(t: Tracks) -> None:
    frames, joints = t.keypoints.shape[:2]
    shapes = {
        "stamp_ns": (frames,),
        "confidence": (frames, joints),
        "covariance": (frames, joints, 3),
        "camera_rotation": (frames, 3, 3),
        "camera_position": (frames, 3),
        "camera_matrix": (3, 3),
        "evidence": (frames, joints, 3),
        "evidence_sigma": (frames, joints),
    }
    for name, shape in shapes.items():
        value = getattr(t, name)
        if value is not None and value.shape != shape:
            raise InputError(f"{name}: expected shape {shape}, got {value.shape} beside keypoints {t.keypoints.shape}")


def _check_telemetry(t: Tracks) -> None:
    if t.camera_rotation is not None:
        r = t.camera_rotation
        off = np.abs(r @ np.swapaxes(r, 1, 2) - np.eye(3)).max() if np.isfinite(r).all() else np.inf
        if off > 1e-3 or np.any(np.linalg.det(r) < 0):
            raise InputError("camera_rotation: expected rotation matrices (orthonormal, determinant 1), got others")
    if t.camera_position is not None and not np.isfinite(t.camera_position).all():
        raise InputError("camera_position: expected finite metres, got NaN or infinity; fill the gaps in")
    if t.camera_matrix is not None:
        check_camera_matrix(t.camera_matrix, t.image_size)


def check_keypoints(keypoints: np.ndarray, covariance: np.ndarray | None) -> None:
    """Refuse keypoints (..., 2) px and covariances (..., 3) px^2 that no image has."""
    if np.isinf(keypoints).any():
        raise InputError("keypoints: expected finite px or NaN where not seen, got infinity; use NaN")
    for name, unit, values, most in (
        ("keypoints", "px", keypoints, FARTHEST_PX),
        ("covariance", "px^2", covariance, FARTHEST_PX**2),
    ):
        large = np.empty(0) if values is None else np.abs(values[np.isfinite(values) & (np.abs(values) > most)])
        if large.size:
            raise InputError(f"{name}: expected at most {most:g} {unit}, got {large.max():g}; use NaN where not seen")


def check_camera_matrix(matrix: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse a matrix (3, 3) that is none of a camera with images of ``size`` (width, height) px."""
    if not np.isfinite(matrix).all() or not np.allclose(matrix[2], (0.0, 0.0, 1.0)):
        raise InputError("camera_matrix: expected finite values and the last row 0 0 1, got others; correct it")
    for i, (axis, length) in enumerate(zip(("width", "height"), size, strict=True)):
        low, high = (share * length for share in _FOCAL_SHARES)
        if not low <= matrix[i, i] <= high:
            raise InputError(
                f"camera_matrix: expected focal lengths in px, between {low:g} and {high:g} for an image {axis} of"
                f" {length}, got {matrix[i, i]:g}; multiply normalised ones by the image size"
            )
    if not pixels_are_usual(matrix):
        raise InputError(
            f"camera_matrix: expected focal lengths of which one is at most {MOST_ASPECT:g} times the other, got"
            f" {matrix[0, 0]:g} and {matrix[1, 1]:g}; correct it"
        )


_REQUIRED = ("keypoints", "joints", "stamp_ns", "image_size")
#: Array ``lens`` of a file: whether ``camera_matrix`` is the lens, or one may be assumed; without it nothing is known.
_LENSES = (_ASSUMED, _GIVEN) = ("assumed", "given")
_PER_FRAME = ("confidence", "covariance", "camera_rotation", "camera_position", "evidence", "evidence_sigma")
_OPTIONAL = (*_PER_FRAME, "camera_matrix")


def kind_of(arrays: Collection[str]) -> str:
    """Kind by the names of a file's arrays: "motion", "tracks", "MoCap", else empty."""
    kinds = {"motion": {"joints3d"}, "tracks": {"keypoints", "image_size"}, "MoCap": {"X", "fps"}}
    return next((kind for kind, names in kinds.items() if names <= set(arrays)), "")


#: Kind of a file -> its name in a sentence, and the use of a file of that kind.
_USES = {
    "motion": ("a motion", "`drocap report`, `export` and `evaluate compare` take it"),
    "tracks": ("2D tracks", "`drocap reconstruct {path}` makes a motion of them"),
    "MoCap": ("MoCap", "`drocap evaluate compare MOTION {path}` takes it as the truth"),
}


def wrong_kind(path: Path, arrays: Collection[str], expected: str) -> InputError:
    """The refusal of a file of another kind; it names the use of that file."""
    found, use = _USES.get(kind_of(arrays), ("another archive", "check the path"))
    return InputError(f"{path}: expected {expected}, found {found}; {use.format(path=path)}")


def read_npz(path: Path, required: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Arrays of an ``.npz`` file (never pickles)."""
    arrays = _load(path)
    missing = [name for name in required if name not in arrays]
    if missing:
        kind, wanted = kind_of(arrays), kind_of(required)
        if kind and wanted and kind != wanted:
            raise wrong_kind(path, arrays, _USES[wanted][0])
        if len(missing) == len(required):
            there = ", ".join(list(arrays)[:_NAMED]) or "none"
            wanted = _USES[kind_of(required)][0] if kind_of(required) else f"arrays as {', '.join(required[:_NAMED])}"
            raise InputError(f"{path}: expected {wanted}, found an archive of other arrays ({there}); check the file")
        raise InputError(f"{path}: expected the arrays {', '.join(required)}; missing {', '.join(missing)}")
    return arrays


def _load(path: Path) -> dict[str, np.ndarray]:
    _check_kind(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            entries = archive.zip.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > MAX_BYTES:
                raise InputError(f"{path}: expected at most {MAX_BYTES} bytes of arrays, got {size}; cut the recording")
            if len(entries) > _MOST_ARRAYS:
                raise InputError(f"{path}: expected at most {_MOST_ARRAYS} arrays, got {len(entries)}; check the file")
            for entry in entries:
                _check_declared(archive.zip, entry)
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, KeyError, NotImplementedError) as error:
        raise InputError(f"{path}: expected a readable .npz archive; {_reason(error)}") from None


def _check_declared(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Refuse an array whose head declares more values than its entry holds: they would take memory first."""
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)  # type: ignore[no-untyped-call]  # NumPy has no types here
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)  # type: ignore[no-untyped-call]  # NumPy has no types here
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        name, has = entry.filename.removesuffix(".npy"), entry.file_size
        raise ValueError(f"array {name} declares {math.prod(shape)} values and has {has} bytes; write it again")


def _check_kind(path: Path) -> None:
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: expected a readable .npz archive, found a pipe or device; name a file")
    if path.is_file() and not zipfile.is_zipfile(path):
        kind = file_kind(path)
        found = "a damaged one" if kind in (FileKind.ARRAYS, FileKind.OTHER) else kind.value
        raise InputError(f"{path}: expected a readable .npz archive, found {found}; check the file")


def _reason(error: Exception) -> str:
    reason = first_line(error)
    if reason.startswith("Object arrays"):
        reason = "found arrays of Python objects; save names as text: np.array(names, dtype=str)"
        reason += ", of VideoPose3D one video: np.save('walk.npy', data['positions_2d'].item()[VIDEO]['custom'][0])"
    return reason


def load_tracks(path: str | Path) -> Tracks:
    """Read a tracks ``.npz``; every array is checked and the error names the file."""
    path = Path(path)
    arrays = read_npz(path, _REQUIRED)
    try:
        size = _checked_size(arrays["image_size"])
        more = {name: _as_float(arrays[name], name) for name in _OPTIONAL if name in arrays}
        xy = _as_float(arrays["keypoints"], "keypoints")
        if xy.ndim == 3 and xy.shape[2] == 3:  # x, y, score
            _check_scores(xy[..., 2])
            more.setdefault("confidence", np.clip(np.nan_to_num(xy[..., 2]), 0.0, 1.0))
            xy = xy[..., :2]
        return Tracks(
            keypoints=without_unseen(path, xy, size) if xy.ndim == 3 and "covariance" not in more else xy,
            joints=tuple(np.atleast_1d(arrays["joints"]).astype(str).tolist()),  # bytes, too
            stamp_ns=as_stamps(arrays["stamp_ns"]),
            image_size=(int(size[0]), int(size[1])),
            background=read_background(arrays),
            real_lens=_names_lens(arrays.get("lens")),
            **more,
        )
    except (InputError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None


def _check_scores(scores: np.ndarray) -> None:
    low, high = np.nanmin(scores, initial=0.0), np.nanmax(scores, initial=0.0)
    if low < 0 or high > _HIGHEST_SCORE:
        raise InputError(
            f"keypoints: expected x, y px and a score from 0 to 1, found {low:g} to {high:g} in the third column, as of"
            " 3D poses; give the 2D keypoints of the pictures"
        )


def without_unseen(path: Path, xy: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Keypoints (F, P, 2) with NaN for zeros, pairs below zero and places far outside, as other tools mark them."""
    outside = (xy < -_OUTSIDE * size) | (xy > (1 + _OUTSIDE) * size)
    unseen = np.asarray((xy <= 0).all(axis=2)) | outside.any(axis=2)
    if not unseen.any() or unseen.all():
        return xy
    placed = np.isfinite(xy).all(axis=2) & (xy != 0).any(axis=2) & (xy != -1).any(axis=2)
    share = (outside & placed[..., None]).sum(axis=(0, 1)) / max(placed.sum(), 1)
    # Share of keypoints outside the picture along each axis from which they are none of it, as 3D poses about the hips:
    # a person who is cut off is so at one side.
    if share.min() > 0.2:
        raise InputError(
            f"keypoints: expected px of an image of {size[0]}x{size[1]}, found {share.min():.0%} of them outside along"
            " each axis; convert them, from its upper left corner"
        )
    logging.getLogger(__name__).warning("%s: %d keypoints at (0, 0) or outside are not seen", path, unseen.sum())
    return np.where(unseen[..., None], np.nan, xy)


def _checked_size(size: np.ndarray) -> np.ndarray:
    if size.shape != (2,) or size.dtype.kind not in "iuf" or not np.isfinite(size).all():
        raise InputError(f"image_size: expected positive width and height, two numbers, got {size.tolist()}")
    return size


def _names_lens(word: np.ndarray | None) -> bool:
    if word is None:
        return False
    if word.size != 1 or str(word.astype(str).item()) not in _LENSES:
        raise InputError(f"lens: expected {' or '.join(map(repr, _LENSES))}, got {word.tolist()!r}; or leave it out")
    return True


def _as_float(array: np.ndarray, name: str) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected numbers, got {array.dtype}")
    return array.astype(np.float64)


def save_tracks(path: str | Path, tracks: Tracks, changes: Collection[tuple[int, str]] = ()) -> None:
    """Write a tracks ``.npz``; ``changes`` are stamps (ns) at which the person may be another one, and words."""
    arrays = {name: getattr(tracks, name) for name in _OPTIONAL if getattr(tracks, name) is not None}
    if tracks.background is not None:
        arrays |= tracks.background.arrays()
    if changes:
        arrays["change_ns"], arrays["change"] = (np.array(column) for column in zip(*changes, strict=True))
    if tracks.real_lens:
        arrays["lens"] = np.array(_ASSUMED if tracks.camera_matrix is None else _GIVEN)
    np.savez_compressed(
        path,
        keypoints=tracks.keypoints,
        joints=np.array(tracks.joints),
        stamp_ns=tracks.stamp_ns,
        image_size=np.array(tracks.image_size),
        **arrays,
    )


def change_lines(changes: Collection[tuple[int, str]], begin_ns: int) -> list[str]:
    """A line about each change of :func:`save_tracks`, with seconds since the first image."""
    return [f"{(stamp_ns - begin_ns) * 1e-9:.1f} s: {words}" for stamp_ns, words in changes]
