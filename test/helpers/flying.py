"""A copter in real time on a UDP link, seen by a perfect camera, and the bridge that flies it."""

import contextlib
import threading
import time

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import OrbitStatus
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.ros.conversions import compressed_image_to_ros, header_at, pose2d_to_ros, pose3d_to_ros
from drocap_ros.ros.topics import TOPICS
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from lab.simulation.keypoint_errors import noisy_keypoints

MATRIX = pinhole_matrix(1280, 720, 60.0)


class Drone:
    """Copter on a UDP link and its camera with perfect perception, each in real time."""

    def __init__(self, graph, port, pictures=False):
        transport = open_transport(f"udpout:127.0.0.1:{port}")
        self.copter = SimulatedCopter(transport, np.array([7.0, 0, 2.8]), np.pi, CopterSetup(mode="GUIDED", seed=1))
        self.graph, self.seeing = graph, True
        self._pose2d = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", TOPICS["pose2d"].qos)
        self._info = graph.node.create_publisher(CameraInfo, "camera_info", TOPICS["camera_info"].qos)
        self.pictures = None
        if pictures:
            topics = ("image/compressed", "pose3d/latest")
            self.pictures = [
                graph.node.create_publisher(TOPICS[t].message, t, TOPICS[t].offered or TOPICS[t].qos) for t in topics
            ]
        self._joints = simulate_person(np.zeros(1), "stand", 1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        begin, frame = time.monotonic(), 0
        while not self._stop.wait(0.005):
            t = time.monotonic() - begin
            self.copter.fly(t)
            if t * 12 >= frame:
                frame += 1
                if self.seeing:
                    self._see(frame)

    def _see(self, frame):
        rotation = camera_rotation(self.copter.camera_orientation())[None]
        exact = project(self._joints, rotation, self.copter.body.position[None], MATRIX)
        seen = noisy_keypoints(exact, None, frame)
        stamp = self.graph.node.get_clock().now().nanoseconds
        observation = PoseObservation(
            stamp, 1, (1280, 720), keypoints=seen.keypoints[0].astype(np.float32),
            covariance=seen.covariance[0].astype(np.float32), confidence=seen.confidence[0].astype(np.float32),
        )  # fmt: skip
        if self.pictures is not None:
            self._show(observation, stamp)
        self._pose2d.publish(pose2d_to_ros(observation, "camera_optical"))
        self._info.publish(CameraInfo(width=1280, height=720, k=MATRIX.ravel()))

    def _show(self, observation, stamp):
        """Publish a picture of the keypoints, and the pose in the world."""
        image, pose = self.pictures
        picture = np.full((720, 1280, 3), (150, 170, 120), np.uint8)
        for point in np.nan_to_num(observation.keypoints):
            cv2.circle(picture, (int(point[0]), int(point[1])), 14, (60, 60, 90), -1)
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        image.publish(compressed_image_to_ros(header_at(stamp, "camera_optical"), jpeg))
        seen = np.ones(15), np.full((15, 6), 1e-4)
        pose.publish(pose3d_to_ros(LivePose(stamp, 1, self._joints[0], seen[1], seen[0], 1.0, refined=True), "map"))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join(5.0)
        self.copter.close()


@contextlib.contextmanager
def flying(namespace="/drocap", domain_id=None, pictures=False, processes=False, **values):
    port = free_udp_port()
    config = DrocapConfig().replace("mavlink_bridge", url=f"udpin:127.0.0.1:{port}", **values)
    place = {"namespace": namespace, "domain_id": domain_id}
    with (
        bringup(config, ["mavlink_bridge"], processes=processes, **place) as graph,
        Drone(graph, port, pictures) as drone,
    ):
        got = []
        graph.node.create_subscription(OrbitStatus, "orbit/status", got.append, TOPICS["orbit/status"].qos)
        yield graph, drone, got
