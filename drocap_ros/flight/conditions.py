"""Conditions for motion as codes with measured values, and the only place that makes sentences of them.

To find why a command is refused: look the code of ``orbit/status`` or of the service's answer up in
:class:`ConditionCode`; the checks that produce it are in ``orbit/motion_checks.py`` and
``orbit/command_checks.py``.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field


class ConditionCode(enum.IntEnum):
    """The constants ``CONDITION_*`` of ``msg/OrbitStatus.msg``."""

    NONE = 0
    # States and answers to accepted commands
    NO_DATA = 1
    ALL_CLEAR = 2
    ORBITING = 3
    REQUESTING_CONTROL = 4
    ADJUSTED = 5
    STOPPED = 6
    ACKNOWLEDGED = 7
    ALREADY_ORBITING = 8
    ALREADY_REQUESTING_CONTROL = 9
    ALREADY_HOLDING = 10
    NOT_ORBITING = 11
    DISARMED = 12
    PILOT_TOOK_OVER = 13
    CONTROL_NOT_GRANTED = 14
    HOLD_MODE_MISSING = 15
    DEGRADED = 16
    SLOWED = 17
    WIDENED = 18
    REQUEST_ENDED = 19
    # Commands that are refused for what they ask, or for the state in which they come
    UNKNOWN_COMMAND = 40
    COMMAND_OUTDATED = 41
    TOO_MANY_COMMANDS = 42
    OVERRULED_BY_STOP = 43
    VALUE_NOT_FINITE = 44
    RADIUS_TOO_SMALL = 45
    RADIUS_TOO_LARGE = 46
    HEIGHT_OUT_OF_RANGE = 47
    SPEED_ABOVE_LIMIT = 48
    ACCELERATION_ABOVE_LIMIT = 49
    NO_ORBIT_TO_ADJUST = 50
    PILOT_IN_COMMAND = 51
    FAULT_NOT_ACKNOWLEDGED = 52
    NOT_IN_CONTROL_MODE = 53
    MODE_CHANGE_FORBIDDEN = 54
    PERSON_LEAVES_PICTURE = 55
    HOLD_MODE_PENDING = 56
    # Link, autopilot and vehicle
    COMMANDS_DISABLED = 100
    CLOCK_JUMPED = 101
    POSITION_JUMPED = 102
    CONTROL_LOOP_STALLED = 103
    SETPOINTS_NOT_FOLLOWED = 104
    LINK_SILENT = 105
    AUTOPILOT_UNSUPPORTED = 106
    TIMEOUT_UNKNOWN = 107
    TIMEOUT_TOO_LONG = 108
    LOSS_ACTION_FATAL = 109
    MODE_OUTDATED = 110
    ATTITUDE_OUTDATED = 111
    POSITION_FROZEN = 112
    ROUND_TRIP_TOO_LONG = 113
    VEHICLE_STATE_UNKNOWN = 114
    NOT_ARMED = 115
    NOT_FLYING = 116
    NO_SATELLITE_FIX = 117
    ESTIMATOR_UNHEALTHY = 118
    STATUS_OUTDATED = 119
    BATTERY_UNKNOWN = 120
    BATTERY_LOW = 121
    CAMERA_UNKNOWN = 122
    MOUNT_TYPE_UNKNOWN = 123
    MOUNT_OUTDATED = 124
    PACKETS_LOST = 125
    AUTOPILOT_EMERGENCY = 126
    AUTOPILOT_CRITICAL = 127
    SEVERAL_VEHICLES = 128
    CAMERA_CHANGED = 129
    REPORTS_CONTRADICT = 132
    # Others in the graph
    OTHER_POSE_PUBLISHER = 130
    SECOND_BRIDGE = 131
    # Limits of place and speed
    TOO_FAST = 150
    TOO_HIGH = 151
    TOO_LOW = 152
    AT_FENCE = 153
    COAST_UNSAFE = 154
    ORBIT_NOT_KEPT = 155
    # Subject
    NO_SUBJECT = 200
    SUBJECT_OUTDATED = 201
    SUBJECT_UNCERTAIN = 202
    SUBJECT_NEAR = 203
    SUBJECT_FAR = 204
    NO_CAMERA_INFO = 206
    PICTURES_LOST = 207
    PICTURES_LATE = 208
    PICTURES_FROZEN = 209
    OTHER_SUBJECT = 210


#: The subject's position is outdated: by a fault of the pictures, or he is not found in them.
PICTURE_CODES = frozenset(
    {
        ConditionCode.SUBJECT_OUTDATED,
        ConditionCode.PICTURES_LOST,
        ConditionCode.PICTURES_LATE,
        ConditionCode.PICTURES_FROZEN,
        ConditionCode.OTHER_SUBJECT,
    }
)

#: Factor of a limit that a command may reach: its values are float32, and limits are sums of decimal fractions.
ROUNDING = 1.0 + 1e-6

_C = ConditionCode
_NEVER_S = 1e8  # ages from here on, three years, are those of what never came
_SENTENCES = {
    _C.NONE: "",
    _C.NO_DATA: "no data of the vehicle yet",
    _C.ALL_CLEAR: "all conditions for motion hold",
    _C.ORBITING: "orbiting the subject",
    _C.REQUESTING_CONTROL: "requesting control from the autopilot",
    _C.ADJUSTED: "orbit adjusted",
    _C.STOPPED: "stopped by the operator",
    _C.ACKNOWLEDGED: "acknowledged by the operator",
    _C.ALREADY_ORBITING: "already orbiting, and its values stay; adjust changes them",
    _C.ALREADY_REQUESTING_CONTROL: "already requesting control from the autopilot, for the orbit of the first "
    "request; stop cancels it",
    _C.ALREADY_HOLDING: "already holding",
    _C.NOT_ORBITING: "not orbiting",
    _C.DISARMED: "the motors were disarmed",
    _C.PILOT_TOOK_OVER: "the mode changed to {mode} without a request of ours: the pilot has taken over, or a "
    "failsafe of the autopilot; nothing is sent",
    _C.CONTROL_NOT_GRANTED: "the autopilot did not grant control{answer}",
    _C.HOLD_MODE_MISSING: "{cause}; the autopilot does not enter its hold mode: take over by hand",
    _C.DEGRADED: "the orbit is slowed down: {cause}",
    _C.SLOWED: "{cause}, at {speed_deg_s:.1f} deg/s instead of {wanted_deg_s:.1f}: without setpoints the autopilot "
    "flies on for {timeout_s:g} s, and the vehicle must stop within max_coast_m, {limit_m:g} m",
    _C.WIDENED: "{cause}, {radius_m:.1f} m away instead of {wanted_m:.1f}: {why}",
    _C.REQUEST_ENDED: "engage ended without an orbit: {cause}",
    _C.UNKNOWN_COMMAND: "no command has the number {number}",
    _C.COMMAND_OUTDATED: "the command is {age_s:.1f} s old by the bridge's clock, and {limit_s:g} s is the limit; "
    "synchronize the clocks of the two computers",
    _C.TOO_MANY_COMMANDS: "more than {limit} commands are waiting",
    _C.OVERRULED_BY_STOP: "a stop arrived together with this command",
    _C.VALUE_NOT_FINITE: "{name}: expected a finite number or NaN (not given), got {value:g}",
    _C.RADIUS_TOO_SMALL: "radius_m: expected at least {limit:g} m (min_distance_m and 0.5 m of room), got {value:g}; "
    "choose a larger radius",
    _C.RADIUS_TOO_LARGE: "radius_m: expected at most {limit:g} m ({limited_by}), got {value:g}; "
    "choose a smaller radius",
    _C.HEIGHT_OUT_OF_RANGE: "height_m: expected {low:g} to {high:g} m (inside min_height_m and max_height_m), "
    "got {value:g}; choose a height in the range",
    _C.SPEED_ABOVE_LIMIT: "angular_speed_deg_s: expected at most {limit:.1f} deg/s at {radius_m:g} m (max_speed_m_s "
    "{max_speed_m_s:g}), got {value:g}; fly slower or closer",
    _C.ACCELERATION_ABOVE_LIMIT: "angular_speed_deg_s: expected at most {limit:.1f} deg/s at {radius_m:g} m "
    "(max_acceleration_m_s2 {max_acceleration_m_s2:g}), got {value:g}; fly slower or closer",
    _C.NO_ORBIT_TO_ADJUST: "adjust needs a running orbit, the state is {state}",
    _C.PILOT_IN_COMMAND: "the pilot has taken over; send stop to acknowledge it, then start",
    _C.FAULT_NOT_ACKNOWLEDGED: "{cause}; send stop to acknowledge it, then start",
    _C.NOT_IN_CONTROL_MODE: "the mode is {mode}; send engage{by_hand}",
    _C.MODE_CHANGE_FORBIDDEN: "the mode is {mode} and mode_change_allowed is false; set it to true{engaged}{by_hand}",
    _C.PERSON_LEAVES_PICTURE: "at {radius_m:g} m, {height_m:g} m high and {speed_deg_s:.0f} deg/s the person "
    "leaves the picture of {camera} by {missing_percent:.0f} % of its height; {remedy}",
    _C.HOLD_MODE_PENDING: "the autopilot's hold mode has just been requested and is not reported yet; send engage when "
    "it is{by_hand}",
    _C.COMMANDS_DISABLED: "no motion: commands are disabled; set commands_enabled to true to allow it",
    _C.CLOCK_JUMPED: "our clock jumped by {jump_s:.1f} s",
    _C.POSITION_JUMPED: "the reported position jumped by {jump_m:.1f} m, which the reported velocity does not explain",
    _C.REPORTS_CONTRADICT: "the autopilot's reported velocity contradicts its reported position by {error_m_s:.1f} m/s",
    _C.CONTROL_LOOP_STALLED: "the control loop stood still for {gap_s:.1f} s",
    _C.SETPOINTS_NOT_FOLLOWED: "the vehicle does not follow the setpoints: {evidence}",
    _C.LINK_SILENT: "nothing heard from the autopilot; last message: {ago}",
    _C.AUTOPILOT_UNSUPPORTED: "the autopilot is {autopilot!r}: expected {supported} of a multirotor or helicopter",
    _C.TIMEOUT_UNKNOWN: "the autopilot has not reported {name}, how long it flies on without setpoints; set {name} to "
    "{limit_s:g} on the autopilot, or change max_control_timeout_s",
    _C.TIMEOUT_TOO_LONG: "the autopilot flies on for {value_s:g} s without setpoints; set {name} to {limit_s:g} on the "
    "autopilot, or change max_control_timeout_s",
    _C.LOSS_ACTION_FATAL: "without setpoints {consequence} ({name} is {value:g}); set {name} to {hold:g}, hold, on the "
    "autopilot",
    _C.MODE_OUTDATED: "the flight mode is outdated; last report: {ago}",
    _C.ATTITUDE_OUTDATED: "the vehicle's attitude is outdated; last one: {ago}",
    _C.POSITION_FROZEN: "the vehicle's position is outdated: telemetry lost, late or frozen; last change: {ago}",
    _C.ROUND_TRIP_TOO_LONG: "the autopilot has answered nothing that was sent within the last {age_s:.1f} s",
    _C.VEHICLE_STATE_UNKNOWN: "the vehicle's position, velocity or heading is unknown",
    _C.NOT_ARMED: "the motors are not armed",
    _C.NOT_FLYING: "the vehicle is {landed_state}",
    _C.NO_SATELLITE_FIX: "no 3D satellite fix (type {fix_type})",
    _C.ESTIMATOR_UNHEALTHY: "the autopilot's estimator reports no usable position",
    _C.STATUS_OUTDATED: "GPS, estimator or battery data is outdated; last report: {ago}",
    _C.BATTERY_UNKNOWN: "the battery's charge, or the voltage that min_battery_voltage_v needs, is unknown: set up its "
    "monitor on the autopilot, or set min_battery_voltage_v to fly by the voltage alone",
    _C.BATTERY_LOW: "the battery is at {level}",
    _C.CAMERA_UNKNOWN: "nothing reports where the camera points; set the mount up on the autopilot, or set mount to "
    "fixed and camera_pitch_deg to the camera's pitch",
    _C.MOUNT_TYPE_UNKNOWN: "the autopilot has not reported {name}, the kind of its mount; set mount to gimbal or servo",
    _C.MOUNT_OUTDATED: "the camera's attitude is outdated; last report of its mount: {ago}",
    _C.PACKETS_LOST: "{lost_percent:.0f} % of the autopilot's packets do not arrive: above {most_percent:.0f} % no "
    "mode is requested; let routers pass all of them, or mend the link",
    _C.AUTOPILOT_EMERGENCY: "the autopilot reports {reported}: take over by hand",
    _C.AUTOPILOT_CRITICAL: "the autopilot reports {reported}: one of its failsafes has triggered; the ground station "
    "shows the cause, and where it is gone another mode of the pilot's choice ends the failsafe",
    _C.SEVERAL_VEHICLES: "the link carries more than one vehicle, systems {systems}: set target_system_id to that of "
    "the one with this camera",
    _C.CAMERA_CHANGED: "camera_info changed (focal length {before_px:.0f} px, now {now_px:.0f}): another zoom, crop or "
    "image size; keep all three as they are in flight, then start again",
    _C.OTHER_POSE_PUBLISHER: "pose2d has more than one publisher ({names}): stop the others, or give them another "
    "namespace",
    _C.SECOND_BRIDGE: "another bridge, or a replay of one, publishes in {namespace}: stop it, or give it another "
    "namespace",
    _C.TOO_FAST: "speed of {speed_m_s:.1f} m/s above the limit",
    _C.TOO_HIGH: "height of {height_m:.1f} m at the limit of {limit_m:g} m",
    _C.TOO_LOW: "height of {height_m:.1f} m at the lower limit of {limit_m:g} m",
    _C.AT_FENCE: "{distance_m:.1f} m from where the orbit began: at the fence of {limit_m:g} m",
    _C.COAST_UNSAFE: "if the bridge failed now, the vehicle would {reach} before it stands",
    _C.ORBIT_NOT_KEPT: "the vehicle has been more than {limit_m:.1f} m from its place on the orbit for {for_s:.0f} s, "
    "{away_m:.1f} m now: {verdict}",
    _C.NO_SUBJECT: "no subject is tracked",
    _C.NO_CAMERA_INFO: "no camera_info has arrived, and without it no subject is located: set "
    "image_ingest.calibration_file or horizontal_fov_deg, or let the camera's driver publish it",
    _C.SUBJECT_OUTDATED: "the subject was last located {ago}",
    _C.PICTURES_LOST: "no keypoints of a picture (pose2d) have arrived for {silent_s:.1f} s; the subject was last "
    "located {ago}; look after the camera, its stream and pose_estimator",
    _C.PICTURES_LATE: "pictures arrive {late_s:.1f} s after their exposure; the subject was last located {ago}; look "
    "after the load of the computer, the stream's buffer and the clocks",
    _C.PICTURES_FROZEN: "the picture stands still: its keypoints repeat bit for bit; the subject was last located "
    "{ago}; look after the camera and its stream",
    _C.OTHER_SUBJECT: "the pictures show somebody else, or a person where the subject cannot be; he was last located "
    "{ago}",
    _C.SUBJECT_UNCERTAIN: "the subject's position is uncertain by {sd_m:.1f} m",
    _C.SUBJECT_NEAR: "the subject is {distance_m:.1f} m away, give or take {sd_m:.1f} m, and by the speeds of both the "
    "last {room_m:.1f} m may be lost until the vehicle stands: at the limit of {limit_m:g} m",
    _C.SUBJECT_FAR: "the subject is {distance_m:.1f} m away: farther than {limit_m:g} m",
}


@dataclass(frozen=True)
class Condition:
    """A code with the values that were measured; programs decide by ``code``.

    values : fields of the sentence, units in their names; ``cause`` is the condition behind this one
    """

    code: ConditionCode
    values: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        age = self.values.get("age_s")
        ago = f"{age:.1f} s ago" if isinstance(age, float) and age < _NEVER_S else "never"
        return _SENTENCES[self.code].format(ago=ago, **self.values)


def condition(code: ConditionCode, **values: object) -> Condition:
    """A condition with its values as keywords."""
    return Condition(code, values)
