"""Node ``bundle_adjuster``: refines the last seconds of poses together, again and again.

Subscribes ``pose2d``, ``pose3d/initial`` and ``vehicle/state``; publishes ``pose3d/refined``
(drocap_ros/Pose3DWindow), and for every image ``pose3d/latest`` (drocap_ros/Pose3D): its initial pose with the
bone lengths of the last window, stage INITIAL until there is one.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from drocap_ros.msg import Pose2D, Pose3D, Pose3DWindow, VehicleState
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.lifted import method as default_method
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, WindowAdjuster
from drocap_ros.reconstruction.live.effort import Effort, EffortControl
from drocap_ros.reconstruction.live.frame_buffer import AdjustmentWindow, WindowArrays
from drocap_ros.reconstruction.live.initializer import AdjustedWindow
from drocap_ros.reconstruction.live.latest_pose import LatestPose, bone_lengths
from drocap_ros.reconstruction.live.stream_order import Arrival
from drocap_ros.ros.component import ERROR, OK, ComponentNode
from drocap_ros.ros.conversions import (
    floats,
    header_at,
    pose2d_from_ros,
    pose3d_from_ros,
    pose3d_to_ros,
    stamp_from_ros,
)
from drocap_ros.ros.spin import node_main
from drocap_ros.skeleton import BODY_15


class BundleAdjusterNode(ComponentNode):
    """Collects a window of keypoints and initial poses and adjusts it in a worker every ``period_s``.

    The period is counted in image stamps, so that a replay at another speed adjusts the same windows.  An adjustment
    ends after the step in which ``max_solve_s`` is over; after a slow one the next takes fewer images.  What was left
    out stands in the window's stop reason.
    """

    component = "bundle_adjuster"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._window = AdjustmentWindow(self.config)
        self._adjuster = WindowAdjuster(self.config)
        self._control = EffortControl(self.config.max_solve_s, self.config.max_stride)
        self._latest_pose = LatestPose(self.config.blend_s)
        self._waiting: OrderedDict[int, PoseObservation] = OrderedDict()
        self._early: OrderedDict[int, Pose3D] = OrderedDict()
        self._worker = ThreadPoolExecutor(1, "bundle_adjuster")
        self._job: Future[np.ndarray | None] | None = None
        self._job_subject = 0
        self._solved = False
        self._sequence = 0
        self._refined = self.output("pose3d/refined")
        self._latest = self.output("pose3d/latest")
        # What comes with each initial pose, or is only counted, needs no turn of the executor of its own.
        self._on_the_side = (
            self.input("pose2d", self._on_pose2d, polled=True),
            self.input("vehicle/state", self._on_vehicle_state, polled=True),
        )
        self.input("pose3d/initial", self._on_initial)
        self.create_timer(1.0, self._look_aside)

    @classmethod
    def import_ahead(cls) -> None:
        """The solvers, which are most of what its constructor takes."""
        default_method.import_libraries()

    @property
    def settled(self) -> bool:
        """Only its first solution tells that it is there, and costs more time than those after it."""
        return super().settled and self._solved

    def flush(self) -> None:
        """Work off what came on the side."""
        self._look_aside()
        super().flush()

    def close(self) -> None:
        """Let the adjustment under way end."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _look_aside(self) -> None:
        for subscription in self._on_the_side:
            self.poll(subscription)

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = pose2d_from_ros(message)
        if not observation.has_subject:
            return
        # Two topics keep no order between them: either may come first, and both must take the same way.
        initial = self._early.pop(observation.stamp_ns, None)
        if initial is not None:
            self._on_frame(observation, initial)
            return
        self._waiting[observation.stamp_ns] = observation
        while len(self._waiting) > self.config.max_pending:
            self._waiting.popitem(last=False)
            self.count("keypoints without an initial pose")

    def _on_initial(self, message: Pose3D) -> None:
        self._look_aside()
        pose3d_from_ros(message)
        stamp_ns = stamp_from_ros(message.header.stamp)
        observation = self._waiting.pop(stamp_ns, None)
        if observation is not None:
            self._on_frame(observation, message)
            return
        self._early[stamp_ns] = message
        while len(self._early) > self.config.max_pending:
            self._early.popitem(last=False)
            self.count("initial poses without keypoints")

    def _on_frame(self, observation: PoseObservation, initial: Pose3D) -> None:
        joints, _ = pose3d_from_ros(initial)
        due = self._window.push(observation, joints)
        arrival = self._window.arrival
        if arrival.dropped:
            self.count(f"dropped: {arrival.value}")
            return
        if arrival is not Arrival.CONTINUED:
            self.count(arrival.value)
        if arrival.anew:
            self._latest_pose.reset()
        self._take_solution(observation.stamp_ns)
        self._publish_latest(initial, observation.stamp_ns, joints)
        if not due:
            return
        if self._job is not None and not self._job.done():
            self.count("adjustments skipped: the last one is still running")
            return
        self._take_solution(observation.stamp_ns)
        self._job_subject = self._window.subject
        header = initial.header
        self._job = self._worker.submit(
            self._adjust, self._window.snapshot(), header.frame_id, observation.track_id, self._control.stride
        )

    def _take_solution(self, stamp_ns: int) -> None:
        """Hand a solution that has come since the last image to the latest pose."""
        if self._job is None or not self._job.done():
            return
        job, self._job = self._job, None
        self._solved = True
        lengths = job.result()
        if lengths is not None and self._job_subject == self._window.subject:
            self._latest_pose.solved(lengths, stamp_ns)

    def _publish_latest(self, initial: Pose3D, stamp_ns: int, joints: np.ndarray) -> None:
        self._latest.publish(
            Pose3D(
                header=initial.header,
                track_id=initial.track_id,
                stage=Pose3D.REFINED if self._latest_pose.corrected else Pose3D.INITIAL,
                skeleton=initial.skeleton,
                joints=floats(self._latest_pose.pose(stamp_ns, joints)),
                covariance=initial.covariance,
                confidence=initial.confidence,
                camera_orientation=initial.camera_orientation,
                metric=initial.metric,
                reprojection_rms=initial.reprojection_rms,
            )
        )
        self.count("latest poses")

    def _on_vehicle_state(self, message: VehicleState) -> None:
        self.count("vehicle states")

    def _adjust(self, arrays: WindowArrays, frame_id: str, track_id: int, stride: int) -> np.ndarray | None:
        """In the worker: adjust, publish, give the bone lengths; a failure leaves the last solution in use."""
        begin = time.perf_counter()
        deadline = begin + self.config.max_solve_s
        try:
            window = self._adjuster.adjust(arrays, Effort(stride), lambda: time.perf_counter() > deadline)
        except SOLVER_ERRORS as error:
            self.count("adjustments failed: the last solution stays")
            self.report(ERROR, f"adjustment failed, the last solution stays: {error}")
            return None
        seconds = time.perf_counter() - begin
        self._control.took(seconds)
        if window.stop_reason.startswith("deadline"):
            self.count("adjustments cut short: the time was over")
        if stride > 1:
            self.count("adjustments of fewer images: the one before was slow")
        self._publish(window, frame_id, track_id, seconds)
        return bone_lengths(window.joints3d)

    def _publish(self, window: AdjustedWindow, frame_id: str, track_id: int, seconds: float) -> None:
        poses = [
            pose3d_to_ros(
                header_at(stamp_ns, frame_id),
                track_id=track_id,
                stage=Pose3D.REFINED,
                skeleton=BODY_15.name,
                joints=window.joints3d[i],
                covariance=window.covariance[i],
                confidence=window.confidence[i],
                reprojection_rms_px=float(window.reprojection_rms_px[i]),
            )
            for i, stamp_ns in enumerate(window.stamp_ns)
        ]
        self._refined.publish(
            Pose3DWindow(
                header=poses[-1].header,
                poses=poses,
                window_seq=self._sequence,
                iterations=window.iterations,
                cost=float(window.cost),
                stop_reason=window.stop_reason,
                solve_seconds=seconds,
            )
        )
        self._sequence += 1
        self.count("adjustments")
        self.produced(int(window.stamp_ns[-1]))
        self.report(OK, f"{len(poses)} poses in {seconds:.2f} s: {window.stop_reason}")


def main() -> int:
    """Run the node as a process."""
    return node_main(BundleAdjusterNode)


if __name__ == "__main__":
    raise SystemExit(main())
