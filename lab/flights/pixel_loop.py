"""The closed loop in simulated time with rendered images and the real pose estimator."""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.simulation.pinhole import project
from drocap_ros.simulation.render.renderer import Renderer
from lab.flights.orbit_loop import LoopSettings, OrbitLoop


class PixelOrbitLoop(OrbitLoop):
    """An orbit by keypoints of the pose estimator in rendered images; as deterministic as the networks.

    errors : (15,) px per image, distance of the keypoints from the truth; NaN = missed
    heights_px : of the person in each image
    """

    def __init__(self, settings: LoopSettings, estimator: PoseEstimator) -> None:
        super().__init__(settings)
        self.errors: list[np.ndarray] = []
        self.heights_px: list[float] = []
        self._estimator = estimator
        width, height = (round(2 * self.matrix[i, 2] + 1) for i in (0, 1))
        self._renderer = Renderer(self.matrix, width, height, settings.seed)

    def observe(self, joints: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> PoseObservation:
        """Render an image and estimate its keypoints."""
        image = self._renderer.render(joints, rotation, position)
        observation = self._estimator.process(image, self.stamp_ns())
        exact = project(joints[None], rotation[None], position[None], self.matrix)[0]
        seen = observation.keypoints if len(observation.keypoints) else np.full(exact.shape, np.nan)
        self.errors.append(np.linalg.norm(seen - exact, axis=1))
        self.heights_px.append(float(np.ptp(exact[:, 1])))
        return observation
