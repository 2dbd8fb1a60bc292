"""The live method: what messages carry in, what is published out; no ROS, no clock and no thread.

The nodes and the offline replay run the same objects, and values pass through float32 as in their messages: the same
keypoints give the same poses bit for bit.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.background import PointHistory
from drocap_ros.errors import InputError
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, LiveAdjuster
from drocap_ros.reconstruction.live.frame_buffer import FrameBuffer, StreamEvent
from drocap_ros.reconstruction.live.initializer import LiveInitializer, LivePose
from drocap_ros.reconstruction.live.latest_pose import LatestPlace, LatestPose, median_bone_lengths
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, TelemetryUse, Window
from drocap_ros.stamps import StampValidator

_WORDS = {
    TelemetryUse.NONE: "",
    TelemetryUse.LATE: "poses in the camera's frame: the newest images have no reported camera pose",
    TelemetryUse.REFUSED: "poses in the camera's frame, telemetry not used: {}",
    TelemetryUse.UNSCALED: "poses in the camera's frame: the camera's motion has not measured the scale yet",
    TelemetryUse.USED: "poses in the world",
}


class Step(NamedTuple):
    """An image whose keypoints, without the distortion of its lens, and initial pose are both known.

    event : its relation to the images before; None where the stamp of the initial pose was refused
    latest : with what the last window says of the person and the camera; None where the image is dropped, or a newer
        one waits
    due : whether :meth:`LiveCore.window` is to be adjusted
    """

    observation: PoseObservation
    initial: LivePose
    event: StreamEvent | None = None
    latest: LivePose | None = None
    due: bool = False


class LiveCore:
    """Joins keypoints and initial poses, gathers windows of them, and corrects the newest pose by their solutions.

    The long work, :class:`~drocap_ros.reconstruction.live.adjuster.LiveAdjuster`, runs where its user wants.

    cameras, points : take the camera's reports and the scene's fixed points
    behind : whether newer images wait, as its user knows: then none has a latest pose
    unpaired : keypoints, and initial poses, dropped without their counterpart
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self.cameras, self.points = CameraHistory(config.window_s), PointHistory(config.window_s)
        self.unpaired = [0, 0]
        self.behind = False
        #: Why the images have no calibration, in words.
        self._uncalibrated = ""
        self._had_telemetry = False
        self._max_pending = config.max_pending
        self._observations: OrderedDict[int, PoseObservation] = OrderedDict()
        self._initial: OrderedDict[int, LivePose] = OrderedDict()
        self._buffer = FrameBuffer(config)
        self._lengths, self._place = LatestPose(config.blend_s), LatestPlace(config.blend_s)
        self._solutions: deque[tuple[Window, AdjustedWindow, int]] = deque()

    def add_observation(self, observation: PoseObservation) -> Step | None:
        """Take an image's keypoints; topics keep no order between them, so either part may come first."""
        if not observation.has_subject:
            return None
        self._observations[observation.stamp_ns] = self.cameras.flat(observation)
        return self._joined(observation.stamp_ns)

    def add_initial(self, pose: LivePose) -> Step | None:
        """Take an image's initial pose."""
        self._initial[pose.stamp_ns] = pose
        return self._joined(pose.stamp_ns)

    def add_solution(self, window: Window, solved: AdjustedWindow, from_ns: int = 0) -> None:
        """Take a window's solution, which the images from a stamp on know; may be called from another thread."""
        self._solutions.append((window, solved, from_ns))

    def window(self) -> Window:
        """The last images, with all that is known of their camera."""
        window = self._buffer.window()
        return window._replace(
            camera=self.cameras.along(window.stamp_ns, window.image_size),
            background=self.cameras.flat_points(window.stamp_ns, window.image_size, self.points.along(window.stamp_ns)),
            known_ns=(self.cameras.newest_ns, self.points.newest_ns),
        )

    def told(self, solved: AdjustedWindow) -> tuple[TelemetryUse, str, str, bool]:
        """Of the last window: the use of telemetry, why it was refused, both in words, and whether that is a fault."""
        use, reason = solved.telemetry, solved.reason
        if use is TelemetryUse.NONE and self._uncalibrated:
            use, reason = TelemetryUse.REFUSED, self._uncalibrated
        if use is TelemetryUse.NONE and self._had_telemetry:
            use = TelemetryUse.LATE
        self._had_telemetry |= use is TelemetryUse.USED
        words = _WORDS[use].format(reason) or (f"odom: {solved.picture}" if solved.picture else "")
        late = self._had_telemetry and use is TelemetryUse.LATE
        return use, reason, words, solved.lost or use is TelemetryUse.REFUSED or late

    def _joined(self, stamp_ns: int) -> Step | None:
        if stamp_ns in self._observations and stamp_ns in self._initial:
            return self._step(self._observations.pop(stamp_ns), self._initial.pop(stamp_ns))
        if len(self._observations) > self._max_pending:
            self._observations.popitem(last=False)
            self.unpaired[0] += 1
        if len(self._initial) > self._max_pending:
            self._initial.popitem(last=False)
            self.unpaired[1] += 1
        return None

    def _step(self, observation: PoseObservation, initial: LivePose) -> Step:
        if initial.track_id != observation.track_id:
            raise InputError(
                f"track_id: expected {observation.track_id} in pose3d/initial, as in pose2d of the same stamp, got"
                f" {initial.track_id}; its publisher has to copy it"
            )
        joints, covariance = (a.astype(np.float32).astype(np.float64) for a in (initial.joints3d, initial.covariance))
        due = self._buffer.push(observation, joints)
        event = self._buffer.event
        if event.dropped:
            return Step(observation, initial, event)
        if event.restarted:
            self._lengths.reset()
            self._place.reset()
        self._take_solutions(observation.stamp_ns)
        if self.behind:
            return Step(observation, initial, event, due=due)
        latest = self._latest(observation, replace(initial, joints3d=joints, covariance=covariance))
        return Step(observation, initial, event, latest, due)

    def _take_solutions(self, stamp_ns: int) -> None:
        while self._solutions and self._solutions[0][2] <= stamp_ns:
            window, solved, _ = self._solutions.popleft()
            if window.subject == self._buffer.subject:
                self._lengths.set_solution(median_bone_lengths(solved.joints3d), stamp_ns)
                self._place.set_solution(solved, stamp_ns)

    def _latest(self, observation: PoseObservation, initial: LivePose) -> LivePose:
        joints = self._lengths.pose(observation.stamp_ns, initial.joints3d)
        camera = self.cameras.along(np.array([observation.stamp_ns], np.int64), observation.image_size)
        self._uncalibrated = self.cameras.uncalibrated(observation.image_size)
        keypoints = observation.body_keypoints().xy[: len(joints)]
        rigid = replace(initial, joints3d=joints, refined=self._lengths.corrected)
        return self._place.place(rigid, keypoints, camera) or rigid


def live_results(
    observations: Iterable[PoseObservation],
    initializer: LiveInitializer,
    core: LiveCore,
    adjuster: LiveAdjuster,
    effort_at: Callable[[int], Effort | None] = lambda _: Effort(),
    delay_s: float = 0.5,
) -> Iterator[Step | tuple[Window, AdjustedWindow]]:
    """Images and windows in the order of the live graph; memory is that of one window.

    observations : in the order of their messages; those that the nodes drop are skipped
    effort_at : gives by the stamp of a window's newest image the effort of the live graph, None where it skipped the
        window: one is skipped while another is running
    delay_s : from a window's newest image to the first one that knows its solution
    """
    arrivals = StampValidator()  # of pose3d/initial at the adjuster's node
    for observation in observations:
        pose = _initial_pose(initializer, core.cameras.flat(observation))
        if pose is None:
            continue
        try:
            arrivals.check(*divmod(observation.stamp_ns, 10**9))
        except InputError:
            yield Step(observation, pose)
            continue
        core.add_initial(pose)
        step = core.add_observation(observation)
        assert step is not None
        yield step
        effort = effort_at(observation.stamp_ns) if step.due else None
        if effort is None:
            continue
        window = core.window()
        try:
            solved = adjuster.adjust(window, effort)
        except SOLVER_ERRORS:
            continue
        core.add_solution(window, solved, observation.stamp_ns + round(delay_s * 1e9))
        yield window, solved


def _initial_pose(initializer: LiveInitializer, observation: PoseObservation) -> LivePose | None:
    """The pose that the initializer's node publishes; None = none."""
    if not observation.has_subject:
        return None
    try:
        return initializer.push(observation)
    except InputError:
        return None
