"""Rendered images of a person, for the shipped simulation networks."""

from __future__ import annotations

import numpy as np

from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.render.body import dress
from drocap_ros.simulation.render.renderer import draw
from drocap_ros.simulation.render.scenery import make_scenery
from drocap_ros.simulation.simulated_person import simulate_person
from lab.simulation.orbit import orbit_camera


def rendered_images(count: int, rate_hz: float = 30.0, seed: int = 0) -> list[np.ndarray]:
    """``count`` images (720, 1280, 3) uint8 BGR from a slow orbit at 6 m."""
    matrix = pinhole_matrix(1280, 720, 60)
    t = 0.7 + np.arange(count) / rate_hz
    joints = simulate_person(t, "mixed", seed)
    rotation, position = orbit_camera(
        t, np.tile([0, 0, 0.9], (count, 1)) + joints[:, 0] * [1, 1, 0], 6.0, 2.5, 25.0, 0.0
    )
    scenery, look = make_scenery(seed), dress(seed)
    return [draw(scenery, look, matrix, (1280, 720), joints[i], rotation[i], position[i])[0] for i in range(count)]
