"""Malformed messages on every input topic of every node: dropped, counted, explained, and no node ends."""

import math
import struct
import time
import zlib
from array import array

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, RegionOfInterest

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.msg import OrbitStatus, Pose2D, Pose3D, VehicleState
from drocap_ros.ros.conversions import camera_info_to_ros, header_at, stamp_to_ros
from drocap_ros.ros.diagnostics import Key, of
from drocap_ros.ros.topics import RESULT_QOS, TOPICS
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from drocap_ros.srv import OrbitCommand

NODES = [
    "image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "visualizer",
    "session_recorder",
]  # fmt: skip
CAMERA = "/camera/image_raw/compressed"
NAN, INF = math.nan, math.inf
FAR_STAMPS = {"1970": 5 * 10**9, "2100": 4_102_444_800 * 10**9, "before 1970": -(10**9)}


class Bench:
    """The running graph, a publisher on each of its inputs, and its messages."""

    def __init__(self, graph, picture):
        self.graph, self.picture = graph, picture
        self.now_ns = time.time_ns()
        self.values, self.heard = {}, {}
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, RESULT_QOS)
        for topic in {"orbit/status", *(entry[3] for entry in INPUTS.values())} - {None}:
            self.heard[topic] = []
            graph.node.create_subscription(TOPICS[topic].message, topic, self.heard[topic].append, TOPICS[topic].qos)
        self.publishers = {CAMERA: graph.node.create_publisher(CompressedImage, CAMERA, qos_profile_sensor_data)}
        for topic in INPUTS:
            if topic not in self.publishers:
                entry = TOPICS[topic]
                self.publishers[topic] = graph.node.create_publisher(entry.message, topic, entry.offered or entry.qos)
        graph.wait_until(
            lambda: all(p.get_subscription_count() >= len(INPUTS[t][0]) for t, p in self.publishers.items()),
            30,
            "every node to listen",
        )

    def _on_report(self, message):
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            self.values[name] = {v.key: v.value for v in status.values}

    def stamp(self):
        """Of the next image: 30 Hz."""
        self.now_ns += 33_333_333
        return self.now_ns

    def refused(self, node):
        return int(self.values.get(node, {}).get(Key.MESSAGES_REFUSED, 0))


@pytest.fixture(scope="module")
def bench(shared, tmp_path_factory):
    session = tmp_path_factory.mktemp("malformed") / "session"
    # Without a camera_info: the bridge would refuse pose2d of images of another size than those of the topic.
    config = DrocapConfig().replace("image_ingest", source=f"topic:{CAMERA}")
    config = config.replace("pose_estimator", models_dir=str(shared / "models"), confirm_frames=1)
    config = config.replace("mavlink_bridge", url=f"udpin:127.0.0.1:{free_udp_port()}", commands_enabled=True)
    config = config.replace("session_recorder", session_dir=str(session))
    picture = (shared / "media" / "skier.jpg").read_bytes()
    with bringup(config, NODES, processes=True) as graph:
        yield Bench(graph, picture)


# -- correct messages ----------------------------------------------------------------------------


def good_image(b):
    return CompressedImage(header=header_at(b.stamp(), "camera_optical"), format="jpeg", data=array("B", b.picture))


def good_pose2d(b):
    rng = np.random.default_rng(0)
    return Pose2D(
        header=header_at(b.stamp(), "camera_optical"), track_id=1, skeleton="body15", image_width=1280,
        image_height=720, roi=[400.0, 100.0, 800.0, 700.0], detection_score=0.9,
        keypoints=array("f", rng.uniform(300, 700, 30)), covariance=array("f", [4.0, 0.0, 4.0] * 15),
        confidence=array("f", [0.9] * 15),
    )  # fmt: skip


def good_pose3d(b, stage=Pose3D.INITIAL):
    rng = np.random.default_rng(1)
    message = Pose3D(
        header=header_at(b.stamp(), "camera_optical"), track_id=1, stage=stage, skeleton="body15",
        joints=array("f", rng.normal(size=45)), covariance=array("f", [0.01, 0.0, 0.0, 0.01, 0.0, 0.01] * 15),
        confidence=array("f", [0.9] * 15), reprojection_rms=2.0,
    )  # fmt: skip
    message.camera_orientation.w = NAN
    return message


def good_latest(b):
    return good_pose3d(b, Pose3D.REFINED)


def good_state(b):
    b.now_ns += 10**9  # the path takes a point a second at most
    message = VehicleState(header=header_at(b.now_ns, "map"), autopilot="px4", mode="OFFBOARD", position_ok=True)
    message.position_enu_m = [1.0, 2.0, 3.0]
    return message


def good_info(b):
    matrix = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    return camera_info_to_ros(header_at(b.stamp(), "camera_optical"), CameraModel(1280, 720, matrix))


def good_roi(_):
    return RegionOfInterest(x_offset=100, y_offset=50, width=300, height=400)


# -- faults of messages -------------------------------------------------------------------------------


def wrong_png(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(b"\0" * 1000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


BAD_IMAGES = {
    "empty": {"data": array("B")},
    "cut off": {"data": lambda b: array("B", b.picture[: len(b.picture) // 2])},
    "noise": {"data": array("B", np.random.default_rng(0).bytes(5000))},
    "60000x60000": {"data": array("B", wrong_png(60000, 60000))},
    "20000x20000": {"data": array("B", wrong_png(20000, 20000))},
}
BAD_POSE2D = {
    "29 of 30": {"keypoints": array("f", [1.0] * 29)},
    "none": {"keypoints": array("f")},
    "10^6 joints": {
        "keypoints": array("f", bytes(8_000_000)),
        "covariance": array("f", bytes(12_000_000)),
        "confidence": array("f", bytes(4_000_000)),
    },
    "inf": {"keypoints": array("f", [INF] * 30)},
    "inf covariance": {"covariance": array("f", [INF] * 45)},
    "no covariance": {"covariance": array("f")},
    "negative variance": {"covariance": array("f", [-1.0, 0.0, 1.0] * 15)},
    "confidence 7": {"confidence": array("f", [7.0] * 15)},
    "unknown joint set": {"skeleton": "octopus"},
    "joint set of other size": {"skeleton": "x" * 10000},
    "no image": {"image_width": 0},
    "arrays without a subject": {"track_id": 0},
}
BAD_POSE3D = {
    "44 of 45": {"joints": array("f", [1.0] * 44)},
    "10^6 joints": {"joints": array("f", bytes(12_000_000)), "confidence": array("f", bytes(4_000_000))},
    "inf": {"joints": array("f", [INF] * 45)},
    "short confidence": {"confidence": array("f", [1.0])},
    "unknown joint set": {"skeleton": "octopus"},
}
BAD_INFO = {
    "zeros": {"k": [0.0] * 9},
    "NaN": {"k": [NAN] * 9},
    "inf": {"k": [INF] * 9},
    "negative focal length": {"k": [-900.0, 0, 640, 0, -900, 360, 0, 0, 1]},
}

#: topic -> (nodes that take it, a message as it should be, changes that spoil it, what shows that a good one worked)
INPUTS = {
    CAMERA: (["image_ingest"], good_image, BAD_IMAGES, "image/compressed"),
    "image/compressed": (["pose_estimator"], good_image, BAD_IMAGES, "pose2d"),
    "roi": (["pose_estimator"], good_roi, {}, None),
    "pose2d": (
        ["initializer", "bundle_adjuster", "mavlink_bridge", "visualizer"],
        good_pose2d,
        BAD_POSE2D,
        "pose3d/initial",
    ),
    "pose3d/initial": (["bundle_adjuster", "visualizer"], good_pose3d, BAD_POSE3D, "markers/initial"),
    "pose3d/latest": (["visualizer"], good_latest, BAD_POSE3D, "markers/latest"),
    "vehicle/state": (["visualizer"], good_state, {}, "markers/camera_path"),
    "camera_info": (["mavlink_bridge"], good_info, BAD_INFO, None),
}


def spoilt(bench, good, changes):
    message = good(bench)
    for name, value in changes.items():
        setattr(message, name, value(bench) if callable(value) else value)
    return message


def check_it_works(bench, topic):
    """Correct messages still have their effect, and no node has ended."""
    _, good, _, sign = INPUTS[topic]
    if sign is None:
        bench.graph.spin_for(0.3)
        return
    bench.heard[sign].clear()
    for _ in range(100):
        bench.publishers[topic].publish(good(bench))
        bench.graph.spin_for(0.1)  # raises when a node has died
        if bench.heard[sign]:
            return
    pytest.fail(f"no {sign} for good messages on {topic}: {bench.values}")


@pytest.mark.parametrize("topic", [topic for topic, entry in INPUTS.items() if entry[2]])
def test_malformed_message_is_refused_counted_and_explained(bench, topic):
    nodes, good, wrong, _ = INPUTS[topic]
    check_it_works(bench, topic)
    bench.graph.spin_for(1.1)  # each node has reported its counts once more
    messages = [spoilt(bench, good, changes) for changes in wrong.values()]
    for stamp_ns in FAR_STAMPS.values():
        message = good(bench)
        message.header.stamp = stamp_to_ros(stamp_ns)
        messages.append(message)
    before = {node: bench.refused(node) for node in nodes}

    def refused():
        return [bench.refused(node) - before[node] for node in nodes]

    for message in messages:
        bench.publishers[topic].publish(message)
        bench.graph.spin_for(0.15 if "compressed" in topic else 0.05)
    bench.graph.spin_for(1.5)
    for _ in messages:  # a busy node passes over messages, as it may
        if min(refused()) >= len(messages):
            break
        bench.publishers[topic].publish(spoilt(bench, good, next(iter(wrong.values()))))
        bench.graph.spin_for(1.1)
    assert min(refused()) >= len(messages), dict(zip(nodes, refused(), strict=True))
    for node in nodes:
        assert topic in bench.values[node][Key.LAST_REFUSED]
        assert "expected" in bench.values[node][Key.LAST_REFUSED]
    check_it_works(bench, topic)


STRANGE = {
    "roi": [
        RegionOfInterest(),
        RegionOfInterest(x_offset=2**32 - 1, y_offset=2**32 - 1, width=2**32 - 1, height=2**32 - 1),
        RegionOfInterest(x_offset=5000, y_offset=5000, width=10, height=10),
        RegionOfInterest(width=1, height=2**32 - 1),
    ],
    "vehicle/state": [
        VehicleState(header=header_at(1, "map"), position_enu_m=[NAN] * 3),
        VehicleState(header=header_at(1, "map"), position_enu_m=[INF, 0.0, -INF]),
        VehicleState(header=header_at(1, "map"), mode="m" * 100_000, autopilot="", landed_state=255),
    ],
}


@pytest.mark.parametrize("topic", STRANGE)
def test_strange_message_ends_no_node(bench, topic):
    check_it_works(bench, topic)
    for message in STRANGE[topic]:
        bench.publishers[topic].publish(message)
        bench.graph.spin_for(0.1)
        if topic == "roi":
            bench.publishers["image/compressed"].publish(good_image(bench))
            bench.graph.spin_for(0.2)
    check_it_works(bench, topic)
    if topic == "roi":
        check_it_works(bench, "image/compressed")


MALFORMED_COMMANDS = [
    ({"command": 200}, ConditionCode.UNKNOWN_COMMAND),
    ({"radius_m": INF}, ConditionCode.VALUE_NOT_FINITE),
    ({"height_m": -INF}, ConditionCode.VALUE_NOT_FINITE),
    ({"radius_m": 6.0, "height_m": 2.0, "angular_speed_deg_s": INF}, ConditionCode.VALUE_NOT_FINITE),
    ({"radius_m": -5.0}, ConditionCode.RADIUS_TOO_SMALL),
    ({"radius_m": 1e30, "height_m": 1e30, "angular_speed_deg_s": 1e30}, ConditionCode.RADIUS_TOO_LARGE),
    ({"height_m": 1e30}, ConditionCode.HEIGHT_OUT_OF_RANGE),
    ({"angular_speed_deg_s": -1e30}, ConditionCode.SPEED_ABOVE_LIMIT),
    ({"stamp": Time(sec=5)}, ConditionCode.COMMAND_OUTDATED),
    ({"stamp": Time(sec=-(2**31), nanosec=2**32 - 1)}, ConditionCode.COMMAND_OUTDATED),
    ({"stamp": Time(sec=2**31 - 1, nanosec=2**32 - 1)}, ConditionCode.COMMAND_OUTDATED),
    ({"command": OrbitCommand.Request.ADJUST}, ConditionCode.NO_ORBIT_TO_ADJUST),
    # As it should be: validation passes, and the silent link is the reason of the refusal.
    ({}, ConditionCode.LINK_SILENT),
]


@pytest.mark.parametrize(("values", "code"), MALFORMED_COMMANDS)
def test_malformed_orbit_command_is_refused_with_its_code(bench, values, code):
    statuses = bench.heard["orbit/status"]
    client = bench.graph.node.create_client(OrbitCommand, "orbit/command")
    bench.graph.wait_until(client.service_is_ready, 10, "the service of the bridge")
    given = {"radius_m": NAN, "height_m": NAN, "angular_speed_deg_s": NAN, "command": OrbitCommand.Request.START}
    statuses.clear()
    answer = client.call_async(OrbitCommand.Request(**{**given, **values}))
    bench.graph.wait_until(answer.done, 10, "an answer")
    response = answer.result()
    assert (response.accepted, ConditionCode(response.condition)) == (False, code)
    assert response.words
    bench.graph.wait_until(lambda: any(m.command_answer == response.words for m in statuses), 10, "a status")
    status = next(m for m in statuses if m.command_answer == response.words)
    assert (status.state, status.command) == (OrbitStatus.IDLE, values.get("command", given["command"]))
    assert (status.command_accepted, status.command_condition) == (False, code)
    assert status.command_stamp == values.get("stamp", Time())
    bench.graph.node.destroy_client(client)


def test_unknown_joints_are_not_refused(bench):
    bench.graph.spin_for(2.0)  # until the refusals of the tests before are published
    before = [bench.refused(node) for node in INPUTS["pose2d"][0]]
    for _ in range(5):
        message = good_pose2d(bench)
        message.keypoints = array("f", [NAN] * 30)
        message.covariance = array("f", [NAN] * 45)
        message.confidence = array("f", [NAN] * 15)
        bench.publishers["pose2d"].publish(message)
        bench.graph.spin_for(0.05)
    bench.graph.spin_for(1.2)
    assert [bench.refused(node) for node in INPUTS["pose2d"][0]] == before
    check_it_works(bench, "pose2d")


def test_recorder_has_written_the_messages(bench):
    values = bench.values["session_recorder"]
    assert int(values[Key.WRITTEN]) > 100
    assert not any(key.startswith(of(Key.NOT_WRITTEN, "/drocap/pose")) for key in values)
