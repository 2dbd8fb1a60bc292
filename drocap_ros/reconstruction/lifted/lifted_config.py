"""Parameters of the default method."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig


@dataclass(frozen=True)
class LiftedConfig(Parameters):
    """Weights of the default method; "mm" are those of a person of ordinary size."""

    lifter: str = param("", "lifter's ONNX file; empty for the shipped one")
    first_iterations: int = param(3, "steps that find the bone lengths", minimum=0, maximum=1000)
    iterations: int = param(12, "steps of the final adjustment", minimum=0, maximum=1000)
    noise_mm: float = param(2.0, "least standard deviation of a 2D joint", unit="mm", minimum=0.01, maximum=100.0)
    depth_weight: float = param(0.2, "weight of the lifter's depth", minimum=0.0, maximum=100.0)
    image_weight: float = param(1.0, "weight of the lifter's image position", minimum=0.0, maximum=100.0)
    acceleration_std_m_s2: float = param(16.0, "ordinary acceleration", unit="m/s^2", minimum=0.01, maximum=1000.0)
    smoothing_std_m_s2: float = param(
        10.0, "ordinary acceleration in the image for the outlier check", unit="m/s^2", minimum=0.01, maximum=1000.0
    )
    zoom_std_per_s: float = param(
        0.006, "relative change of the person's size in the image per second", minimum=1e-6, maximum=1.0
    )
    sign_speed_m_s: float = param(
        1.44, "speed of a bone's end in depth that costs one sigma", unit="m/s", minimum=0.01, maximum=100.0
    )
    sign_acceleration_m_s2: float = param(
        14.4, "its acceleration that costs one sigma", unit="m/s^2", minimum=0.01, maximum=1000.0
    )
    fresh_from: float = param(
        0.47, "share of fresh noise from which the lifter's image position loses weight", minimum=0.0, maximum=1.0
    )
    fresh_to: float = param(
        0.6, "share up to which it does: smoothing removes fresh noise better", minimum=0.0, maximum=1.0
    )
    fresh_weight: float = param(
        0.1, "weight of the lifter's image position of a seen joint then", minimum=0.0, maximum=1.0
    )
    outlier_square: float = param(
        9.0, "squared residual, in standard deviations, that halves a 2D joint's weight", minimum=0.1, maximum=1000.0
    )
    fresh_outlier_square: float = param(
        20.0, "the same where noise is fresh: noise that lasts looks like outliers", minimum=0.1, maximum=1000.0
    )
    lasting_factor: float = param(
        1.6, "most standard deviation of keypoints over that of their fresh noise", minimum=1.0, maximum=10.0
    )
    held_noise_mm: float = param(
        10.0, "lasting noise at which known bone lengths change little", unit="mm", minimum=0.1, maximum=1000.0
    )
    lengthening_noise_mm: float = param(
        5.0, "lasting noise at which the lifter's bone lengths count as much", unit="mm", minimum=0.1, maximum=1000.0
    )
    alone_stds: float = param(
        4.0, "distance of a keypoint alone in its frame that hides it", minimum=0.0, maximum=100.0
    )
    alone_mm: float = param(40.0, "added to that distance", unit="mm", minimum=0.0, maximum=1000.0)
    alone_frames: int = param(5, "frames over which its distance is compared", minimum=1, maximum=99)


def lifted_config(adjuster: BundleAdjusterConfig) -> LiftedConfig:
    """The parameters that the bundle adjuster's section sets; the weights keep their defaults."""
    return LiftedConfig(
        lifter=adjuster.lifter, first_iterations=adjuster.limb_iterations_first, iterations=adjuster.limb_iterations
    )
