"""Weights of the default method."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.reconstruction.common.config import BundleAdjusterConfig


@dataclass(frozen=True)
class LiftedConfig:
    """Weights of the default method, fitted on MoCap; "mm" are those of a person of ordinary size.

    lifter : ONNX file; empty for the shipped one
    first_iterations, iterations : steps that find the bone lengths, and those of the final adjustment
    noise_mm : least standard deviation of a 2D joint
    depth_weight, image_weight : weights of the lifter's depth and of its image position
    acceleration_std_m_s2, smoothing_std_m_s2 : ordinary acceleration, and that in the image for the outlier check
    zoom_std_per_s : relative change of the person's size in the image per second
    sign_speed_m_s, sign_acceleration_m_s2 : speed and acceleration of a bone's end in depth that cost one sigma
    fresh_from, fresh_to, fresh_weight : shares of fresh noise between which the lifter's image position of a seen
        joint loses weight, and what is left of it: smoothing removes fresh noise better, but not noise that lasts
    outlier_square, fresh_outlier_square : squared residual, in standard deviations, that halves a 2D joint's weight,
        and the same where noise is fresh: noise that lasts looks like outliers that do
    lasting_factor : most standard deviation of keypoints over that of their fresh noise: some lasts for a few frames
    held_noise_mm : lasting noise at which known bone lengths change little: noise lengthens free bones
    lengthening_noise_mm : noise at which the lifter's bone lengths are as good as the adjustment's
    alone_stds, alone_mm, alone_frames : a keypoint is hidden from the second look farther than so many standard
        deviations and mm from where the others put it, if its distance is no more usual over so many frames
    drawn_toes : whether a network drew the toes in pictures: on phone videos with optical MoCap a lifter that sees
        them bent the knees by 2 degrees more, on MoCap it errs less
    """

    lifter: str = ""
    first_iterations: int = 2
    iterations: int = 12
    noise_mm: float = 2.0
    depth_weight: float = 0.2
    image_weight: float = 1.0
    acceleration_std_m_s2: float = 16.0
    smoothing_std_m_s2: float = 10.0
    zoom_std_per_s: float = 0.006
    sign_speed_m_s: float = 1.44
    sign_acceleration_m_s2: float = 14.4
    fresh_from: float = 0.47
    fresh_to: float = 0.6
    fresh_weight: float = 0.1
    outlier_square: float = 9.0
    fresh_outlier_square: float = 20.0
    lasting_factor: float = 1.6
    held_noise_mm: float = 10.0
    lengthening_noise_mm: float = 5.0
    alone_stds: float = 4.0
    alone_mm: float = 40.0
    alone_frames: int = 5
    drawn_toes: bool = False


def lifted_config(adjuster: BundleAdjusterConfig, *, drawn_toes: bool) -> LiftedConfig:
    """The parameters that the bundle adjuster's section sets; the weights keep their defaults."""
    first, final = adjuster.limb_iterations_first, adjuster.limb_iterations
    return LiftedConfig(lifter=adjuster.lifter, first_iterations=first, iterations=final, drawn_toes=drawn_toes)
