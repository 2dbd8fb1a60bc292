"""Study of a camera's turns without telemetry: ours against COLMAP's (``pip install pycolmap``) on the same frames."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cv2
import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.open_images import open_images
from drocap_ros.pipeline import read_input
from drocap_ros.reconstruction.camera.picture_world import picture_camera

#: Features of an image: COLMAP's own default of 8192 takes 16 times as long to match.
_FEATURES = 2000
#: Images behind each one that are matched with it: a second of the slowest clip.
_OVERLAP = 10
#: Time (s) over which turns are compared.
_LAG_S = 1.0


class CameraRow(NamedTuple):
    """One clip: what both say of its camera.

    kind, residual_px : ours
    ours, colmap : shares of the frames with a camera
    focal_px, colmap_focal_px : focal lengths
    pairs : frames a second apart that both know
    rms_deg, median_deg : difference of the turns between these; turn_deg : RMS of the turns themselves
    """

    clip: str
    frames: int
    kind: str
    residual_px: float
    ours: float
    colmap: float
    focal_px: float
    colmap_focal_px: float
    pairs: int
    rms_deg: float
    median_deg: float
    turn_deg: float


class _Path(NamedTuple):
    """Rotations (F, 3, 3) world -> camera, NaN where unknown, and the focal length in px."""

    rotation: np.ndarray
    focal_px: float


def colmap_study(clips: list[Path], models: Path) -> list[CameraRow]:
    """Each clip by both.

    Raises
    ------
    InputError
        When COLMAP's Python package is missing, or a clip shows nobody.
    """
    rows, config = [], DrocapConfig()
    for clip in clips:
        theirs = _colmap(clip)
        tracks, _ = read_input(clip, config, models)
        camera = picture_camera(CameraPath(tracks.stamp_ns), tracks.background, tracks.image_size)
        assert camera is not None, clip
        assert camera.picture is not None
        assert camera.matrix is not None
        facts, (rotation, _) = camera.picture, camera.pose
        assert len(tracks) == len(theirs.rotation), clip
        lag = round(_LAG_S * 1e9 / float(np.median(np.diff(tracks.stamp_ns))))
        turned = rotation[lag:] @ rotation[:-lag].swapaxes(1, 2)
        other = theirs.rotation[lag:] @ theirs.rotation[:-lag].swapaxes(1, 2)
        both = np.isfinite(other).all(axis=(1, 2))
        off = _degrees(turned[both] @ other[both].swapaxes(1, 2))
        rows.append(
            CameraRow(
                clip.stem,
                len(tracks),
                facts.kind.name.lower(),
                facts.residual_px,
                facts.covered if facts.kind.known else 0.0,
                float(np.isfinite(theirs.rotation[:, 0, 0]).mean()),
                float(camera.matrix[0, 0]),
                theirs.focal_px,
                len(off),
                _rms(off),
                float(np.median(off)) if len(off) else float("nan"),
                _rms(_degrees(turned[both])),
            )
        )
    return rows


def colmap_markdown(rows: list[CameraRow]) -> str:
    """A table with a row per clip."""
    head = (
        "clip", "frames", "camera", "points off, px", "with a camera, %", "COLMAP, %", "focal length, px", "COLMAP, px",
        "turn, RMS deg", "difference, RMS deg", "median deg",
    )  # fmt: skip
    lines = ["Turns within a second, of frames that both know; no lens is given, no telemetry.", ""]
    lines += [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    lines += [
        f"| {row.clip} | {row.frames} | {row.kind} | {row.residual_px:.2f} | {100 * row.ours:.0f} |"
        f" {100 * row.colmap:.0f} | {row.focal_px:.0f} | {row.colmap_focal_px:.0f} | {row.turn_deg:.1f} |"
        f" {row.rms_deg:.2f} | {row.median_deg:.2f} |"
        for row in rows
    ]
    return "\n".join(lines)


def _colmap(clip: Path) -> _Path:
    """The largest model of COLMAP's incremental mapping: one camera of unknown focal length and radial distortion."""
    try:
        import pycolmap
    except ImportError:
        raise InputError("pycolmap: expected COLMAP's Python package, found none; pip install pycolmap") from None
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        with open_images(clip) as images:
            for frames, frame in enumerate(images.frames, 1):
                cv2.imwrite(str(folder / "images" / f"{frames - 1:06d}.png"), frame.image)
        pycolmap.set_random_seed(0)
        found = pycolmap.FeatureExtractionOptions()
        found.sift.max_num_features = _FEATURES
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        database, pictures = folder / "points.db", folder / "images"
        one = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, pictures, camera_mode=one, reader_options=reader, extraction_options=found)
        pairs = pycolmap.SequentialPairingOptions(overlap=_OVERLAP, quadratic_overlap=False)
        pycolmap.match_sequential(database, pairing_options=pairs)
        models = pycolmap.incremental_mapping(database, pictures, folder)
        rotation, focal = np.full((frames, 3, 3), np.nan), float("nan")
        if models:
            model = max(models.values(), key=lambda one: one.num_reg_images())
            focal = next(iter(model.cameras.values())).params[0]
            for image in model.images.values():
                if image.has_pose:
                    rotation[int(Path(image.name).stem)] = image.cam_from_world().rotation.matrix()
    return _Path(rotation, float(focal))


def _degrees(rotation: np.ndarray) -> np.ndarray:
    """(N,) angles of rotations (N, 3, 3)."""
    return np.asarray(np.degrees(np.linalg.norm(log_so3(rotation), axis=1)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean())) if len(values) else float("nan")
