"""Parameters of the subject's position."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param

#: Kinds of mount: "auto" = as the autopilot describes it; "gimbal" = stabilized, its angles are against the horizon;
#: "servo" = its angles are against the body; "fixed" = no mount, the camera has one pitch against the body.
MOUNT_KINDS = ("auto", "gimbal", "servo", "fixed")


@dataclass(frozen=True)
class SubjectConfig(Parameters):
    """Assumptions about body, ground and sensors that locate the subject."""

    body_height_m: float = param(1.7, "assumed height of the subject", "m", 0.5, 2.5)
    ground_height_m: float = param(
        0.0, "height of the subject's ground in the map frame; 0 = where the local frame begins", "m", -500, 500
    )
    use_ground_plane: bool = param(True, "use the range of the feet on level ground too; switch off on slopes")
    size_error: float = param(
        0.08,
        "standard deviation of the range from body size, as a share of it: 0.04 where body_height_m is measured",
        minimum=0.01,
        maximum=1,
    )
    height_error_m: float = param(
        0.5, "standard deviation of the camera's height above the subject's ground", "m", 0, 20
    )
    attitude_error_deg: float = param(0.6, "standard deviation of the camera's attitude", "deg", 0, 20)
    camera_latency_s: float = param(
        0.0, "exposure to stamp of an image, subtracted from it; 0.07 s were seen of USB cameras", "s", 0, 0.5
    )
    subject_acceleration_m_s2: float = param(
        1.2, "standard deviation of the change of a subject's velocity in a second", "m/s^2", 0.05, 20
    )
    subject_gate: float = param(
        16.3, "squared Mahalanobis distance beyond which a measurement is not the subject", minimum=3, maximum=1000
    )
    mount: str = param(
        "auto",
        "what holds the camera: gimbal = its angles are reported against the horizon; servo = reported against "
        "the body; fixed = camera_pitch_deg against the body; auto = gimbal, or servo where the autopilot names "
        "servos",
        choices=MOUNT_KINDS,
    )
    camera_pitch_deg: float = param(
        0.0, "pitch of a fixed camera against the body, as in MAVLink: negative = it looks down", "deg", -90, 90
    )
