"""Node ``bundle_adjuster``: refines the last seconds of poses together, again and again.

Subscribes ``pose2d``, ``pose3d/initial`` and ``vehicle/state``; publishes ``pose3d/refined``
(drocap_ros/Pose3DWindow) and ``pose3d/latest`` (drocap_ros/Pose3D, its newest pose).
"""

from __future__ import annotations

import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.msg import Pose2D, Pose3D, Pose3DWindow, VehicleState
from drocap_ros.nodes.component import ERROR, OK, ComponentNode
from drocap_ros.nodes.conversions import (
    header_at,
    pose2d_from_ros,
    pose3d_from_ros,
    pose3d_to_ros,
    stamp_from_ros,
)
from drocap_ros.nodes.run import node_main
from drocap_ros.perception.observation import PoseObservation
from drocap_ros.reconstruction.adjustment_window import AdjustmentWindow, WindowArrays
from drocap_ros.reconstruction.window import AdjustedWindow, adjust_window
from drocap_ros.skeleton import BODY_15

#: Keypoints that wait for their initial pose; more of them means that no initializer runs.
MAX_PENDING = 1000


class BundleAdjusterNode(ComponentNode):
    """Collects a window of keypoints and initial poses and adjusts it in a worker every ``period_s``.

    The period is counted in image stamps, so that a replay at another speed adjusts the same windows.
    """

    component = "bundle_adjuster"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._window = AdjustmentWindow(self.config)
        self._waiting: OrderedDict[int, PoseObservation] = OrderedDict()
        self._early: OrderedDict[int, np.ndarray] = OrderedDict()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="bundle_adjuster")
        self._job: Future[None] | None = None
        self._sequence = 0
        self._frame_id = ""
        self._track_id = 0
        self._refined = self.output("pose3d/refined")
        self._latest = self.output("pose3d/latest")
        self.input("pose2d", self._on_pose2d)
        self.input("pose3d/initial", self._on_initial)
        self.input("vehicle/state", self._on_vehicle_state)

    def close(self) -> None:
        """Let the adjustment under way end."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = pose2d_from_ros(message)
        if not observation.has_subject:
            return
        self._frame_id = message.header.frame_id
        # Two topics keep no order between them: either may come first, and both must take the same way.
        joints = self._early.pop(observation.stamp_ns, None)
        if joints is not None:
            self._on_frame(observation, joints)
            return
        self._waiting[observation.stamp_ns] = observation
        while len(self._waiting) > MAX_PENDING:
            self._waiting.popitem(last=False)
            self.count("keypoints without an initial pose")

    def _on_initial(self, message: Pose3D) -> None:
        joints, _ = pose3d_from_ros(message)
        stamp_ns = stamp_from_ros(message.header.stamp)
        observation = self._waiting.pop(stamp_ns, None)
        if observation is not None:
            self._on_frame(observation, joints)
            return
        self._early[stamp_ns] = joints
        while len(self._early) > MAX_PENDING:
            self._early.popitem(last=False)
            self.count("initial poses without keypoints")

    def _on_frame(self, observation: PoseObservation, joints: np.ndarray) -> None:
        self._track_id = observation.track_id
        due = self._window.push(observation, joints)
        if not due:
            return
        if self._job is not None and not self._job.done():
            self.count("adjustments skipped: the last one is still running")
            return
        self._job = self._worker.submit(self._adjust, self._window.snapshot(), self._frame_id, self._track_id)

    def _on_vehicle_state(self, message: VehicleState) -> None:
        self.count("vehicle states")

    def _adjust(self, snapshot: WindowArrays, frame_id: str, track_id: int) -> None:
        begin = time.perf_counter()
        try:
            window = adjust_window(*snapshot, self.config)
        except (InputError, np.linalg.LinAlgError, FloatingPointError) as error:
            self.count("adjustments failed")
            self.report(ERROR, f"adjustment failed: {error}")
            return
        self._publish(window, frame_id, track_id, time.perf_counter() - begin)

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
        self._latest.publish(poses[-1])
        self._sequence += 1
        self.count("adjustments")
        self.produced(int(window.stamp_ns[-1]))
        self.report(OK, f"{len(poses)} poses in {seconds:.2f} s: {window.stop_reason}")


def main() -> int:
    """Run the node as a process."""
    return node_main(BundleAdjusterNode)


if __name__ == "__main__":
    raise SystemExit(main())
