"""Publishers of images, poses and telemetry at full rate, and the resources of a process."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

CLOCK_TICKS = os.sysconf("SC_CLK_TCK")
PAGE_MIB = os.sysconf("SC_PAGE_SIZE") / 2**20


def make_sources(node: Any) -> list[tuple[Any, Any, float, str]]:
    """(publisher, function of a number -> message, Hz, topic)."""
    import cv2
    import numpy as np

    from drocap_ros.keypoints import PoseObservation
    from drocap_ros.msg import VehicleState
    from drocap_ros.perception.sources.image_files import encode_jpeg
    from drocap_ros.ros.conversions import header_at, pose2d_to_ros
    from drocap_ros.ros.topics import TOPICS
    from lab.simulation.capture import simulate_capture

    tracks = simulate_capture(2.0, 30.0, 0).tracks
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 255, (720, 1400, 3), dtype=np.uint8), (0, 0), 4)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    jpegs = [encode_jpeg(np.ascontiguousarray(scene[:, i : i + 1280]), 90) for i in range(0, 100, 10)]

    def image(i: int) -> Any:
        return TOPICS["image/compressed"].message(
            header=header_at(time.time_ns(), "camera_optical"), format="jpeg", data=jpegs[i % len(jpegs)]
        )

    def pose(i: int) -> Any:
        i %= len(tracks)
        seen = (tracks.keypoints[i], tracks.covariance[i], tracks.confidence[i])
        keypoints, covariance, confidence = (values.astype(np.float32) for values in seen)
        observation = PoseObservation(
            time.time_ns(), 1, tracks.image_size, keypoints=keypoints, covariance=covariance, confidence=confidence
        )
        return pose2d_to_ros(observation, "camera_optical")

    def state(_: int) -> Any:
        return VehicleState(header=header_at(time.time_ns(), "map"), autopilot="px4", mode="OFFBOARD")

    kinds = (("image/compressed", image, 30.0), ("pose2d", pose, 30.0), ("vehicle/state", state, 50.0))
    return [
        (
            node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].offered or TOPICS[topic].qos),
            make,
            hz,
            topic,
        )
        for topic, make, hz in kinds
    ]


def publish_all(sources: list[tuple[Any, Any, float, str]], begin: float, seconds: float) -> dict[str, int]:
    sent = dict.fromkeys((topic for *_, topic in sources), 0)
    while True:
        due, publisher, make, topic = min(
            ((begin + sent[topic] / hz, p, make, topic) for p, make, hz, topic in sources), key=lambda entry: entry[0]
        )
        if due - begin >= seconds:
            return sent
        time.sleep(max(0.0, due - time.monotonic()))
        publisher.publish(make(sent[topic]))
        sent[topic] += 1


def watch_process(pid: int, begin: float, seconds: float, usage: list[tuple[float, float]]) -> None:
    while time.monotonic() - begin < seconds:
        time.sleep(1.0)
        usage.append(process_usage(pid))


def process_usage(pid: int) -> tuple[float, float]:
    """Processor seconds and resident MiB so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS, pages * PAGE_MIB
