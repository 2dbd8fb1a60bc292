"""Why the camera's telemetry is not used: one enum, whose words stand here alone."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Why(Enum):
    """Findings that no true telemetry of a flight gives; the value is the sentence, with the measured number."""

    #: The pose stops, or goes on, faster than a vehicle can: seconds without a change.
    FROZEN = "the camera's reported pose stops at once, for {:.1f} s; check the log for gaps"
    #: The newest poses of a camera that has moved are the same: seconds.
    STOPPED = "the camera's reported pose has stopped for {:.1f} s; check the link"
    #: The rotation jumps: degrees.
    TURNED_AT_ONCE = "the camera's reported rotation jumps by {:.0f} deg; check the gimbal's yaw in the log"
    UPSIDE_DOWN = "camera and person are upside down; check that the log's axes are east, north and up"
    #: The feet rest more with poses of another time: seconds later.
    OTHER_TIME = "the feet rest more with poses {:+.1f} s later; check the log's time offset (or the person glides)"
    #: Feet that look at rest move: m/s.
    RESTING_FEET_MOVE = (
        "feet that look at rest move at {:.1f} m/s on their path; check that the log belongs to the video and "
        "is not frozen (or the person glides: skates, lift)"
    )
    POSITION_JUMPS = "the camera's position jumps as no camera flies; check the log's time and its frame"
    #: Fixed points of the picture lie elsewhere than any path near the reported one sees them: px.
    POINTS_MOVE_OTHERWISE = (
        "fixed points of the picture lie {:.1f} px off where the reported camera sees them; check that the log belongs"
        " to the video, its time offset and the lens"
    )
    #: Correcting the reported turns by fixed points leaves errors that wander: their standard deviation in degrees.
    POINTS_TURN_OTHERWISE = (
        "fixed points of the picture turn otherwise than the reported camera, by {:.0f} deg; check that the log belongs"
        " to the video, its time offset and the lens"
    )
    NO_FOOT_RESTS = (
        "no foot of the body ever rests on its path in the world; check that the log belongs to the video, its "
        "time offset and the gimbal's yaw (or the person glides)"
    )


@dataclass(frozen=True)
class Refusal:
    """Telemetry that cannot be true; ``str`` of it is one line for people.

    measured : the number of the sentence, in the unit that ``why`` states; 0 where it has none
    again_s : time until a live window asks again; 0 = the next one does
    """

    why: Why
    measured: float = 0.0
    again_s: float = 0.0

    def __str__(self) -> str:
        again = f"; asked again after {self.again_s:.0f} s" if self.again_s else ""
        return self.why.value.format(self.measured) + again
