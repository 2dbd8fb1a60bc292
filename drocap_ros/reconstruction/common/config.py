"""Parameters of the initializer and of the bundle adjuster."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.camera_path import CameraErrors
from drocap_ros.geometry.rotations import ASSUMED_FOCAL
from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class InitializerConfig(Parameters):
    """Single-view initializer; lengths "2D std" are the standard deviation of the centred 2D joints."""

    dictionary: str = param("", "dictionary file; empty for the shipped one")
    search_azimuths: int = param(4, "viewpoints around the body in the viewpoint search", minimum=1, maximum=64)
    search_elevation_deg: float = param(
        15.0, "camera elevation of these viewpoints", unit="deg", minimum=-89.0, maximum=89.0
    )
    search_components: int = param(20, "principal components in the viewpoint search", minimum=1, maximum=45)
    search_iterations: int = param(14, "damped Gauss-Newton steps per viewpoint", minimum=1, maximum=200)
    keypoint_std: float = param(0.1, "standard deviation of an ordinary 2D joint", unit="2D std", minimum=0.001)
    em_rounds: int = param(2, "E-steps over the uncertain 2D joints", minimum=0, maximum=50)
    outlier_share: float = param(
        0.05, "share of gross outliers among the 2D joints that the E-step expects", minimum=1e-6, maximum=0.5
    )
    scale_std: float = param(0.05, "relative change of the body's image size in the sequence", minimum=0.001, maximum=1)
    sparsity: float = param(0.05, "weight of the L1 norm of the coefficients (alpha)", unit="2D std", minimum=0.0)
    sparse_rounds: int = param(6, "alternations of sparse coefficients and rotation", minimum=0, maximum=100)
    sparse_iterations: int = param(12, "accelerated proximal steps per alternation", minimum=1, maximum=500)
    coefficient_smoothness: float = param(0.3, "weight of the change of coefficients over time", minimum=0.0)
    rotation_smoothness: float = param(0.3, "weight of the change of rotation over time", minimum=0.0)
    switch_cost: float = param(1.0, "cost of a jump between hypotheses, per squared 2D std", minimum=0.0)
    lifter: str = param("", "the live node's lifter, an ONNX file; empty for the shipped one")
    past_s: float = param(1.4, "past that the live node gives the lifter", unit="s", minimum=0.1, maximum=10.0)
    late_s: float = param(
        1.0,
        "stamps up to this long before the last one are late and dropped; earlier ones are a jump of time",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    gap_s: float = param(
        1.0,
        "after a longer gap the live node keeps only the person's proportions",
        unit="s",
        minimum=0.05,
        maximum=60.0,
    )
    block_frames: int = param(500, "most frames that are fitted together", minimum=16, maximum=20000)
    assumed_height_m: float = param(
        1.70, "stature that sets the scale when none is known", unit="m", minimum=0.3, maximum=3.0
    )


@dataclass(frozen=True)
class BundleAdjusterConfig(Parameters):
    """Bundle adjustment: the paper's equations (2) to (4), the default method and the live node."""

    lifter: str = param("", "the default method's lifter, an ONNX file; empty for the shipped one")
    limb_iterations_first: int = param(
        2, "steps of the default method that find the bone lengths", minimum=0, maximum=1000
    )
    limb_iterations: int = param(
        12,
        "steps of the default method's final adjustment; both have at most 2 before the adjustment in the world",
        minimum=0,
        maximum=1000,
    )

    alpha: float = param(
        0.1, "weight of the nuclear norm at 240 frames; grows with the root of the length", minimum=0.0
    )
    noise_alpha: float = param(
        0.5,
        "alpha is at least this share of the threshold that hides the 2D joints' noise"
        " (2 sigma (sqrt F + sqrt 2P)); 0 = alpha unchanged",
        minimum=0.0,
    )
    gamma: float = param(1.0, "weight of the articulation term; 0 leaves it out", minimum=0.0)
    iterations: int = param(150, "most proximal steps", minimum=1, maximum=100000)
    rotation_every: int = param(3, "proximal steps per update of the rotations", minimum=1, maximum=1000)
    tolerance: float = param(1e-5, "relative decrease of the cost over 10 steps that ends the solve", minimum=0.0)
    window_s: float = param(12.0, "length of an adjustment window", unit="s", minimum=0.5, maximum=120.0)
    world_window_s: float = param(
        6.0, "length of its newest part that the live node adjusts in the world", unit="s", minimum=2.0, maximum=120.0
    )
    period_s: float = param(1.0, "time between two adjustments of the live node", unit="s", minimum=0.05, maximum=60.0)
    window_frames: int = param(480, "most frames in a window", minimum=8, maximum=5000)
    overlap_frames: int = param(
        30, "frames that neighbouring windows of a long recording share", minimum=0, maximum=2000
    )
    max_solve_s: float = param(
        0.5,
        "an adjustment of the live node ends after the first step that exceeds this time",
        unit="s",
        minimum=0.01,
        maximum=60.0,
    )
    max_stride: int = param(
        4, "most images per image that the live node adjusts while it is late", minimum=1, maximum=16
    )
    blend_s: float = param(
        0.5, "time in which pose3d/latest changes to a new solution", unit="s", minimum=0.0, maximum=10.0
    )
    late_s: float = param(1.0, "as the initializer's", unit="s", minimum=0.0, maximum=60.0)
    gap_s: float = param(
        1.0,
        "after a longer gap the live window keeps only the person's bone lengths and size",
        unit="s",
        minimum=0.05,
        maximum=60.0,
    )
    max_pending: int = param(1000, "most images of the live node without their initial pose", minimum=1, maximum=10000)
    stature_std: float = param(0.05, "relative standard deviation of the assumed stature", minimum=0.001, maximum=1.0)
    telemetry_tilt_deg: float = param(
        0.3, "accuracy (standard deviation) of the camera's pitch and roll", unit="deg", minimum=0.001, maximum=45.0
    )
    telemetry_yaw_deg: float = param(
        2.0, "accuracy of its yaw: gimbals know the horizon, not north", unit="deg", minimum=0.001, maximum=45.0
    )
    telemetry_attitude_deg: float = param(
        0.1, "accuracy of its attitude over seconds", unit="deg", minimum=0.001, maximum=45.0
    )
    telemetry_position_m: float = param(
        0.05, "accuracy of its position over a minute; rough telemetry has less", unit="m", minimum=1e-4, maximum=100.0
    )
    telemetry_latency_s: float = param(
        0.1, "accuracy of the stamps of its attitude and position", unit="s", minimum=1e-4, maximum=2.0
    )
    feet: bool = param(True, "in the world, feet in contact keep their place")
    assumed_focal: float = param(
        ASSUMED_FOCAL,
        "focal length of real pictures without a calibration, share of their longer side: phones' and drones' main"
        " cameras (24 to 28 mm equivalent) crop video to 0.75 to 0.95; 0 = the camera is taken as distant",
        minimum=0.0,
        maximum=20.0,
    )
    threads: int = param(1, "threads of the linear algebra; the matrices are small", minimum=1, maximum=64)

    @property
    def telemetry_errors(self) -> CameraErrors:
        """Errors that are expected of the reported camera."""
        return CameraErrors(
            tilt_deg=self.telemetry_tilt_deg,
            yaw_deg=self.telemetry_yaw_deg,
            latency_s=self.telemetry_latency_s,
            position_wander_m=self.telemetry_position_m,
            attitude_wander_deg=self.telemetry_attitude_deg,
        )
