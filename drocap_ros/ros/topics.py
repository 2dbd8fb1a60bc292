"""The graph in tables: topics with types and quality of service, services, nodes with topics and priorities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, RegionOfInterest
from visualization_msgs.msg import ImageMarker, MarkerArray

from drocap_ros.msg import BackgroundTracks, OrbitStatus, Pose2D, Pose3D, Pose3DWindow, VehicleState
from drocap_ros.srv import OrbitCommand

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # missing from the ROS wheels; `make setup` builds it
    TFMessage = None

#: Places of persons beside the subject; place 2 has the topics ``person_2/...``.
PLACES = (2, 3)
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
    "orbit/status": Topic(OrbitStatus, RESULT_QOS),
    "markers/keypoints": Topic(ImageMarker, RESULT_QOS),
    "markers/initial": Topic(MarkerArray, RESULT_QOS),
    "markers/latest": Topic(MarkerArray, RESULT_QOS),
    "markers/camera_path": Topic(MarkerArray, RESULT_QOS),
    "/diagnostics": Topic(DiagnosticArray, RESULT_QOS),
}
#: Topics that every place has.
OF_A_PERSON = ("pose2d", "pose3d/initial", "pose3d/refined", "pose3d/latest")
TOPICS |= {f"person_{place}/{topic}": TOPICS[topic] for place in PLACES for topic in OF_A_PERSON}
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
    niceness : Unix niceness of its process.  The flight loop, the pose estimator and the initializer have 0
    section : of the configuration, where it is not named like the node
    """

    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    source: bool = False
    live: bool = False
    niceness: int = 0
    section: str = ""


#: Topics of the persons beside the subject that the visualizer shows.
_SHOWN = tuple(f"person_{place}/{topic}" for place in PLACES for topic in ("pose2d", "pose3d/initial", "pose3d/latest"))
#: Niceness of all nodes for persons beside the subject: on a busy machine they wait, the subject's do not.
_BESIDE = 12

#: In the order in which nodes start and stop: from the sources downwards.
NODES: dict[str, NodeEntry] = {
    "image_ingest": NodeEntry(("image/compressed", "camera_info"), source=True, live=True, niceness=5),
    "flight_simulator": NodeEntry(("image/compressed", "camera_info"), source=True),
    "pose_estimator": NodeEntry(("pose2d", "background"), ("image/compressed", "roi"), live=True),
    "capture_simulator": NodeEntry(("pose2d", "camera_info"), source=True),
    "initializer": NodeEntry(("pose3d/initial",), ("pose2d",), live=True),
    "bundle_adjuster": NodeEntry(
        ("pose3d/refined", "pose3d/latest", *_TF),
        ("pose2d", "pose3d/initial", "background", "vehicle/state", "camera_info"),
        live=True,
        niceness=15,
    ),
    # In this order the estimator's last keypoints are still adjusted.
    "people_estimator": NodeEntry(
        tuple(f"person_{place}/pose2d" for place in PLACES),
        ("image/compressed", "pose2d"),
        niceness=_BESIDE,
        section="pose_estimator",
    ),
    **{
        f"initializer_{place}": NodeEntry(
            (f"person_{place}/pose3d/initial",), (f"person_{place}/pose2d",), niceness=_BESIDE, section="initializer"
        )
        for place in PLACES
    },
    # Points of the scene would give each person an `odom` of its own: the windows of these are without.
    **{
        f"bundle_adjuster_{place}": NodeEntry(
            (f"person_{place}/pose3d/refined", f"person_{place}/pose3d/latest"),
            (f"person_{place}/pose2d", f"person_{place}/pose3d/initial", "vehicle/state", "camera_info"),
            niceness=17,
            section="bundle_adjuster",
        )
        for place in PLACES
    },
    "mavlink_bridge": NodeEntry(
        ("vehicle/state", "orbit/status", *_TF), ("pose2d", "camera_info", "orbit/status"), live=True
    ),
    "visualizer": NodeEntry(
        ("markers/keypoints", "markers/initial", "markers/latest", "markers/camera_path", *_TF),
        ("pose2d", "pose3d/initial", "pose3d/latest", "vehicle/state", *_SHOWN),
        live=True,
        niceness=15,
    ),
    # The topics that it publishes are those of the session.
    "session_player": NodeEntry(source=True),
    "session_recorder": NodeEntry((), tuple(TOPICS), live=True, niceness=10),
}


def component_of(node: str) -> tuple[str, str]:
    """Component of a node and prefix of its topics: ``initializer`` and ``person_2/`` of ``initializer_2``."""
    component, _, place = node.rpartition("_")
    return (component, f"person_{place}/") if place.isdecimal() else (node, "")


def own_topic(person: str, topic: str) -> str:
    """The topic of a person, by the prefix, where each person has one of its own."""
    return own if (own := person + topic) in TOPICS else topic


def section_of(node: str) -> str:
    """Section of the configuration that a node has."""
    return NODES[node].section or node


def with_people(nodes: Sequence[str], people: int) -> list[str]:
    """Nodes in the order of their start, with those that follow ``people - 1`` persons beside the subject."""
    places = PLACES[: people - 1] if "pose_estimator" in nodes else ()
    further = {"people_estimator"} if places else set()
    further |= {f"{name}_{place}" for name in nodes for place in places if f"{name}_{place}" in NODES}
    return [name for name in NODES if name in nodes or name in further]


def publishers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes publish the topic: diagnostics, which the table omits, all."""
    return len(nodes) if topic == "/diagnostics" else sum(topic in NODES[name].publishes for name in nodes)


def subscribers_of(topic: str, nodes: list[str]) -> int:
    """How many of the named nodes subscribe to the topic: to diagnostics their bringup, too."""
    return sum(topic in NODES[name].subscribes for name in nodes) + (topic == "/diagnostics" and bool(nodes))
