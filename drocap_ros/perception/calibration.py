"""Camera model from a calibration file or a configured field of view."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.geometry.rotations import centred_camera
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.tracks import check_camera_matrix

#: Names of lens distortions that ``sensor_msgs/CameraInfo`` knows (``distortion_models.hpp`` of sensor_msgs).
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")


@dataclass(frozen=True)
class CameraModel:
    """Pinhole camera with lens distortion, as in ``sensor_msgs/CameraInfo``.

    width, height : px
    matrix : (3, 3) px
    distortion : coefficients of the named model, empty for an ideal lens
    """

    width: int
    height: int
    matrix: np.ndarray
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    distortion_model: str = "plumb_bob"

    def has_aspect_of(self, size: tuple[int, int]) -> bool:
        """Whether images of ``size`` (width, height) px have the calibration's aspect ratio, to 2 %."""
        return abs(self.width * size[1] - self.height * size[0]) <= 0.02 * self.width * size[1]

    def resized(self, width: int, height: int) -> CameraModel:
        """The same lens at another image size."""
        scale = np.array([width / self.width, height / self.height, 1.0])
        return CameraModel(width, height, self.matrix * scale[:, None], self.distortion, self.distortion_model)


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
    if config.horizontal_fov_deg > 0:
        focal = 0.5 * size[0] / np.tan(np.deg2rad(0.5 * config.horizontal_fov_deg))
        return CameraModel(*size, centred_camera(size, focal))
    return None


def load_calibration(path: Path) -> CameraModel:
    """Read the YAML of ROS's ``camera_calibration``."""
    import yaml

    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        matrix = np.array(data["camera_matrix"]["data"], float).reshape(3, 3)
        distortion = np.array(data.get("distortion_coefficients", {}).get("data", []), float).ravel()
        lens = str(data.get("distortion_model", "plumb_bob"))
        model = CameraModel(int(data["image_width"]), int(data["image_height"]), matrix, distortion, lens)
    except OSError as error:
        raise InputError(f"{path}: expected a calibration file; {error.strerror or error}") from None
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: expected image_width, image_height, camera_matrix as camera_calibration writes them;"
            f" found a problem with {first_line(error)}"
        ) from None
    if lens not in _MODELS:
        raise InputError(f"{path}: distortion_model: expected one of {', '.join(_MODELS)}, found {lens!r}; correct it")
    if min(model.width, model.height) < 1:
        raise InputError(f"{path}: expected a positive image size, found {model.width}x{model.height}; correct it")
    try:
        check_camera_matrix(matrix, (model.width, model.height))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return model
