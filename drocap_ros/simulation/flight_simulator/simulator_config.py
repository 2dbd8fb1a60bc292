"""Parameters of the flight simulator."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.flight.autopilot import AUTOPILOTS
from drocap_ros.parameters import Parameters, param
from drocap_ros.simulation.simulated_person import ACTIONS
from drocap_ros.simulation.vehicle.mount import MOUNT_TYPES


@dataclass(frozen=True)
class FlightSimulatorConfig(Parameters):
    """Vehicle, person and camera of the flight simulator."""

    vehicle_url: str = param("udpout:127.0.0.1:14540", "MAVLink URL of the simulated vehicle")
    autopilot: str = param("ardupilot", "MAVLink dialect of the vehicle", choices=tuple(AUTOPILOTS))
    seed: int = param(0, "seed of person, take, wind, sensor errors and scenery", minimum=0)
    action: str = param("mixed", "motion of the person while setpoints steer the vehicle", choices=ACTIONS)
    stature_m: float = param(1.75, "height of the person", unit="m", minimum=0.5, maximum=2.5)
    wind_m_s: float = param(3.0, "mean wind from the west; gusts are added", unit="m/s", minimum=0, maximum=15)
    start_distance_m: float = param(
        7.0, "horizontal distance between person and take-off", unit="m", minimum=2, maximum=50
    )
    takeoff_height_m: float = param(3.0, "height of the hand-over by the pilot", unit="m", minimum=1.5, maximum=50)
    mount: str = param("gimbal", "mount of the camera", choices=tuple(sorted(MOUNT_TYPES)))
    camera_pitch_deg: float = param(
        -11.0, "pitch of a fixed camera against the body, negative = down", unit="deg", minimum=-90, maximum=90
    )
    image_width: int = param(1280, "width of the images", unit="px", minimum=64, maximum=8192)
    image_height: int = param(720, "height of the images", unit="px", minimum=64, maximum=8192)
    horizontal_fov_deg: float = param(60.0, "horizontal field of view", unit="deg", minimum=5, maximum=150)
    rate_hz: float = param(15.0, "images per second", unit="Hz", minimum=1, maximum=120)
    latency_s: float = param(
        0.1,
        "in simulated time, from exposure to publication: stands for camera, transmission and perception",
        unit="s",
        minimum=0,
        maximum=2,
    )
    jpeg_quality: int = param(85, "quality of the published JPEG", minimum=1, maximum=100)
    truth_file: str = param("", "npz for the truth, written at the end as a motion file; empty = none")
