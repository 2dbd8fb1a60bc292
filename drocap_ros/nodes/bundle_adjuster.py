"""Node ``bundle_adjuster``: adjusts the last seconds of poses together.

Subscribes ``pose2d``, ``pose3d/initial``, ``background``, ``vehicle/state``, and ``camera_info``; publishes
``pose3d/refined`` (drocap_ros/Pose3DWindow), and for every image
``pose3d/latest`` (drocap_ros/Pose3D): its initial pose with the bone lengths of the last window, stage INITIAL until
there is one.  With the camera's pose and a measured scale both are in ``map``, else in the camera's optical frame;
``/diagnostics`` says why.  Without telemetry windows are in ``odom``, by the path of fixed points on ``/tf``.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from std_msgs.msg import Header

from drocap_ros.background import PointHistory
from drocap_ros.errors import InputError
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import BackgroundTracks, Pose2D, Pose3D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, LiveAdjuster
from drocap_ros.reconstruction.live.frame_buffer import FrameBuffer, StampJoin, StreamEvent
from drocap_ros.reconstruction.live.latest_pose import LatestPlace, LatestPose, median_bone_lengths
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, EffortControl, TelemetryUse, Window
from drocap_ros.recording.pose_messages import add_calibration, add_state, fixed_points_from_message, float_array
from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode
from drocap_ros.ros.conversions import (
    camera_transform,
    latest_pose_to_ros,
    pose2d_from_ros,
    pose3d_from_ros,
    stamp_from_ros,
    window_to_ros,
)
from drocap_ros.ros.diagnostics import Key, of
from drocap_ros.ros.own_process import OwnProcess
from drocap_ros.ros.topics import TFMessage
from drocap_ros.skeleton import BODY_15, BODY_17

#: Joint sets of initial poses.
_SKELETONS = (BODY_15.name, BODY_17.name)
#: Words of the use of telemetry.
_WORDS = {
    TelemetryUse.NONE: "",
    TelemetryUse.LATE: "poses in the camera's frame: the newest images have no reported camera pose",
    TelemetryUse.REFUSED: "poses in the camera's frame, telemetry not used: {}",
    TelemetryUse.UNSCALED: "poses in the camera's frame: the camera's motion has not measured the scale yet",
    TelemetryUse.USED: "poses in the world",
}


class _Solved(NamedTuple):
    """The adjusted window, None after a failure, which is in words; ``seconds`` on the wall clock."""

    window: AdjustedWindow | None
    failure: str
    header: Header
    track_id: int
    known_ns: tuple[int, int]
    seconds: float


class BundleAdjusterNode(ComponentNode):
    """Collects keypoints and initial poses and adjusts them in a worker thread every ``period_s``.

    The period is counted in image stamps, so that a replay at another speed adjusts the same windows.  An adjustment
    ends after the step in which ``max_solve_s`` is over; after a slow one the next takes fewer images.  The message's
    ``stride`` and ``steps`` state both, its ``telemetry_stamp`` and ``background_stamp`` what was known.  In simulated
    time an adjustment has a process of its own and is never cut, and its result comes with the first image
    ``max_solve_s`` after the newest one of its window.
    """

    component = "bundle_adjuster"
    config: BundleAdjusterConfig
    needs = ("pose2d", "pose3d/initial")

    def build(self) -> None:
        """Declare endpoints and state."""
        self._buffer = FrameBuffer(self.config)
        adjust = LiveAdjuster(self.config).adjust
        self._adjust_window = OwnProcess(adjust) if self.simulated else adjust
        self._control = EffortControl(self.config.max_solve_s, self.config.max_stride)
        self._latest_pose = LatestPose(self.config.blend_s)
        self._latest_place = LatestPlace(self.config.blend_s)
        self._cameras, self._points = CameraHistory(self.config.window_s), PointHistory(self.config.window_s)
        self._join: StampJoin[PoseObservation, Pose3D] = StampJoin(self.config.max_pending)
        self._worker = ThreadPoolExecutor(1, "bundle_adjuster")
        self._job: Future[_Solved] | None = None  # in simulated time its result is still to be published
        self._job_subject = 0
        self._job_due_ns = 0  # in simulated time
        self._sequence = 0
        self._subject_in_view = True
        self._had_telemetry = False
        self._uncalibrated = ""  # why the images have no calibration
        self._refined = self.output("pose3d/refined")
        self._latest = self.output("pose3d/latest")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self.input("pose2d", self._on_pose2d)
        self.input("pose3d/initial", self._on_initial)
        self.input("background", self._on_background)
        self.input("vehicle/state", partial(add_state, self._cameras))
        self.input("camera_info", partial(add_calibration, self._cameras))

    def on_stop(self) -> None:
        """In simulated time publish the running adjustment."""
        if self.simulated:
            self._take_solution(self._job_due_ns)

    def close(self) -> None:
        """Wait for the running adjustment."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        if isinstance(self._adjust_window, OwnProcess):
            self._adjust_window.close()

    def idle_reason(self) -> str:
        """Also: nobody to adjust, or too few images for a first adjustment."""
        if self.ready and not self._subject_in_view:
            return "no subject in view"
        reason = super().idle_reason()
        if not reason and not self.counters[Key.ADJUSTMENTS] and not self.counters[Key.ADJUSTMENTS_FAILED]:
            return f"too few poses for a first adjustment, {self.counters[Key.LATEST_POSES]} so far"
        return reason

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = pose2d_from_ros(message)
        self._subject_in_view = observation.has_subject
        if observation.has_subject:
            self._on_pair(self._join.add_first(observation.stamp_ns, observation))

    def _on_background(self, message: BackgroundTracks) -> None:
        self._points.add(stamp_from_ros(message.header.stamp), fixed_points_from_message(message))

    def _on_initial(self, message: Pose3D) -> None:
        pose3d_from_ros(message)
        self._on_pair(self._join.add_second(stamp_from_ros(message.header.stamp), message))

    def _on_pair(self, pair: tuple[PoseObservation, Pose3D] | None) -> None:
        if pair is None:
            self.counters[Key.KEYPOINTS_UNPAIRED] = self._join.dropped_first
            self.counters[Key.INITIAL_UNPAIRED] = self._join.dropped_second
            return
        observation, initial = pair
        if initial.track_id != observation.track_id:
            raise InputError(
                f"track_id: expected {observation.track_id} in pose3d/initial, as in pose2d of the same stamp, got"
                f" {initial.track_id}; its publisher has to copy it"
            )
        if initial.skeleton not in _SKELETONS:
            raise InputError(
                f"skeleton: expected {' or '.join(_SKELETONS)} in pose3d/initial, got {initial.skeleton!r}; map them"
            )
        joints, _ = pose3d_from_ros(initial)
        due = self._buffer.push(observation, joints)
        event = self._buffer.event
        if event is not StreamEvent.CONTINUED:
            self.count(of(Key.STREAM_EVENT, event.name.lower()))
        if event.dropped:
            return
        if event.restarted:
            self._latest_pose.reset()
            self._latest_place.reset()
        self._take_solution(observation.stamp_ns)
        self._publish_latest(observation, initial, joints)
        if not due:
            return
        if self._is_running(observation.stamp_ns):
            self.count(Key.ADJUSTMENTS_SKIPPED)
            return
        self._take_solution(observation.stamp_ns)
        self._job_subject = self._buffer.subject
        self._job_due_ns = observation.stamp_ns + round(self.config.max_solve_s * 1e9)
        window = self._buffer.window()
        window = window._replace(
            camera=self._cameras.along(window.stamp_ns, observation.image_size),
            background=self._points.along(window.stamp_ns),
        )
        known_ns = self._cameras.newest_ns, self._points.newest_ns
        arguments = initial.header, observation.track_id, known_ns, self._control.stride
        self._job = self._worker.submit(self._adjust, window, *arguments)

    def _publish_latest(self, observation: PoseObservation, initial: Pose3D, joints: np.ndarray) -> None:
        stamp_ns = observation.stamp_ns
        latest = self._latest_pose.pose(stamp_ns, joints)
        camera = self._cameras.along(np.array([stamp_ns], np.int64), observation.image_size)
        self._uncalibrated = self._cameras.uncalibrated(observation.image_size)
        covariance = float_array(initial.covariance, (len(latest), 6), "covariance").astype(np.float64)
        keypoints = observation.body_keypoints().xy[: len(latest)]
        placed = self._latest_place.place(stamp_ns, (latest, covariance), keypoints, camera)
        message = latest_pose_to_ros(initial, latest, refined=self._latest_pose.corrected, placed=placed)
        self._latest.publish(message)
        self.details[Key.FRAME] = message.header.frame_id
        self.count(Key.LATEST_POSES)

    def _is_running(self, stamp_ns: int) -> bool:
        if self._job is None:
            return False
        return stamp_ns < self._job_due_ns if self.simulated else not self._job.done()

    def _take_solution(self, stamp_ns: int) -> None:
        """Blend a finished solution into the latest pose."""
        if self._job is None or self._is_running(stamp_ns):
            return
        solved, self._job = self._job.result(), None
        if self.simulated:
            self._publish(solved)
        if solved.window is not None and self._job_subject == self._buffer.subject:
            self._latest_pose.set_solution(median_bone_lengths(solved.window.joints3d), stamp_ns)
            self._latest_place.set_solution(solved.window, stamp_ns)

    def _adjust(self, window: Window, header: Header, track_id: int, known_ns: tuple[int, int], stride: int) -> _Solved:
        """Adjust a window in the worker, which in real time also publishes the result."""
        begin = time.perf_counter()
        late = None if self.simulated else lambda: time.perf_counter() > begin + self.config.max_solve_s
        result, failure = None, ""
        try:
            result = self._adjust_window(window, Effort(stride), late)
        except SOLVER_ERRORS as error:
            failure = str(error)
        solved = _Solved(result, failure, header, track_id, known_ns, time.perf_counter() - begin)
        if not self.simulated:
            self._publish(solved)
        return solved

    def _publish(self, solved: _Solved) -> None:
        window, seconds = solved.window, solved.seconds
        if window is None:
            self.count(Key.ADJUSTMENTS_FAILED)
            self.report(ERROR, f"adjustment failed, the last solution stays: {solved.failure}")
            return
        if not self.simulated:
            self._control.record(seconds)
        if window.effort.steps is not None:
            self.count(Key.ADJUSTMENTS_CUT)
        if window.effort.stride > 1:
            self.count(Key.ADJUSTMENTS_STRIDED)
        self._refined.publish(
            window_to_ros(window, solved.header, solved.track_id, self._sequence, seconds, solved.known_ns)
        )
        if window.in_map is not None and window.in_map.path and self._tf is not None:
            self._tf.publish(TFMessage(transforms=[camera_transform(window, solved.header.frame_id)]))
        self._sequence += 1
        self.count(Key.ADJUSTMENTS)
        self.produced(int(window.stamp_ns[-1]))
        took = "" if self.simulated else f" in {seconds:.2f} s"
        self._report_telemetry(window, f"{len(window.stamp_ns)} poses{took}: {window.stop_reason}")

    def _report_telemetry(self, window: AdjustedWindow, done: str) -> None:
        use, reason = window.telemetry, window.reason
        if use is TelemetryUse.NONE and self._uncalibrated:
            use, reason = TelemetryUse.REFUSED, self._uncalibrated
        if use is TelemetryUse.NONE and self._had_telemetry:
            use = TelemetryUse.LATE
        self.details[Key.TELEMETRY] = use.name.lower()
        self.details[Key.TELEMETRY_REFUSED] = reason
        self.details[Key.CALIBRATION], self.details[Key.PICTURE_PATH] = window.calibration, window.picture
        if window.lost:
            self.count(Key.PATHS_LOST)
        self._had_telemetry |= use is TelemetryUse.USED
        words = _WORDS[use].format(reason) or (f"odom: {window.picture}" if window.picture else "")
        refused = window.lost or use is TelemetryUse.REFUSED or (self._had_telemetry and use is TelemetryUse.LATE)
        self.report(WARN if refused else OK, f"{done}; {words}" if words else done)
