"""Node ``capture_simulator``: the keypoints of a simulated flight, instead of images and perception.

Publishes ``pose2d`` and ``camera_info`` at the rate of a camera, and flies a simulated MAVLink vehicle along
the same orbit.  For the tests.
"""

from __future__ import annotations

import contextlib
import time

import numpy as np
from sensor_msgs.msg import CameraInfo

from drocap_ros.observation import PoseObservation
from drocap_ros.ros.conversions import header_at, pose2d_to_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.lifecycle import ThreadedSource
from drocap_ros.simulation.capture import SimulatedCapture, simulate_capture
from drocap_ros.simulation.capture_config import SimulationConfig
from drocap_ros.simulation.vehicle.flight_path import SampledPath
from drocap_ros.simulation.vehicle.mavlink_vehicle import SimulatedVehicle
from drocap_ros.tracks import Tracks

#: The drone hovers this long before the first image, until links are up and clocks synchronized.
HOVER_S = 3.0
FRAME_ID = "camera_optical"


class CaptureSimulatorNode(ThreadedSource):
    """Plays a simulated capture in real time."""

    component = "capture_simulator"
    config: SimulationConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        self._capture: SimulatedCapture = simulate_capture(
            self.config.seconds, self.config.rate_hz, self.config.seed, self.config
        )
        self._pose2d = self.output("pose2d")
        self._infos = self.output("camera_info")

    def play(self) -> None:
        """Fly."""
        tracks = self._capture.tracks
        start_ns = self.get_clock().now().nanoseconds + int(HOVER_S * 1e9)
        begin = time.monotonic() + HOVER_S
        with contextlib.ExitStack() as stack:
            if self.config.vehicle_url:
                path = _delayed_path(tracks)
                vehicle = stack.enter_context(SimulatedVehicle(self.config.vehicle_url, path))
                vehicle.start()
            for i, offset_ns in enumerate(tracks.stamp_ns):
                if self.stopping.wait(max(0.0, begin + offset_ns * 1e-9 - time.monotonic())):
                    return
                if self.active:
                    self._publish(tracks, i, start_ns + int(offset_ns))
            self.stopping.wait(0.5)  # the telemetry around the last image
        self.end()

    def _publish(self, tracks: Tracks, i: int, stamp_ns: int) -> None:
        self._pose2d.publish(pose2d_to_ros(observation_of(tracks, i, stamp_ns), FRAME_ID))
        assert tracks.camera_matrix is not None
        k = tracks.camera_matrix.ravel().tolist()
        width, height = tracks.image_size
        self._infos.publish(CameraInfo(header=header_at(stamp_ns, FRAME_ID), width=width, height=height, k=k))
        self.count(Key.POSES)


def _delayed_path(tracks: Tracks) -> SampledPath:
    """The camera's path as the vehicle reports it, after the hover."""
    assert tracks.camera_rotation is not None
    assert tracks.camera_position is not None
    t = HOVER_S + tracks.stamp_ns * 1e-9
    return SampledPath(t, tracks.camera_rotation, tracks.camera_position)


def observation_of(tracks: Tracks, i: int, stamp_ns: int) -> PoseObservation:
    """One frame of simulated tracks as an observation of perception."""
    keypoints = tracks.keypoints[i].astype(np.float32)
    seen = np.isfinite(keypoints).all(axis=1)
    if not seen.any() or tracks.covariance is None or tracks.confidence is None:
        return PoseObservation(stamp_ns, 0, tracks.image_size)
    low, high = keypoints[seen].min(axis=0), keypoints[seen].max(axis=0)
    margin = 0.1 * (high - low)
    return PoseObservation(
        stamp_ns=stamp_ns,
        track_id=1,
        image_size=tracks.image_size,
        roi=np.concatenate([low - margin, high + margin]).astype(np.float32),
        detection_score=0.9,
        keypoints=keypoints,
        covariance=tracks.covariance[i].astype(np.float32),
        confidence=tracks.confidence[i].astype(np.float32),
    )
