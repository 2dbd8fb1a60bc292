"""A camera: pinhole and lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drocap_ros.background import FARTHEST_PX, Background
from drocap_ros.keypoints import PoseObservation

#: Names of lens distortions that ``sensor_msgs/CameraInfo`` knows (``distortion_models.hpp`` of sensor_msgs).
LENS_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_COEFFICIENTS = (4, 5, 8, 12, 14)  # numbers of them that OpenCV takes; of a fisheye the first


def coefficients_of(lens: str) -> tuple[int, ...]:
    """How many coefficients a model of ``LENS_MODELS`` may have."""
    return _COEFFICIENTS[:1] if lens == "equidistant" else _COEFFICIENTS


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

    @property
    def size(self) -> tuple[int, int]:
        """Width and height px."""
        return self.width, self.height

    def equals(self, other: CameraModel) -> bool:
        """Whether it is the same lens at the same size."""
        mine, theirs = ((c.size, c.distortion_model, *c.matrix.flat, *c.distortion) for c in (self, other))
        return mine == theirs

    def has_aspect_of(self, size: tuple[int, int]) -> bool:
        """Whether images of ``size`` (width, height) px have the calibration's aspect ratio, to 2 %."""
        return abs(self.width * size[1] - self.height * size[0]) <= 0.02 * self.width * size[1]

    def undistorted(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 2) px as a lens without distortion shows them; NaN stays, and is where none would."""
        import cv2

        seen, flat = np.isfinite(points).all(axis=1), np.full(points.shape, np.nan)
        if seen.any():
            undo = cv2.fisheye.undistortPoints if self.distortion_model == "equidistant" else cv2.undistortPoints
            given = points[seen].astype(np.float64)[:, None]
            flat[seen] = undo(given, self.matrix, self.distortion, P=self.matrix)[:, 0]
            flat[~(np.abs(flat) < FARTHEST_PX).all(axis=1)] = np.nan  # a fisheye's side, of which OpenCV finds nothing
        return flat

    def flat(self, observation: PoseObservation) -> PoseObservation:
        """The keypoints of an image as a lens without distortion shows them, float64 then; its box stays."""
        if not (self.distortion.any() and observation.has_subject):
            return observation
        return replace(observation, keypoints=self.undistorted(observation.keypoints))

    def flat_points(self, background: Background | None) -> Background | None:
        """Fixed points as a lens without distortion shows them."""
        if background is None or not self.distortion.any():
            return background
        point = self.undistorted(background.point).astype(background.point.dtype)
        kept = np.isfinite(point).all(axis=1)
        return Background(background.frame[kept], background.track[kept], point[kept])

    def yaml(self, name: str) -> str:
        """Text of a file as ROS's ``camera_calibration`` writes it."""
        import yaml

        def table(rows: int, columns: int, values: np.ndarray) -> dict[str, object]:
            return {"rows": rows, "cols": columns, "data": [round(float(v), 8) for v in values.ravel()]}

        projection = np.column_stack([self.matrix, np.zeros(3)])
        content = {
            "image_width": self.width,
            "image_height": self.height,
            "camera_name": name,
            "camera_matrix": table(3, 3, self.matrix),
            "distortion_model": self.distortion_model,
            "distortion_coefficients": table(1, len(self.distortion), self.distortion),
            "rectification_matrix": table(3, 3, np.eye(3)),
            "projection_matrix": table(3, 4, projection),
        }
        return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    def resized(self, width: int, height: int) -> CameraModel:
        """The same lens at another image size."""
        scale = np.array([width / self.width, height / self.height, 1.0])
        return CameraModel(width, height, self.matrix * scale[:, None], self.distortion, self.distortion_model)
