"""Life cycle of managed nodes."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.nodes.image_ingest import ImageIngestNode
from drocap_ros.recording.open_session import session_info
from drocap_ros.ros.topics import TOPICS

NAMES = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "square.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (320, 240))
    for i in range(40):
        writer.write(np.full((240, 320, 3), 2 * i, np.uint8))
    writer.release()
    return path


def call(graph, kind, service, request):
    client = graph.node.create_client(kind, service)
    graph.wait_until(client.service_is_ready, 10, service)
    future = client.call_async(request)
    graph.wait_until(future.done, 20, f"an answer of {service}")
    return future.result()


def change(graph, node, transition):
    request = ChangeState.Request(transition=Transition(id=NAMES[transition]))
    return call(graph, ChangeState, f"{node}/change_state", request).success


def state(graph, node):
    return call(graph, GetState, f"{node}/get_state", GetState.Request()).current_state.label


def holds(pid, path):
    return any(os.path.realpath(fd) == str(path) for fd in Path(f"/proc/{pid}/fd").iterdir())


def test_source_and_session_are_released_and_acquired_again(video, tmp_path):
    config = DrocapConfig().replace("image_ingest", source=str(video), loop=True)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "session"))
    images = []
    with bringup(config, ["image_ingest", "session_recorder"], processes=True) as graph:
        entry = TOPICS["image/compressed"]
        graph.node.create_subscription(entry.message, "image/compressed", images.append, entry.qos)
        graph.wait_until(lambda: images, 20, "pictures")
        assert state(graph, "image_ingest") == "active"
        assert holds(graph.pid("image_ingest"), video)

        # Silent, with the source kept.
        assert change(graph, "image_ingest", "deactivate")
        graph.spin_for(0.3)
        images.clear()
        graph.spin_for(0.5)
        assert not images
        assert holds(graph.pid("image_ingest"), video)
        assert change(graph, "image_ingest", "activate")
        graph.wait_until(lambda: images, 10, "pictures again")

        # A transition that the state does not allow is refused, and the node lives on.
        assert not change(graph, "image_ingest", "activate")
        assert not change(graph, "image_ingest", "cleanup")

        # Released; while the source is away it cannot be configured.
        assert change(graph, "image_ingest", "deactivate")
        assert change(graph, "image_ingest", "cleanup")
        assert not holds(graph.pid("image_ingest"), video)
        away = video.rename(tmp_path / "away.mp4")
        assert not change(graph, "image_ingest", "configure")
        assert state(graph, "image_ingest") == "unconfigured"
        away.rename(video)
        assert change(graph, "image_ingest", "configure")
        images.clear()
        assert change(graph, "image_ingest", "activate")
        graph.wait_until(lambda: images, 10, "pictures once more")

        # The recorder finishes its session and begins another one.
        assert change(graph, "session_recorder", "deactivate")
        assert change(graph, "session_recorder", "cleanup")
        first = session_info(tmp_path / "session")
        assert not first.warnings
        assert change(graph, "session_recorder", "configure")
        assert change(graph, "session_recorder", "activate")
        graph.spin_for(1.5)
    counts = {t.name: t.count for t in session_info(tmp_path / "session_2").topics}
    assert counts["/drocap/image/compressed"] > 5


def test_networks_are_released_and_loaded_again(video, shared):
    config = DrocapConfig().replace("image_ingest", source=str(video), loop=True)
    config = config.replace("pose_estimator", models_dir=str(shared / "models"))
    poses = []
    with bringup(config, ["image_ingest", "pose_estimator"]) as graph:
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", poses.append, TOPICS["pose2d"].qos)
        graph.wait_until(lambda: poses, 20, "keypoints")
        for transition in ("deactivate", "cleanup"):
            assert change(graph, "pose_estimator", transition)
        graph.spin_for(0.3)
        poses.clear()
        graph.spin_for(0.5)
        assert not poses
        for transition in ("configure", "activate"):
            assert change(graph, "pose_estimator", transition)
        graph.wait_until(lambda: poses, 10, "keypoints again")


def test_any_error_of_a_first_configuration_ends_the_start_at_once(video, monkeypatch):
    def acquire(_):
        raise RuntimeError("the driver is broken")

    monkeypatch.setattr(ImageIngestNode, "acquire", acquire)
    config = DrocapConfig().replace("image_ingest", source=str(video))
    with pytest.raises(RuntimeError, match="driver is broken"), bringup(config, ["image_ingest"], timeout_s=5.0):
        pass


@pytest.mark.parametrize("processes", [False, True], ids=["one process", "a process each"])
def test_source_that_has_ended_is_finalized(video, processes):
    config = DrocapConfig().replace("image_ingest", source=str(video))
    with bringup(config, ["image_ingest"], processes=processes) as graph:
        graph.wait_finished("image_ingest", timeout_s=20)
        assert state(graph, "image_ingest") == "finalized"


def test_deactivated_source_has_not_finished(video):
    config = DrocapConfig().replace("image_ingest", source=str(video), loop=True)
    with bringup(config, ["image_ingest"]) as graph:
        assert change(graph, "image_ingest", "deactivate")
        graph.spin_for(1.5)
        assert state(graph, "image_ingest") == "inactive"
        assert not graph.finished
