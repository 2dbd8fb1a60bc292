"""``/diagnostics`` as data: keys of counters and values, and the words for them.

Programs compare keys and values of this module; sentences are made here, for people, in :func:`words`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticStatus

#: Levels of diagnostic_msgs/DiagnosticStatus, which the command line knows without ROS.
OK, WARN, ERROR = b"\0", b"\1", b"\2"
#: ``hardware_id`` of the statuses of this package's nodes.
HARDWARE_ID = "drocap_ros"
#: Values of ``Key.PILOT``.
PILOT_FLIES, PILOT_HANDS_OFF = "flies", "hands_off"


class Key:
    """Keys on ``/diagnostics``; a key of one topic, event or node is ``KEY/NAME``, see :func:`of`."""

    # state
    READY = "ready"  # "true" when all publishers and subscriptions of the graph are matched
    LIFECYCLE = "lifecycle"
    RATE = "rate_hz"
    LATENCY_P50, LATENCY_P95, LATENCY_P99 = "latency_p50_ms", "latency_p95_ms", "latency_p99_ms"
    SUBJECT = "subject"
    NETWORKS = "networks"
    LAST_REFUSED = "last_refused"
    PILOT, VEHICLE_MODE = "pilot", "vehicle_mode"
    FILE, WRITTEN, WAITING_KIB, FREE_MIB = "file", "written", "waiting_kib", "free_mib"
    # counters
    IMAGES, POSES, MESSAGES, ROUNDS, EXPOSURES = "images", "poses", "messages", "rounds", "exposures"
    MESSAGES_REFUSED = "messages_refused"
    MISSED = "missed"  # messages that were published and that the busy subscriber never took
    LOST = "lost"  # messages that the middleware lost
    PASSED_OVER = "passed_over_percent"  # of the images of the last seconds: this machine is too slow for them
    NOT_WRITTEN = "not_written"  # messages that the disk was too slow for
    IMAGES_LATE = "images_late"  # images of a file that was read too slowly
    IMAGES_SKIPPED = "images_skipped"  # by max_rate_hz
    IMAGES_UNRENDERED = "images_unrendered"
    IMAGES_SHED, IMAGES_PROPAGATED = "images_shed", "images_propagated"
    SOURCE_EVENT = "source_event"
    STREAM_EVENT = "stream_event"
    IMAGES_INCOMPLETE = "images_incomplete"
    KEYPOINTS_UNPAIRED, INITIAL_UNPAIRED = "keypoints_unpaired", "initial_unpaired"
    LATEST_POSES = "latest_poses"
    ADJUSTMENTS, ADJUSTMENTS_FAILED, ADJUSTMENTS_SKIPPED = "adjustments", "adjustments_failed", "adjustments_skipped"
    ADJUSTMENTS_CUT, ADJUSTMENTS_STRIDED = "adjustments_cut", "adjustments_strided"
    FRAME = "frame"  # of pose3d/latest, or of what is sent to other programs and how it is leveled
    PACKETS, PACKETS_REFUSED = "packets", "packets_refused"  # of VMC
    TELEMETRY = "telemetry"  # use of the camera's reported poses in the last adjustment
    TELEMETRY_REFUSED = "telemetry_refused"  # why, in words
    PICTURE_PATH = "picture_path"  # the camera's path in `odom`, or why there is none, in words
    PATHS_LOST = "paths_lost"
    CALIBRATION = "calibration"  # constant errors of the telemetry by fixed points, in words; empty = not used
    VEHICLE_STATES, SUBJECT_SEEN = "vehicle_states", "subject_seen"
    ORBIT_COMMANDS, ORBIT_COMMANDS_REFUSED = "orbit_commands", "orbit_commands_refused"
    STREAM_RATE = "stream_rate_hz"
    MAVLINK_BAD, MAVLINK_UNSIGNED = "mavlink_bad", "mavlink_unsigned"
    ROUND_TRIP = "round_trip_s"  # "nan" while time synchronization has never been answered
    RESTARTS = "restarts"


_WORDS = {
    Key.MESSAGES_REFUSED: "messages refused",
    Key.LAST_REFUSED: "last refused message",
    Key.MISSED: "passed over",
    Key.PASSED_OVER: "passed over lately, %",
    Key.LOST: "lost by the middleware",
    Key.NOT_WRITTEN: "dropped: disk too slow",
    Key.IMAGES_LATE: "images dropped: source read too slowly",
    Key.IMAGES_SKIPPED: "images skipped by max_rate_hz",
    Key.IMAGES_UNRENDERED: "images not rendered in time",
    Key.IMAGES_SHED: "images with reduced detection",
    Key.IMAGES_PROPAGATED: "images with propagated keypoints",
    Key.IMAGES_INCOMPLETE: "images that show too little of the person",
    Key.KEYPOINTS_UNPAIRED: "keypoints without an initial pose",
    Key.INITIAL_UNPAIRED: "initial poses without keypoints",
    Key.ADJUSTMENTS_FAILED: "failed adjustments",
    Key.ADJUSTMENTS_SKIPPED: "adjustments skipped: the previous one was running",
    Key.ADJUSTMENTS_CUT: "adjustments ended by their time limit",
    Key.ADJUSTMENTS_STRIDED: "adjustments of fewer images",
    Key.SUBJECT_SEEN: "images with the subject",
    Key.ORBIT_COMMANDS_REFUSED: "orbit commands refused",
    Key.MAVLINK_BAD: "malformed MAVLink packets",
    Key.MAVLINK_UNSIGNED: "MAVLink packets without our signature",
    Key.WAITING_KIB: "KiB waiting",
    Key.FREE_MIB: "MiB free",
}


def of(key: str, name: str) -> str:
    """Key of one topic, event or node."""
    return f"{key}/{name.lstrip('/')}"


def words(key: str) -> str:
    """The key in words, for people."""
    kind, _, name = key.partition("/")
    text = _WORDS.get(kind, kind.replace("_", " "))
    return f"{text}, {name.replace('_', ' ') if '/' not in name else name}" if name else text


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Keys and values of a status."""
    return {value.key: value.value for value in status.values}


def number(text: str) -> float:
    """Number of a value that anyone may publish; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def node_of(status: DiagnosticStatus) -> tuple[str, str]:
    """Namespace (without slashes at its ends) and node that a status is about."""
    namespace, _, name = status.name.rpartition("/")
    return namespace, name


class Latency:
    """Percentiles of the last measurements, and their rate; bounded memory."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=512)
        self._at_s: deque[float] = deque(maxlen=512)

    def add(self, seconds: float, now_s: float) -> None:
        """Take one measurement, made at ``now_s`` of a monotonic clock."""
        self._seconds.append(seconds)
        self._at_s.append(now_s)

    def rate_hz(self, now_s: float, window_s: float = 5.0) -> float:
        """Measurements per second over the last seconds."""
        recent = sum(now_s - at <= window_s for at in tuple(self._at_s))  # another thread may add meanwhile
        return recent / window_s

    def percentiles_ms(self) -> tuple[float, ...]:
        """50th, 95th and 99th percentile, ms; empty without measurements."""
        if not self._seconds:
            return ()
        import numpy as np

        return tuple(1000.0 * float(value) for value in np.percentile(np.array(self._seconds), [50, 95, 99]))
