"""Node ``session_recorder``: every topic of the graph into a rosbag2 MCAP session.

Subscribes to the topics of the graph as serialized bytes and writes them unchanged.  The session's metadata
hold the parameters of all nodes, the hashes of the models and the camera's calibration.
"""

from __future__ import annotations

import itertools
import shutil
import threading
import time
from functools import partial
from pathlib import Path
from typing import TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from drocap_ros.errors import InputError
from drocap_ros.parameters import Values
from drocap_ros.perception.load_models import models_folder
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.provenance import (
    CALIBRATION,
    CONFIGURATION,
    MODELS,
    configuration_text,
    dated_name,
    model_hashes,
    session_provenance,
)
from drocap_ros.ros.component import ERROR, HARDWARE_ID, OK, WARN, Gaps, MessageInfo
from drocap_ros.ros.diagnostics import Key, node_of, of, values_of
from drocap_ros.ros.lifecycle import ACTIVE, ManagedComponent
from drocap_ros.ros.parameters import ParameterSurvey
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, NODES, TOPICS

M = TypeVar("M")
_IMAGES = "image/compressed"
#: Bytes that may wait in simulated time: below the least length of the writer's queue, so that none is dropped.
_MOST_WAITING = 1 << 19


class SessionRecorderNode(ManagedComponent):
    """Appends the bytes of every message to the writer's queue."""

    component = "session_recorder"
    config: SessionRecorderConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        self._writer: SessionWriter | None = None
        self._survey: ParameterSurvey | None = None
        self._calibrated = False
        self._received = False  # any message but diagnostics
        self._subject = {self.resolve_topic_name(topic) for topic in (_IMAGES, "pose2d")}
        self._recording = False  # an image or a pose
        self._sources = {name for name in self.peers if NODES[name].source}
        self._source_active = False
        self._sessions = 0
        self._image_gaps = Gaps()
        special = {
            _IMAGES: self._on_image,
            "camera_info": self._on_camera_info,
            "/diagnostics": self._on_diagnostics,
        }
        for topic in NODES[self.component].subscribes:
            name = self.resolve_topic_name(topic)
            take = special.get(topic, self._on_message)
            qos = IMAGE_RECORDING_QOS if topic == _IMAGES else None
            events = SubscriptionEventCallbacks(message_lost=partial(self._on_lost, name), use_default_callbacks=False)
            self.input(topic, partial(take, name), raw=True, qos=qos, events=events, with_info=True)
        self.create_timer(1.0, self._on_second)

    def acquire(self) -> None:
        """Open a session; a second one of this node takes the next free name."""
        folder = Path(self.config.session_dir or dated_name(self.now_ns(), self.get_namespace()))
        if self.config.if_taken == "next" or self._sessions:
            folder = _free_name(folder)
        writer = SessionWriter(folder, self.config, session_provenance(self.get_namespace()))
        for topic in NODES[self.component].subscribes:
            kind = _type_name(TOPICS[topic].message)
            writer.register(self.resolve_topic_name(topic), kind, schema_text(kind), image=topic == _IMAGES)
        self._writer, self._calibrated, self._received, self._recording = writer, False, False, False
        self._survey = ParameterSurvey(self, self.beside, self._on_parameters)
        self._sessions += 1

    def release(self) -> None:
        """Write the queue and finish the files; discard the session of a graph that never started."""
        if self._writer is not None:
            if self._received or self._source_active or (self.ready and not self._sources):
                self._writer.close()
            else:
                self._writer.discard()
            self._writer = None

    def _on_message(self, name: str, data: bytes, info: MessageInfo) -> None:
        """Write a message; log time is its arrival in this process, publish time the time at which it was sent."""
        log_ns = info["received_timestamp"]
        sent_ns = info["source_timestamp"]
        # The middleware's times are not simulated ones.
        if self.simulated or not log_ns:
            log_ns = sent_ns = self.now_ns()
            if not log_ns:  # the first /clock has not come: a session that begins in 1970 cannot be replayed
                return
        self._received |= name != "/diagnostics"
        self._recording |= name in self._subject
        if self._writer is not None:
            # Simulated time waits for the disk; real time does not, and messages are dropped.
            while self.simulated and self._writer.error is None and self._writer.queued_bytes > _MOST_WAITING:
                time.sleep(0.01)
            self._writer.write(name, data, log_ns, sent_ns or log_ns)
            self.count(Key.MESSAGES)

    def _on_image(self, name: str, data: bytes, info: MessageInfo) -> None:
        if skipped := self._image_gaps.before(info):
            self.missed(name, skipped)
        self._on_message(name, data, info)

    def _on_lost(self, name: str, event: QoSMessageLostInfo) -> None:
        """Count messages that the middleware lost."""
        self.count(of(Key.LOST, name), event.total_count_change)

    def _on_camera_info(self, name: str, data: bytes, info: MessageInfo) -> None:
        self._on_message(name, data, info)
        if not self._calibrated:
            camera = _decoded(data, CameraInfo)
            self._calibrated = True
            text = (
                f"width: {camera.width}\nheight: {camera.height}\nk: {[float(v) for v in camera.k]}\n"
                f"distortion_model: {camera.distortion_model}\nd: {[float(v) for v in camera.d]}\n"
            )
            self._add_metadata({CALIBRATION: text})

    def _on_diagnostics(self, name: str, data: bytes, info: MessageInfo) -> None:
        """Record diagnostics, except those of another drone's graph."""
        ours = self.get_namespace().strip("/")
        statuses = _decoded(data, DiagnosticArray).status
        for status in statuses:
            if node_of(status)[1] in self._sources and values_of(status).get(Key.LIFECYCLE) == ACTIVE:
                self._source_active = True
        if not all(s.hardware_id == HARDWARE_ID and node_of(s)[0] != ours for s in statuses):
            self._on_message(name, data, info)

    def _on_parameters(self, sections: dict[str, Values]) -> None:
        self._add_metadata({CONFIGURATION: configuration_text(sections)})
        if "pose_estimator" in sections:
            folder = models_folder(sections["pose_estimator"].get("models_dir") or None)
            # Large networks take long to read: not in the thread that receives.
            threading.Thread(target=self._hash_models, args=(folder,), name="model-hashes", daemon=True).start()

    def _hash_models(self, folder: Path) -> None:
        try:
            self._add_metadata({MODELS: model_hashes(folder)})
        except OSError as error:
            self.get_logger().warning(f"models: expected readable files; {error.strerror}")

    def _add_metadata(self, values: dict[str, str]) -> None:
        writer = self._writer  # another thread may end the session meanwhile
        if writer is not None:
            writer.add_metadata(values)

    def _on_second(self) -> None:
        writer, survey = self._writer, self._survey
        if writer is None or survey is None or not self.active:
            return
        survey.ask_new_nodes()
        self.details[Key.FILE] = str(writer.path)
        self.details[Key.WRITTEN] = str(writer.written)
        self.details[Key.WAITING_KIB] = str(writer.queued_bytes >> 10)
        self.details[Key.FREE_MIB] = str(_free_mib(writer.folder))
        for topic, count in sorted(writer.dropped_by_topic.items()):
            self.details[of(Key.NOT_WRITTEN, topic)] = str(count)
        if writer.error is not None:
            self.report(ERROR, writer.error)
        elif writer.dropped:
            self.report(WARN, f"{writer.dropped} messages dropped: the disk is too slow; lower jpeg_quality")
        else:
            waiting = "" if self._recording else "; no image and no pose has arrived yet"
            self.report(OK, f"recording to {writer.folder}{waiting}")


def _free_name(folder: Path) -> Path:
    """The folder if it is new or empty, else the first such of ``folder_2``, ``folder_3``, ..."""
    names = itertools.chain([folder.name], (f"{folder.name}_{number}" for number in itertools.count(2)))
    candidates = (folder.with_name(name) for name in names)
    return next(c for c in candidates if not c.exists() or (c.is_dir() and not any(c.iterdir())))


def _free_mib(folder: Path) -> int | str:
    try:
        return shutil.disk_usage(folder).free >> 20
    except OSError:
        return "unknown"


def _decoded(data: bytes, kind: type[M]) -> M:
    """Message of its bytes, which nobody has decoded before; InputError where they are none."""
    try:
        message: M = deserialize_message(data, kind)
        return message
    except RuntimeError:  # RMWError
        raise InputError(f"expected a whole {kind.__name__}, got {len(data)} bytes of none; check its sender") from None


def _type_name(message: type) -> str:
    package = message.__module__.split(".")[0]
    return f"{package}/msg/{message.__name__}"
