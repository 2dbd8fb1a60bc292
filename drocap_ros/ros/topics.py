"""Topics, their types and quality of service, and which node has which: the graph, in one table."""

from __future__ import annotations

from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, RegionOfInterest
from visualization_msgs.msg import ImageMarker, MarkerArray

from drocap_ros.msg import OrbitCommand, OrbitStatus, Pose2D, Pose3D, Pose3DWindow, VehicleState

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not among the ROS wheels; `make setup` builds it, a ROS installation has it
    TFMessage = None

#: A source of pictures that begins like this is a topic.
TOPIC_SOURCE = "topic:"

#: A picture that comes late is worth nothing: no retransmission, and at most four wait.  With one, a single slow
#: detection costs a picture; the others come in a rush when the camera's process has been held up, and are soon worked
#: off, since who hurries carries keypoints on.
IMAGE_QOS = QoSProfile(depth=4, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
#: In a graph, whose own nodes offer that, what found no room in the kernel's buffers at once is asked for again: a
#: picture of 400 KiB and more, where Linux is as it comes.  That takes some 15 ms.
IMAGE_IN_GRAPH_QOS = QoSProfile(depth=4, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Offered reliably, so that a recorder on the same machine loses none; a best-effort reader costs no more for it.
IMAGE_OFFERED_QOS = QoSProfile(depth=30, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: The recorder comes last: on a busy machine, most of all at the start, it may not be let run for seconds.
IMAGE_RECORDING_QOS = QoSProfile(depth=150, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Results are small, and none may be lost: 10 s of them at 100 Hz.
RESULT_QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
#: Handshake of nodes and bringup, for whoever comes later; as deep as there are nodes to speak.
GRAPH_QOS = QoSProfile(
    depth=100,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


@dataclass(frozen=True)
class Topic:
    """A topic: message class and quality of service; names without a leading slash lie in the namespace."""

    message: type
    qos: QoSProfile
    offered: QoSProfile | None = None  # by the publisher, where it is more than subscribers ask for
    one_clock: bool = False  # stamps are times of one clock, so that each lies near the one before


TOPICS: dict[str, Topic] = {
    "image/compressed": Topic(CompressedImage, IMAGE_QOS, IMAGE_OFFERED_QOS, one_clock=True),
    "camera_info": Topic(CameraInfo, RESULT_QOS, one_clock=True),
    "roi": Topic(RegionOfInterest, RESULT_QOS),
    "pose2d": Topic(Pose2D, RESULT_QOS, one_clock=True),
    "pose3d/initial": Topic(Pose3D, RESULT_QOS, one_clock=True),
    "pose3d/refined": Topic(Pose3DWindow, RESULT_QOS, one_clock=True),
    "pose3d/latest": Topic(Pose3D, RESULT_QOS, one_clock=True),
    "vehicle/state": Topic(VehicleState, RESULT_QOS, one_clock=True),
    "orbit/command": Topic(OrbitCommand, RESULT_QOS),
    "orbit/status": Topic(OrbitStatus, RESULT_QOS),
    "markers/keypoints": Topic(ImageMarker, RESULT_QOS),
    "markers/initial": Topic(MarkerArray, RESULT_QOS),
    "markers/latest": Topic(MarkerArray, RESULT_QOS),
    "markers/camera_path": Topic(MarkerArray, RESULT_QOS),
    "/diagnostics": Topic(DiagnosticArray, RESULT_QOS),
}
#: Topics that others than this package's nodes may publish: what of their quality of service does not fit is said.
FROM_OUTSIDE = frozenset({"image/compressed", "camera_info", "roi", "vehicle/state", "orbit/command"})
if TFMessage is not None:
    TOPICS["/tf"] = Topic(TFMessage, RESULT_QOS)

#: node -> (topics it publishes, topics it subscribes to).  The recorder takes all that anybody publishes.
NODES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "image_ingest": (("image/compressed", "camera_info"), ()),
    "flight_simulator": (("image/compressed", "camera_info"), ()),
    "pose_estimator": (("pose2d",), ("image/compressed", "roi")),
    "capture_simulator": (("pose2d", "camera_info"), ()),
    "initializer": (("pose3d/initial",), ("pose2d",)),
    "bundle_adjuster": (("pose3d/refined", "pose3d/latest"), ("pose2d", "pose3d/initial", "vehicle/state")),
    "mavlink_bridge": (
        ("vehicle/state", "orbit/status", *(("/tf",) if TFMessage is not None else ())),
        ("pose2d", "camera_info", "orbit/command"),
    ),
    "visualizer": (
        (
            *("markers/keypoints", "markers/initial", "markers/latest", "markers/camera_path"),
            *(("/tf",) if TFMessage is not None else ()),
        ),
        ("pose2d", "pose3d/initial", "pose3d/latest", "vehicle/state"),
    ),
    # What it publishes is what the session holds.
    "session_player": ((), ()),
    "session_recorder": ((), tuple(TOPICS)),
}


def publishers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes publish the topic."""
    return sum(topic in NODES[name][0] for name in nodes)


def subscribers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes subscribe to the topic."""
    return sum(topic in NODES[name][1] for name in nodes)
