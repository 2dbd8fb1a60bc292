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
    """The constants ``CONDITION_*`` of ``msg/OrbitStatus.msg``, each with its sentence."""

    sentence: str

    def __new__(cls, number: int, sentence: str) -> ConditionCode:
        """A code of a number."""
        code = int.__new__(cls, number)
        code._value_, code.sentence = number, sentence
        return code

    # fmt: off
    NONE = 0, ""
    # States and answers to accepted commands
    NO_DATA = 1, "no data of the vehicle yet"
    ALL_CLEAR = 2, "all conditions for motion hold"
    ORBITING = 3, "orbiting the subject"
    REQUESTING_CONTROL = 4, "requesting control from the autopilot"
    ADJUSTED = 5, "orbit adjusted"
    STOPPED = 6, "stopped by the operator"
    ACKNOWLEDGED = 7, "acknowledged by the operator"
    ALREADY_ORBITING = 8, "already orbiting, and its values stay; adjust changes them"
    ALREADY_REQUESTING_CONTROL = 9, ("already requesting control from the autopilot, for the orbit of the first "
        "request; stop cancels it")
    ALREADY_HOLDING = 10, "already holding"
    NOT_ORBITING = 11, "not orbiting"
    DISARMED = 12, "the motors were disarmed"
    PILOT_TOOK_OVER = 13, ("the mode changed to {mode} without a request of ours: the pilot has taken over, or a "
        "failsafe of the autopilot; nothing is sent")
    CONTROL_NOT_GRANTED = 14, "the autopilot did not grant control{answer}"
    HOLD_MODE_MISSING = 15, "{cause}; the autopilot does not enter its hold mode: take over by hand"
    DEGRADED = 16, "the orbit is slowed down: {cause}"
    SLOWED = 17, ("{cause}, at {speed_deg_s:.1f} deg/s instead of {wanted_deg_s:.1f}: without setpoints the autopilot "
        "flies on for {timeout_s:g} s, and the vehicle must stop within max_coast_m, {limit_m:g} m")
    WIDENED = 18, "{cause}, {radius_m:.1f} m away instead of {wanted_m:.1f}: {why}"
    REQUEST_ENDED = 19, "engage ended without an orbit: {cause}"
    # Commands that are refused for what they ask, or for the state in which they come
    UNKNOWN_COMMAND = 40, "no command has the number {number}"
    COMMAND_OUTDATED = 41, ("the command is {age_s:.1f} s old by the bridge's clock, and {limit_s:g} s is the limit; "
        "synchronize the clocks of the two computers")
    TOO_MANY_COMMANDS = 42, "more than {limit} commands are waiting"
    OVERRULED_BY_STOP = 43, "a stop arrived together with this command"
    VALUE_NOT_FINITE = 44, "{name}: expected a finite number or NaN (not given), got {value:g}"
    RADIUS_TOO_SMALL = 45, ("radius_m: expected at least {limit:g} m (min_distance_m and 0.5 m of room), got "
        "{value:g}; choose a larger radius")
    RADIUS_TOO_LARGE = 46, ("radius_m: expected at most {limit:g} m ({limited_by}), got {value:g}; choose a smaller "
        "radius")
    HEIGHT_OUT_OF_RANGE = 47, ("height_m: expected {low:g} to {high:g} m (inside min_height_m and max_height_m), got "
        "{value:g}; choose a height in the range")
    SPEED_ABOVE_LIMIT = 48, ("angular_speed_deg_s: expected at most {limit:.1f} deg/s at {radius_m:g} m (max_speed_m_s "
        "{max_speed_m_s:g}), got {value:g}; fly slower or closer")
    ACCELERATION_ABOVE_LIMIT = 49, ("angular_speed_deg_s: expected at most {limit:.1f} deg/s at {radius_m:g} m "
        "(max_acceleration_m_s2 {max_acceleration_m_s2:g}), got {value:g}; fly slower or closer")
    NO_ORBIT_TO_ADJUST = 50, "adjust needs a running orbit, the state is {state}"
    PILOT_IN_COMMAND = 51, "the pilot has taken over; send stop to acknowledge it, then start"
    FAULT_NOT_ACKNOWLEDGED = 52, "{cause}; send stop to acknowledge it, then start"
    NOT_IN_CONTROL_MODE = 53, "the mode is {mode}; send engage{by_hand}"
    MODE_CHANGE_FORBIDDEN = 54, "the mode is {mode} and mode_change_allowed is false; set it to true{engaged}{by_hand}"
    PERSON_LEAVES_PICTURE = 55, ("at {radius_m:g} m, {height_m:g} m high and {speed_deg_s:.0f} deg/s the person leaves "
        "the picture of {camera} by {missing_percent:.0f} % of its height; {remedy}")
    HOLD_MODE_PENDING = 56, ("the autopilot's hold mode has just been requested and is not reported yet; send engage "
        "when it is{by_hand}")
    # Link, autopilot and vehicle
    COMMANDS_DISABLED = 100, "no motion: commands are disabled; set commands_enabled to true to allow it"
    CLOCK_JUMPED = 101, "our clock jumped by {jump_s:.1f} s"
    POSITION_JUMPED = 102, ("the reported position jumped by {jump_m:.1f} m, which the reported velocity does not "
        "explain")
    CONTROL_LOOP_STALLED = 103, "the control loop stood still for {gap_s:.1f} s"
    SETPOINTS_NOT_FOLLOWED = 104, "the vehicle does not follow the setpoints: {evidence}"
    LINK_SILENT = 105, "nothing heard from the autopilot; last message: {ago}"
    AUTOPILOT_UNSUPPORTED = 106, "the autopilot is {autopilot!r}: expected {supported} of a multirotor or helicopter"
    TIMEOUT_UNKNOWN = 107, ("the autopilot has not reported {name}, how long it flies on without setpoints; set {name} "
        "to {limit_s:g} on the autopilot, or change max_control_timeout_s")
    TIMEOUT_TOO_LONG = 108, ("the autopilot flies on for {value_s:g} s without setpoints; set {name} to {limit_s:g} on "
        "the autopilot, or change max_control_timeout_s")
    LOSS_ACTION_FATAL = 109, ("without setpoints {consequence} ({name} is {value:g}); set {name} to {hold:g}, hold, on "
        "the autopilot")
    MODE_OUTDATED = 110, "the flight mode is outdated; last report: {ago}"
    ATTITUDE_OUTDATED = 111, "the vehicle's attitude is outdated; last one: {ago}"
    POSITION_FROZEN = 112, "the vehicle's position is outdated: telemetry lost, late or frozen; last change: {ago}"
    ROUND_TRIP_TOO_LONG = 113, "the autopilot has answered nothing that was sent within the last {age_s:.1f} s"
    VEHICLE_STATE_UNKNOWN = 114, "the vehicle's position, velocity or heading is unknown"
    NOT_ARMED = 115, "the motors are not armed"
    NOT_FLYING = 116, "the vehicle is {landed_state}"
    NO_SATELLITE_FIX = 117, "no 3D satellite fix (type {fix_type})"
    ESTIMATOR_UNHEALTHY = 118, "the autopilot's estimator reports no usable position"
    STATUS_OUTDATED = 119, "GPS, estimator or battery data is outdated; last report: {ago}"
    BATTERY_UNKNOWN = 120, ("the battery's charge, or the voltage that min_battery_voltage_v needs, is unknown: set up "
        "its monitor on the autopilot, or set min_battery_voltage_v to fly by the voltage alone")
    BATTERY_LOW = 121, "the battery is at {level}"
    CAMERA_UNKNOWN = 122, ("nothing reports where the camera points; set the mount up on the autopilot, or set mount "
        "to fixed and camera_pitch_deg to the camera's pitch")
    MOUNT_TYPE_UNKNOWN = 123, ("the autopilot has not reported {name}, the kind of its mount; set mount to gimbal or "
        "servo")
    MOUNT_OUTDATED = 124, "the camera's attitude is outdated; last report of its mount: {ago}"
    PACKETS_LOST = 125, ("{lost_percent:.0f} % of the autopilot's packets do not arrive: above {most_percent:.0f} % no "
        "mode is requested; let routers pass all of them, or mend the link")
    AUTOPILOT_EMERGENCY = 126, "the autopilot reports {reported}: take over by hand"
    AUTOPILOT_CRITICAL = 127, ("the autopilot reports {reported}: one of its failsafes has triggered; the ground "
        "station shows the cause, and where it is gone another mode of the pilot's choice ends the failsafe")
    SEVERAL_VEHICLES = 128, ("the link carries more than one vehicle, systems {systems}: set target_system_id to that "
        "of the one with this camera")
    CAMERA_CHANGED = 129, ("camera_info changed (focal length {before_px:.0f} px, now {now_px:.0f}): another zoom, "
        "crop or image size; keep all three as they are in flight, then start again")
    REPORTS_CONTRADICT = 132, ("the autopilot's reported velocity contradicts its reported position by {error_m_s:.1f} "
        "m/s")
    # Others in the graph
    OTHER_POSE_PUBLISHER = 130, ("pose2d has more than one publisher ({names}): stop the others, or give them another "
        "namespace")
    SECOND_BRIDGE = 131, ("another bridge, or a replay of one, publishes in {namespace}: stop it, or give it another "
        "namespace")
    # Limits of place and speed
    TOO_FAST = 150, "speed of {speed_m_s:.1f} m/s above the limit"
    TOO_HIGH = 151, "height of {height_m:.1f} m at the limit of {limit_m:g} m"
    TOO_LOW = 152, "height of {height_m:.1f} m, {source}, at the lower limit of {limit_m:g} m"
    AT_FENCE = 153, "{distance_m:.1f} m from where the orbit began: at the fence of {limit_m:g} m"
    COAST_UNSAFE = 154, "if the bridge failed now, the vehicle would {reach} before it stands"
    ORBIT_NOT_KEPT = 155, ("the vehicle has been more than {limit_m:.1f} m from its place on the orbit for {for_s:.0f} "
        "s, {away_m:.1f} m now: {verdict}")
    HEIGHT_CONTRADICTED = 156, ("the vehicle is {height_m:.1f} m above the subject's ground as reported, and "
        "{other_m:.1f} m {source}: set ground_height_m to that ground and body_height_m to the subject")
    ORBIT_TIME_OVER = 157, "the orbit has lasted max_orbit_s, {limit_s:g} s"
    OPERATOR_SILENT = 158, ("no sign of the operator; last one: {ago}; `drocap orbit watch` gives it while its console "
        "lives")
    # Subject
    NO_SUBJECT = 200, "no subject is tracked"
    SUBJECT_OUTDATED = 201, "the subject was last located {ago}"
    SUBJECT_UNCERTAIN = 202, "the subject's position is uncertain by {sd_m:.1f} m"
    SUBJECT_NEAR = 203, ("the subject is {distance_m:.1f} m away, give or take {sd_m:.1f} m, and by the speeds of both "
        "the last {room_m:.1f} m may be lost until the vehicle stands: at the limit of {limit_m:g} m")
    SUBJECT_FAR = 204, "the subject is {distance_m:.1f} m away: farther than {limit_m:g} m"
    NO_CAMERA_INFO = 206, ("no camera_info has arrived, and without it no subject is located: set "
        "image_ingest.calibration_file or horizontal_fov_deg, or let the camera's driver publish it")
    PICTURES_LOST = 207, ("no keypoints of a picture (pose2d) have arrived for {silent_s:.1f} s; the subject was last "
        "located {ago}; look after the camera, its stream and pose_estimator")
    PICTURES_LATE = 208, ("pictures arrive {late_s:.1f} s after their exposure; the subject was last located {ago}; "
        "look after the load of the computer, the stream's buffer and the clocks")
    PICTURES_FROZEN = 209, ("the picture stands still: its keypoints repeat bit for bit; the subject was last located "
        "{ago}; look after the camera and its stream")
    OTHER_SUBJECT = 210, ("the pictures show somebody else, or a person where the subject cannot be; he was last "
        "located {ago}")
    # fmt: on


#: The subject's position is outdated: by a fault of the pictures, or he is not found in them.
PICTURE_CODES = frozenset(
    getattr(ConditionCode, name)
    for name in ("SUBJECT_OUTDATED", "PICTURES_LOST", "PICTURES_LATE", "PICTURES_FROZEN", "OTHER_SUBJECT")
)

#: Factor of a limit that a command may reach: its values are float32, and limits are sums of decimal fractions.
ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True)
class Condition:
    """A code with the values that were measured; programs decide by ``code``.

    values : fields of the sentence, units in their names; ``cause`` is the condition behind this one
    """

    code: ConditionCode
    values: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        age = self.values.get("age_s")
        # Older than three years is what never came.
        ago = f"{age:.1f} s ago" if isinstance(age, float) and age < 1e8 else "never"
        return self.code.sentence.format(ago=ago, **self.values)


def condition(code: ConditionCode, **values: object) -> Condition:
    """A condition with its values as keywords."""
    return Condition(code, values)
