"""Node ``bundle_adjuster``: adjusts the last seconds of poses together.

Subscribes ``pose2d``, ``pose3d/initial``, ``background``, ``vehicle/state``, and ``camera_info``; publishes
``pose3d/refined`` (drocap_ros/Pose3DWindow), and for every image
``pose3d/latest`` (drocap_ros/Pose3D): its initial pose with the bone lengths of the last window, stage INITIAL until
there is one.  With the camera's pose and a measured scale both are in ``map``, else in the camera's optical frame;
``/diagnostics`` says why.  Without telemetry windows are in ``odom``, by the path of fixed points on ``/tf``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from drocap_ros.errors import InputError
from drocap_ros.msg import BackgroundTracks, Pose2D, Pose3D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, EffortControl, Window
from drocap_ros.recording.pose_messages import add_calibration, add_state, fixed_points_from_message
from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode, Line, MessageInfo
from drocap_ros.ros.conversions import (
    MAP,
    camera_transform,
    pose2d_from_ros,
    pose3d_from_ros,
    pose3d_to_ros,
    stamp_from_ros,
    window_to_ros,
)
from drocap_ros.ros.diagnostics import Key, of
from drocap_ros.ros.own_process import OwnProcess
from drocap_ros.ros.topics import TFMessage
from drocap_ros.skeleton import BODY_15, BODY_17

_NICENESS = 5  # of the process that adjusts: after keypoints and newest pose, never without a part of a busy machine
_STARVED = 2.0  # an adjustment that takes so many times its limit has waited: its longest step takes a fifth of it
#: Joint sets of initial poses.
_SKELETONS = (BODY_15.name, BODY_17.name)


class BundleAdjusterNode(ComponentNode):
    """Collects keypoints and initial poses and adjusts them in a process of its own every ``period_s``.

    The period is counted in image stamps, so that a replay at another speed adjusts the same windows.  An adjustment
    ends after the step in which ``max_solve_s`` is over; after a slow one the next takes fewer images.  The message's
    ``stride`` and ``steps`` state both, its ``telemetry_stamp`` and ``background_stamp`` what was known.  In simulated
    time an adjustment is never cut, and its result comes with the first image
    ``max_solve_s`` after the newest one of its window.
    """

    component = "bundle_adjuster"
    config: BundleAdjusterConfig
    needs = ("pose2d", "pose3d/initial")

    def build(self) -> None:
        """Declare endpoints and state."""
        self._core = LiveCore(self.config)
        self._adjust = OwnProcess(LiveAdjuster(self.config).adjust_within, 0 if self.simulated else _NICENESS)
        self._line = Line()
        self._control = EffortControl(self.config.max_solve_s, self.config.max_stride)
        self._worker = ThreadPoolExecutor(1, "bundle_adjuster")
        self._job: Future[Callable[[], None]] | None = None  # its result publishes what is left to publish
        self._job_due_ns = 0  # in simulated time
        self._rests_until_s = 0.0
        self._camera_frame, self._sequence, self._subject_in_view = "", 0, True
        self._refined = self.output("pose3d/refined")
        self._latest = self.output("pose3d/latest")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self.input("pose2d", self._on_pose2d)
        self.input("pose3d/initial", self._on_initial, with_info=True)
        self.input("background", self._on_background)
        self.input("vehicle/state", partial(add_state, self._core.cameras))
        self.input("camera_info", partial(add_calibration, self._core.cameras))

    def on_stop(self) -> None:
        """In simulated time publish the running adjustment."""
        if self.simulated:
            self._is_running(self._job_due_ns)

    def close(self) -> None:
        """End the running adjustment."""
        self._adjust.kill()
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._adjust.close()

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
        self._is_running(observation.stamp_ns)
        self._on_step(self._core.add_observation(observation))

    def _on_background(self, message: BackgroundTracks) -> None:
        self._core.points.add(stamp_from_ros(message.header.stamp), fixed_points_from_message(message))

    def _on_initial(self, message: Pose3D, info: MessageInfo) -> None:
        begin_ns = time.time_ns()
        self._core.behind = not self.simulated and self._line.passes_over(info, begin_ns)
        pose = pose3d_from_ros(message)
        if message.skeleton not in _SKELETONS:
            raise InputError(
                f"skeleton: expected {' or '.join(_SKELETONS)} in pose3d/initial, got {message.skeleton!r}; map them"
            )
        self._camera_frame = message.header.frame_id
        self._on_step(self._core.add_initial(pose))
        if not self._core.behind:
            self._line.took((time.time_ns() - begin_ns) * 1e-9)

    def _on_step(self, step: Step | None) -> None:
        self.counters[Key.KEYPOINTS_UNPAIRED], self.counters[Key.INITIAL_UNPAIRED] = self._core.unpaired
        if step is None:
            return
        if step.event is not None and step.event is not StreamEvent.CONTINUED:
            self.count(of(Key.STREAM_EVENT, step.event.name.lower()))
        if step.latest is not None:
            self.details[Key.FRAME] = self._camera_frame if step.latest.rotation is None else MAP
            self._latest.publish(pose3d_to_ros(step.latest, self.details[Key.FRAME]))
            self.count(Key.LATEST_POSES)
            self.handled += 1
        elif self._core.behind:
            self.missed("pose3d/latest", 1)
        if not step.due:
            return
        stamp_ns = step.observation.stamp_ns
        if self._is_running(stamp_ns) or time.monotonic() < self._rests_until_s:
            self.count(Key.ADJUSTMENTS_SKIPPED)
            return
        self._job_due_ns = stamp_ns + round(self.config.max_solve_s * 1e9)
        self._job = self._worker.submit(self._solve, self._core.window(), Effort(self._control.stride))

    def _is_running(self, stamp_ns: int) -> bool:
        """Whether an adjustment runs; in simulated time one that is due by now is awaited and published."""
        if self._job is None or (stamp_ns < self._job_due_ns if self.simulated else not self._job.done()):
            return self._job is not None
        job, self._job = self._job, None
        job.result()()
        return False

    def _solve(self, window: Window, effort: Effort) -> Callable[[], None]:
        """Adjust a window in the worker, which in real time also publishes the result."""
        begin, limit_s = time.perf_counter(), None if self.simulated else self.config.max_solve_s
        try:
            solved = self._adjust(window, effort, limit_s)
        except SOLVER_ERRORS as error:
            publish = partial(self._report_failure, str(error))
        else:
            publish = partial(self._publish, window, solved, time.perf_counter() - begin)
        took_s = time.perf_counter() - begin
        if limit_s is not None and took_s > _STARVED * limit_s and self._sequence:
            # Its process waits for processors: it leaves them to the keypoints for as long again.  The first one waited
            # for the process itself.
            self._rests_until_s = time.monotonic() + took_s
        if self.simulated:
            return publish
        publish()
        return lambda: None

    def _report_failure(self, reason: str) -> None:
        self.count(Key.ADJUSTMENTS_FAILED)
        self.report(ERROR, f"adjustment failed, the last solution stays: {reason}")

    def _publish(self, window: Window, solved: AdjustedWindow, seconds: float) -> None:
        self._core.add_solution(window, solved)
        if not self.simulated:
            self._control.record(seconds)
        if solved.effort.steps is not None:
            self.count(Key.ADJUSTMENTS_CUT)
        if solved.effort.stride > 1:
            self.count(Key.ADJUSTMENTS_STRIDED)
        self._refined.publish(window_to_ros(window, solved, self._camera_frame, self._sequence, seconds))
        if solved.in_map is not None and solved.in_map.path and self._tf is not None:
            self._tf.publish(TFMessage(transforms=[camera_transform(solved, self._camera_frame)]))
        self._sequence += 1
        self.count(Key.ADJUSTMENTS)
        self.produced(int(solved.stamp_ns[-1]))
        use, reason, words, doubtful = self._core.told(solved)
        self.details[Key.TELEMETRY], self.details[Key.TELEMETRY_REFUSED] = use.name.lower(), reason
        self.details[Key.CALIBRATION], self.details[Key.PICTURE_PATH] = solved.calibration, solved.picture
        if solved.lost:
            self.count(Key.PATHS_LOST)
        took = "" if self.simulated else f" in {seconds:.2f} s"
        done = f"{len(solved.stamp_ns)} poses{took}: {solved.stop_reason}"
        self.report(WARN if doubtful else OK, f"{done}; {words}" if words else done)
