"""The graph in tables: topics with types and quality of service, services, nodes with topics and priorities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, NavSatFix, RegionOfInterest
from visualization_msgs.msg import ImageMarker, MarkerArray

from drocap_ros.msg import BackgroundTracks, OrbitStatus, Pose2D, Pose3D, Pose3DWindow, VehicleState
from drocap_ros.srv import OrbitCommand

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # missing from the ROS wheels; `make setup` builds it
    TFMessage = None

#: Prefix of an image source that is a topic.
TOPIC_SOURCE = "topic:"

#: A late image has no value: no retransmission.  Four may wait, since a camera process that was held up sends several
#: images at once, and load shedding soon works them off.
IMAGE_QOS = QoSProfile(depth=4, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Within a graph, whose publishers offer it: fragments that the kernel's buffers dropped are sent again (15 ms), as
#: images above 400 KiB need with Linux' default buffers.
IMAGE_IN_GRAPH_QOS = QoSProfile(depth=4, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Offered reliably for a recorder on the same machine; a best-effort reader costs no more for it.
IMAGE_OFFERED_QOS = QoSProfile(depth=30, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: The recorder has a low priority: a busy machine may keep it waiting for seconds.
IMAGE_RECORDING_QOS = QoSProfile(depth=150, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Results are small, and none may be lost: 10 s of them at 100 Hz.
RESULT_QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Of a camera's driver, which may offer it like its images; it repeats with every image, so a loss is none.
CAMERA_INFO_QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
#: What a driver published once, before this node, and keeps: a volatile subscription does not hear it, and one of this
#: kind hears no volatile publisher.
KEPT_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(frozen=True)
class Topic:
    """A topic: message class and quality of service; names without a leading slash lie in the namespace."""

    message: type
    qos: QoSProfile
    offered: QoSProfile | None = None  # by the publisher, where subscribers request less
    one_clock: bool = False  # stamps are times of one clock: each is near the one before


TOPICS: dict[str, Topic] = {
    "image/compressed": Topic(CompressedImage, IMAGE_QOS, IMAGE_OFFERED_QOS, one_clock=True),
    "camera_info": Topic(CameraInfo, CAMERA_INFO_QOS, RESULT_QOS, one_clock=True),
    "roi": Topic(RegionOfInterest, RESULT_QOS),
    "pose2d": Topic(Pose2D, RESULT_QOS, one_clock=True),
    "background": Topic(BackgroundTracks, RESULT_QOS, one_clock=True),
    "pose3d/initial": Topic(Pose3D, RESULT_QOS, one_clock=True),
    "pose3d/refined": Topic(Pose3DWindow, RESULT_QOS, one_clock=True),
    "pose3d/latest": Topic(Pose3D, RESULT_QOS, one_clock=True),
    "vehicle/state": Topic(VehicleState, RESULT_QOS, one_clock=True),
    "vehicle/odometry": Topic(Odometry, RESULT_QOS),
    "vehicle/fix": Topic(NavSatFix, RESULT_QOS),
    "orbit/status": Topic(OrbitStatus, RESULT_QOS),
    "markers/keypoints": Topic(ImageMarker, RESULT_QOS),
    "markers/initial": Topic(MarkerArray, RESULT_QOS),
    "markers/latest": Topic(MarkerArray, RESULT_QOS),
    "markers/camera_path": Topic(MarkerArray, RESULT_QOS),
    "/diagnostics": Topic(DiagnosticArray, RESULT_QOS),
}
#: What `vehicle/state` says already, for programs of others: no session holds it.
DERIVED = frozenset({"vehicle/odometry", "vehicle/fix"})
#: Topics that nodes of other packages may publish: an incompatible quality of service is logged.
FROM_OUTSIDE = frozenset({"image/compressed", "camera_info", "roi", "vehicle/state"})
if TFMessage is not None:
    TOPICS["/tf"] = Topic(TFMessage, RESULT_QOS)

SERVICES: dict[str, type] = {"orbit/command": OrbitCommand}

_TF = ("/tf",) if TFMessage is not None else ()


class NodeEntry(NamedTuple):
    """A node: topics it publishes, topics it subscribes to, its place in the graph.

    source : the node is activated when all other nodes are ready, and may end by itself
    live : ``drocap live`` starts the node by default
    niceness : Unix niceness of its process.  The flight loop has 0, and what leads from a picture to its initial pose
    """

    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    source: bool = False
    live: bool = False
    niceness: int = 0


#: In the order in which nodes start and stop: from the sources downwards.
NODES: dict[str, NodeEntry] = {
    "image_ingest": NodeEntry(("image/compressed", "camera_info"), source=True, live=True),
    "flight_simulator": NodeEntry(("image/compressed", "camera_info"), source=True),
    "pose_estimator": NodeEntry(("pose2d", "background"), ("image/compressed", "roi"), live=True),
    "initializer": NodeEntry(("pose3d/initial",), ("pose2d", "camera_info"), live=True),
    "bundle_adjuster": NodeEntry(
        ("pose3d/refined", "pose3d/latest", *_TF),
        ("pose2d", "pose3d/initial", "background", "vehicle/state", "camera_info"),
        live=True,
        niceness=3,  # its adjustments, which have a process of their own, 19
    ),
    "mavlink_bridge": NodeEntry(
        ("vehicle/state", *sorted(DERIVED), "orbit/status", *_TF), ("pose2d", "camera_info", "orbit/status"), live=True
    ),
    "visualizer": NodeEntry(
        ("markers/keypoints", "markers/initial", "markers/latest", "markers/camera_path", *_TF),
        ("pose2d", "pose3d/initial", "pose3d/latest", "vehicle/state"),
        live=True,
        niceness=15,
    ),
    # `drocap live` starts it where it has somewhere to send to.
    "stream_out": NodeEntry((), ("pose3d/initial", "pose3d/latest", *_TF), niceness=3),  # as what makes the newest pose
    # The topics that it publishes are those of the session.
    "session_player": NodeEntry(source=True),
    "session_recorder": NodeEntry((), tuple(name for name in TOPICS if name not in DERIVED), live=True, niceness=10),
}


def publishers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes publish the topic: diagnostics, which the table omits, all."""
    return len(nodes) if topic == "/diagnostics" else sum(topic in NODES[name].publishes for name in nodes)


def subscribers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes subscribe to the topic: to diagnostics their bringup, too."""
    return sum(topic in NODES[name].subscribes for name in nodes) + (topic == "/diagnostics" and bool(nodes))
