"""Parameters of a simulated capture flight."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param
from drocap_ros.simulation.simulated_person import ACTIONS


@dataclass(frozen=True)
class SimulationConfig(Parameters):
    """Person, orbit, camera and observation quality of a simulated capture."""

    action: str = param("mixed", "motion of the person", choices=ACTIONS)
    stature_m: float = param(1.75, "height of the person", unit="m", minimum=0.5, maximum=2.5)
    radius_m: float = param(6.0, "horizontal distance of the camera from the person", unit="m", minimum=2.0, maximum=50)
    height_m: float = param(2.5, "height of the camera above the ground", unit="m", minimum=0.2, maximum=50)
    angular_speed_deg_s: float = param(
        25.0, "angular speed of the orbit, counter-clockwise from above", unit="deg/s", minimum=-90, maximum=90
    )
    image_width: int = param(1280, "width of the images", unit="px", minimum=64, maximum=8192)
    image_height: int = param(720, "height of the images", unit="px", minimum=64, maximum=8192)
    horizontal_fov_deg: float = param(60.0, "horizontal field of view", unit="deg", minimum=5, maximum=150)
    noise_scale: float = param(1.0, "keypoint noise, 1 = a good detector, 0 = none", minimum=0, maximum=10)
    outlier_fraction: float = param(0.03, "share of grossly wrong keypoints", minimum=0, maximum=0.5)
    missed_fraction: float = param(0.015, "share of missed keypoints", minimum=0, maximum=0.5)
    attitude_error_deg: float = param(0.5, "slow error of the camera telemetry", unit="deg", minimum=0, maximum=20)
    position_error_m: float = param(0.2, "slow error of the position telemetry", unit="m", minimum=0, maximum=20)
    seconds: float = param(20.0, "length of the simulated flight", unit="s", minimum=0.1, maximum=36000)
    rate_hz: float = param(30.0, "images per second", unit="Hz", minimum=1, maximum=240)
    seed: int = param(0, "seed of person, take and noise", minimum=0)
