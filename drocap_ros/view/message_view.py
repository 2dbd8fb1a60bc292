"""The graph's messages in the viewer, decoded by rclpy from a running graph or by rosbags from a recording."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import camera_rotation
from drocap_ros.geometry.ellipsoids import unpack_covariance
from drocap_ros.motion import LEVEL_CAMERA
from drocap_ros.recording.image_messages import image_from_message
from drocap_ros.recording.pose_messages import float_array, observation_from_message
from drocap_ros.recording.session import (
    COMPRESSED_IMAGE,
    IMAGE,
    Message,
    Session,
    calibration_of,
    header_stamp_ns,
    xyzw_of,
)
from drocap_ros.skeleton import JointSet, joint_set
from drocap_ros.view.camera_placement import nominal_camera_matrix, place_cameras
from drocap_ros.view.rerun_scene import Scene
from drocap_ros.view.visualizer_config import RateLimit

PLOTS = ("latency_ms", "reprojection_px", "orbit")
#: Topics by which a recording's namespace is found.
_MAIN = ("pose2d", "pose3d/initial", "pose3d/latest", "pose3d/refined", "image/compressed")
#: Images whose keypoints wait for their pose: ten seconds at 30 Hz.
_WAITING = 300
#: Points kept of the camera's path, and the distance between two of them, m: 60 m, more than an orbit of 9 m.
_PATH_POINTS = 600
_PATH_STEP_M = 0.1  # m
#: Frames of poses that stand in a world; those of others are about the pelvis, in camera axes.
_WORLDS = ("map", "odom")
#: Farthest state of the vehicle that is used for an image, ns; a judgement.
_NEAR_NS = 500_000_000
#: A refined pose is drawn when images this much later, ns, hardly change it.
_REFINED_LAG_NS = 2 * 10**9
#: A longer delay, s, comes from a different clock.
_LONGEST_S = 60.0
_OURS = "drocap_ros"
_LEVELS = {0: "INFO", 1: "WARN", 2: "ERROR", 3: "WARN"}
_MAGIC = {b"\xff\xd8": "image/jpeg", b"\x89P": "image/png"}


class MessageView:
    """Draws messages in the order of their arrival.

    Poses in frame ``map`` are drawn in place.  Others are in the camera's optical frame with the pelvis at the origin:
    they are placed so that the body projects to its keypoints, seen from the camera that the vehicle reports; without
    a report from a level camera, the pelvis at the origin.

    Parameters
    ----------
    image_hz : images are thinned to this rate for a viewer in real time; 0 = all
    """

    def __init__(self, scene: Scene, image_hz: float = 0.0) -> None:
        self._scene = scene
        self._image_rate = RateLimit(image_hz)
        self._keypoints: OrderedDict[int, tuple[str, np.ndarray]] = OrderedDict()
        self._matrix: np.ndarray | None = None
        self._size: tuple[int, int] | None = None
        self._cameras: deque[tuple[int, np.ndarray, np.ndarray]] = deque(maxlen=_WAITING)
        self._path: deque[np.ndarray] = deque(maxlen=_PATH_POINTS)
        self._now_ns: int | None = None
        self._refined_ns = -(10**18)
        self._pending: list[Message] = []
        self._last_text: dict[str, tuple[int, str]] = {}
        self.taken = self.refused = 0
        #: Diagnostics of this package's nodes in other namespaces are ignored; empty = none are.
        self.namespace = ""
        #: Name of a topic in the graph -> drawing function of its messages.
        self.handlers: dict[str, Callable[[Message, int], None]] = {
            "pose2d": self._on_pose2d,
            "pose3d/initial": lambda message, at_ns: self._on_pose3d("initial", message, at_ns),
            "pose3d/latest": lambda message, at_ns: self._on_pose3d("latest", message, at_ns),
            "pose3d/refined": self._on_window,
            "image/compressed": self._on_image,
            "camera_info": self._on_camera_info,
            "vehicle/state": self._on_state,
            "orbit/status": self._on_orbit,
            "/diagnostics": self._on_diagnostics,
        }

    def take(self, topic: str, message: Message, received_ns: int) -> None:
        """Draw a message of a topic of :attr:`handlers`; a malformed one is counted and not drawn."""
        self.taken += not topic.startswith("/")  # /diagnostics is shared by all graphs
        try:
            self.handlers[topic](message, received_ns)
        except InputError as error:
            self.refused += 1
            self._scene.log_text("view", f"{topic}: {error}", "WARN")

    def finish(self) -> None:
        """Draw the poses that waited for later images."""
        for pose in self._pending:
            self._draw("refined", pose)
        self._pending = []

    # -- images and keypoints ------------------------------------------------------------------------

    def _on_image(self, message: Message, _: int) -> None:
        if not self._image_rate.due(header_stamp_ns(message)):
            return
        data = bytes(message.data)
        self._at(message)
        if (kind := _MAGIC.get(data[:2])) is not None:
            self._scene.jpeg(data, kind)
        else:
            self._scene.image(image_from_message(message, compressed=hasattr(message, "format")))

    def _on_pose2d(self, message: Message, _: int) -> None:
        observation = observation_from_message(message)
        self._at(message)
        if self._size != observation.image_size:
            self._size = observation.image_size
            self._calibrate()
        if not observation.has_subject:
            self._scene.no_keypoints()
            return
        self._scene.keypoints(observation.joints, observation.keypoints, observation.roi)
        self._keypoints[observation.stamp_ns] = (observation.joints.name, observation.keypoints)
        while len(self._keypoints) > _WAITING:
            self._keypoints.popitem(last=False)

    def _on_camera_info(self, message: Message, _: int) -> None:
        matrix = calibration_of(message)
        if matrix is None or not np.isfinite(matrix).all() or np.diag(matrix)[:2].min() <= 0:
            raise InputError("k: expected a camera matrix with a positive focal length; calibrate the camera")
        if self._matrix is None or not np.array_equal(matrix, self._matrix):
            self._at(message)
            self._matrix = matrix
            self._size = (int(message.width), int(message.height))
            self._calibrate()

    def _calibrate(self) -> None:
        if self._size is not None:
            self._scene.calibration(self._camera_matrix(), self._size)

    def _camera_matrix(self) -> np.ndarray:
        return nominal_camera_matrix(*(self._size or (1280, 720))) if self._matrix is None else self._matrix

    # -- the body --------------------------------------------------------------------------------------

    def _on_pose3d(self, stage: str, message: Message, received_ns: int) -> None:
        self._at(message)
        self._draw(stage, message)
        late_s = (received_ns - header_stamp_ns(message)) * 1e-9
        if abs(late_s) < _LONGEST_S:
            self._scene.plot(f"latency_ms/{stage}", 1e3 * late_s)
        if message.track_id:
            self._scene.plot(f"reprojection_px/{stage}", float(message.reprojection_rms))

    def _on_window(self, message: Message, _: int) -> None:
        newest_ns = header_stamp_ns(message)
        if newest_ns < self._refined_ns:  # a recording played in a loop
            self._refined_ns = -(10**18)
        fresh = [pose for pose in message.poses if header_stamp_ns(pose) > self._refined_ns]
        final = [pose for pose in fresh if header_stamp_ns(pose) <= newest_ns - _REFINED_LAG_NS]
        for pose in final:
            self._draw("refined", pose)
        if final:
            self._refined_ns = header_stamp_ns(final[-1])
        self._pending = fresh[len(final) :]

    def _draw(self, stage: str, message: Message) -> None:
        self._scene.at(header_stamp_ns(message))
        if not message.track_id:
            self._scene.no_subject(stage)
            return
        joints_of = joint_set(message.skeleton)
        count = len(joints_of)
        joints = float_array(message.joints, (count, 3), "joints").astype(float)
        covariance = None
        if len(message.covariance) == 6 * count:
            covariance = float_array(message.covariance, (count, 6), "covariance").astype(float)
        if message.header.frame_id.rsplit("/", 1)[-1] not in _WORLDS:
            rotation, shift = self._place(message, joints_of, joints, draw_camera=stage != "refined")
            joints = joints @ rotation + shift
            covariance = None if covariance is None else _turned(covariance, rotation.T)
        self._scene.pose(stage, joints_of, joints, covariance if stage != "refined" else None)

    def _place(
        self, message: Message, joints_of: JointSet, joints: np.ndarray, draw_camera: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rotation world -> optical, and shift (3,) m in the world, of a pose in the optical frame."""
        at_ns = header_stamp_ns(message)
        measured = self._camera_at(at_ns)
        rotation = LEVEL_CAMERA if measured is None else measured[1]
        name, keypoints = self._keypoints.get(at_ns, ("", None))
        if keypoints is None or name != joints_of.name:
            return rotation, np.zeros(3)
        world = joints @ rotation
        camera = place_cameras(world[None], keypoints[None], rotation[None], self._camera_matrix())[0]
        if not np.isfinite(camera).all():
            return rotation, np.zeros(3)
        if measured is not None:
            return rotation, measured[0] - camera
        if draw_camera:
            self._scene.camera(camera, rotation)
        return rotation, np.zeros(3)

    def _camera_at(self, at_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Position and rotation of the camera in the vehicle state nearest to a time, None if none is near."""
        near = min(self._cameras, key=lambda camera: abs(camera[0] - at_ns), default=None)
        if near is None or abs(near[0] - at_ns) > _NEAR_NS:
            return None
        return near[1], near[2]

    # -- the vehicle and the nodes ---------------------------------------------------------------------

    def _on_state(self, message: Message, _: int) -> None:
        position = np.asarray(message.position_enu_m, float)
        if not np.isfinite(position).all():
            return
        self._at(message)
        xyzw = xyzw_of(message.gimbal_orientation)
        if np.isfinite(xyzw).all() and xyzw.any():
            rotation = camera_rotation(xyzw)
            self._cameras.append((header_stamp_ns(message), position, rotation))
            self._scene.camera(position, rotation)
        if not self._path or np.linalg.norm(position - self._path[-1]) >= _PATH_STEP_M:
            self._path.append(position)
            self._scene.camera_path(np.array(self._path))

    def _on_orbit(self, message: Message, _: int) -> None:
        self._at_newest(message)
        self._scene.plot("orbit/radius_error_m", float(message.radius_error_m))
        self._scene.plot("orbit/yaw_error_deg", float(message.yaw_error_deg))
        self._log_change("orbit", int(message.state), message.reason, "INFO")

    def _on_diagnostics(self, message: Message, _: int) -> None:
        self._at_newest(message)
        inside = self.namespace.strip("/") + "/" if self.namespace else ""
        for status in message.status:
            if status.hardware_id == _OURS and not status.name.startswith(inside):
                continue
            # rclpy gives the level as one byte.
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            self._log_change(status.name, level, status.message, _LEVELS.get(level, "WARN"))

    def _log_change(self, source: str, state: int, text: str, level: str) -> None:
        """Log a source's text when its state or text has changed."""
        if self._last_text.get(source) != (state, text):
            self._last_text[source] = (state, text)
            self._scene.log_text(source.replace("/", "."), text, level)

    # -- time ------------------------------------------------------------------------------------------

    def _at(self, message: Message) -> None:
        stamp = header_stamp_ns(message)
        self._now_ns = stamp if self._now_ns is None else max(self._now_ns, stamp)
        self._scene.at(stamp)

    def _at_newest(self, message: Message) -> None:
        """Use the newest image's stamp: the images of a file may have another clock than the nodes."""
        self._scene.at(self._now_ns if self._now_ns is not None else header_stamp_ns(message))


def _turned(packed: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Covariances (P, 6) of points that are turned by a rotation (3, 3)."""
    full = rotation @ unpack_covariance(packed) @ rotation.T
    return np.asarray(full.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])


def draw_session(
    view: MessageView,
    session: Session,
    namespace: str | None,
    progress: Callable[[str, float], None],
) -> None:
    """Draw a recording's messages in the order of the recording.

    Parameters
    ----------
    namespace : of the topics; None = that with most keypoints, poses and images
    progress : called with a name and the share done
    """
    counts = {topic.name: topic.count for topic in session.info.topics if topic.count}
    space = _busiest_namespace(counts) if namespace is None else f"/{namespace.strip('/')}".rstrip("/")
    named, view.namespace = _topics(view, session, counts, space, only=namespace is not None), space
    start_ns, duration_ns = session.info.start_ns or 0, max(session.info.duration_s * 1e9, 1.0)
    for raw, message in session.messages(tuple(named)):
        view.take(named[raw.topic], message, raw.log_time_ns)
        progress("messages", (raw.log_time_ns - start_ns) / duration_ns)
    view.finish()


def _topics(
    view: MessageView, session: Session, counts: Mapping[str, int], space: str, *, only: bool
) -> dict[str, str]:
    """Topic of the recording -> its name in the graph; where none is in the namespace, the images unless ``only``."""
    found = {f"{space}/{name}": name for name in view.handlers if f"{space}/{name}" in counts}
    if not found and not only:
        # Not a recording of this package: its images.
        found = {topic.name: "image/compressed" for topic in session.topics_of(COMPRESSED_IMAGE, IMAGE)[:1]}
    if not found:
        listed = ", ".join(counts) or "none"
        raise InputError(
            f"{session.path}: expected keypoints, poses or images, found the topics {listed}; record one of them"
        )
    return found | ({"/diagnostics": "/diagnostics"} if "/diagnostics" in counts else {})


def _busiest_namespace(counts: Mapping[str, int]) -> str:
    """Namespace with most keypoints, poses and images, by the messages of each topic; "" where there is none."""
    spaces: Counter[str] = Counter()
    for topic, count in counts.items():
        for end in (f"/{name}" for name in _MAIN if topic.endswith(f"/{name}")):
            spaces[topic.removesuffix(end)] += count
    return max(spaces, key=lambda space: (spaces[space], space), default="")
