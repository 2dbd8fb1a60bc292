"""Camera model from a calibration file or a configured field of view."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.geometry.lens import LENS_MODELS, CameraModel, coefficients_of
from drocap_ros.geometry.rotations import centred_camera
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.tracks import Tracks, check_camera_matrix


def camera_model(config: ImageIngestConfig, size: tuple[int, int]) -> CameraModel | None:
    """Camera of a source with images of ``size`` (width, height); None when it is unknown."""
    if config.calibration_file:
        model = load_calibration(Path(config.calibration_file))
        if not model.has_aspect_of(size):
            raise InputError(
                f"{config.calibration_file}: expected the aspect ratio of {size[0]}x{size[1]}, found"
                f" {model.width}x{model.height}; calibrate with images of this camera mode"
            )
        return model.resized(*size)
    focal = config.focal_px
    if config.horizontal_fov_deg > 0:
        focal = 0.5 * size[0] / np.tan(np.deg2rad(0.5 * config.horizontal_fov_deg))
    if focal > 0:
        return CameraModel(*size, centred_camera(size, focal))
    return None


#: Where the formats keep a camera: ROS's ``camera_calibration``, OpenCV's samples, a table of Pose2Sim's TOML, whose
#: ``size`` is width and height.
_NAMES = {
    "matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "matrix"),
    "distortion": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "distortions"),
    "width": ("image_width", "image_Width", "width"),
    "height": ("image_height", "image_Height", "height"),
}


def load_calibration(path: Path) -> CameraModel:
    """Read a YAML of ROS's ``camera_calibration`` or of OpenCV, or a TOML of Pose2Sim.

    path : of the file; of a TOML with several cameras ``FILE#NAME``
    """
    name = path.name.rpartition("#")[2] if "#" in path.name and not path.exists() else ""
    file = path.with_name(path.name.rpartition("#")[0]) if name else path
    try:
        data = _camera_table(file, file.read_text(encoding="utf-8"), name)
        found: dict[str, Any] = {
            kind: next((data[key] for key in keys if key in data), None) for kind, keys in _NAMES.items()
        }
        width, height = data["size"] if "size" in data else (found["width"], found["height"])
        matrix = _numbers(found["matrix"]).reshape(3, 3)
        distortion = _numbers([] if found["distortion"] is None else found["distortion"])
        lens = "equidistant" if data.get("fisheye") else str(data.get("distortion_model", "plumb_bob"))
        model = CameraModel(int(width), int(height), matrix, distortion, lens)
    except OSError as error:
        raise InputError(f"{path}: expected a calibration file; {error.strerror or error}") from None
    except (UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: expected image_width, image_height, camera_matrix as camera_calibration or OpenCV write them, or"
            f" a camera of Pose2Sim's TOML; found a problem with {first_line(error)}"
        ) from None
    if lens not in LENS_MODELS:
        raise InputError(
            f"{path}: distortion_model: expected one of {', '.join(LENS_MODELS)}, found {lens!r}; correct it"
        )
    if min(model.width, model.height) < 1:
        raise InputError(f"{path}: expected a positive image size, found {model.width}x{model.height}; correct it")
    if not np.isfinite(distortion).all() or len(distortion) not in (0, *coefficients_of(lens)):
        counts = " or ".join(map(str, coefficients_of(lens)))
        raise InputError(f"{path}: expected {counts} finite distortion coefficients of {lens}, found {distortion}")
    try:
        check_camera_matrix(matrix, (model.width, model.height))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return model


def _camera_table(path: Path, text: str, name: str) -> dict[str, Any]:
    """The one camera of a file; raises ValueError where it is none."""
    import yaml

    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    if path.suffix.lower() != ".toml":
        # OpenCV's header is no YAML of today, and its tag is one of its own.
        try:
            data = yaml.safe_load(re.sub(r"%YAML:.*|!!opencv-matrix", "", text))
        except yaml.YAMLError as error:
            raise ValueError(error) from None
        return dict(data)
    tables = {key: value for key, value in tomllib.loads(text).items() if isinstance(value, dict) and "matrix" in value}
    if name in tables or (not name and len(tables) == 1):
        return dict(tables[name] if name else next(iter(tables.values())))
    raise InputError(f"{path}: expected one camera, found {', '.join(tables) or 'none'}; name it: {path.name}#NAME")


def _numbers(value: Any) -> np.ndarray:
    return np.array(value["data"] if isinstance(value, dict) else value, float).ravel()


def with_lens_of(tracks: Tracks, config: ImageIngestConfig) -> Tracks:
    """Tracks whose lens nothing told, with the configured one; its distortion is taken off keypoints and points."""
    if tracks.camera_matrix is not None or (camera := camera_model(config, tracks.image_size)) is None:
        return tracks
    return through_lens(tracks, camera)


def through_lens(tracks: Tracks, camera: CameraModel) -> Tracks:
    """Tracks with a lens, whose distortion is taken off keypoints and points."""
    if camera.distortion.any():
        flat = camera.undistorted(tracks.keypoints.reshape(-1, 2)).reshape(tracks.keypoints.shape)
        tracks = replace(tracks, keypoints=flat, background=camera.flat_points(tracks.background))
    return replace(tracks, camera_matrix=camera.matrix)
