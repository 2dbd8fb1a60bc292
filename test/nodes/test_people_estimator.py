"""Several persons live: the graph with ``people`` on a rendered scene of three."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from people_scenes import PeopleScene, camera_of, images_of, people_of

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.diagnostics import Key, node_of, values_of
from drocap_ros.ros.topics import NODES, TOPICS, with_people

hri = pytest.importorskip("hri_msgs.msg", reason="hri_msgs are not built: `make setup` builds them")

SCENE = PeopleScene("walk", 3, duration_s=4.0, rate_hz=12.5, distance_m=7.0, orbit=False)
LIVE = ["image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "visualizer", "session_recorder"]
SCALE = 0.5


def test_nodes_of_others_come_with_people_and_only_then():
    names = [name for name, entry in NODES.items() if entry.live]
    assert with_people(names, 1) == names
    added = set(with_people(names, 2)) - set(names)
    assert added == {"people_estimator", "initializer_2", "bundle_adjuster_2"}
    assert len(with_people(names, 3)) == len(names) + 5
    assert with_people(["initializer"], 3) == ["initializer"]


def test_whatever_is_for_others_gives_way_to_what_is_for_the_subject():
    subject = [NODES[name].niceness for name in ("pose_estimator", "initializer", "mavlink_bridge", "image_ingest")]
    added = set(with_people(LIVE, 3)) - set(LIVE)
    assert min(NODES[name].niceness for name in added) > max(subject)
    assert NODES["bundle_adjuster_2"].niceness > NODES["bundle_adjuster"].niceness
    # The bridge hears of nobody else.
    assert not any(topic.startswith("person_") for topic in NODES["mavlink_bridge"].subscribes)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("three")
    for i, frame in enumerate(images_of(SCENE, people_of(SCENE))):
        small = cv2.resize(frame.image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{i:03d}.png"), small)
    return folder


def test_three_persons_have_topics_of_their_own(images: Path, tmp_path: Path):
    config = DrocapConfig().replace("image_ingest", source=str(images), folder_rate_hz=3.0)
    config = config.replace("pose_estimator", models_dir="simulation", people=3, max_load_level=0)
    # A busy machine leaves out images of the others.
    config = config.replace("initializer", gap_s=3.0).replace("bundle_adjuster", gap_s=3.0, period_s=4.0)
    config = config.replace("visualizer", human_topics=True)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "session"))
    tracked, followed = [], set()

    def take(message):
        found = {node_of(s)[1]: values_of(s) for s in message.status}
        followed.add(found.get("people_estimator", {}).get(Key.FOLLOWED, ""))

    with bringup(config, LIVE, processes=True) as graph:
        entry = TOPICS["/diagnostics"]
        graph.node.create_subscription(entry.message, "/diagnostics", take, entry.qos)
        graph.node.create_subscription(hri.IdsList, "/humans/bodies/tracked", lambda m: tracked.append(m.ids), 10)
        graph.wait_finished("image_ingest", timeout_s=90)
        graph.spin_for(2.0)
    assert "1001, 1002" in followed
    assert {"b1", "b1001", "b1002"} in map(set, tracked)
    truth = [SCALE * camera_of(SCENE).pixels(person) for person in people_of(SCENE)]
    with open_session(tmp_path / "session") as session:
        assert {t.name for t in session.info.topics} >= {f"/drocap/{topic}" for topic in TOPICS if topic[0] != "/"}
        stamps = [m.header.stamp for _, m in session.messages(["/drocap/image/compressed"])]
        frames = {(s.sec, s.nanosec): i for i, s in enumerate(stamps)}
        off = defaultdict(list)
        for person in ("", "person_2/", "person_3/"):
            own = set()
            for _, message in session.messages([f"/drocap/{person}pose2d"]):
                if message.track_id:
                    stamp = message.header.stamp
                    off[message.track_id].append(_off(message, truth, frames[stamp.sec, stamp.nanosec]))
                    own.add(message.track_id)
            assert all((track_id > 1000) == bool(person) for track_id in own)
            initial = [m for _, m in session.messages([f"/drocap/{person}pose3d/initial"])]
            assert {m.track_id for m in initial} == own
            windows = [m for _, m in session.messages([f"/drocap/{person}pose3d/refined"])]
            assert windows
            assert {pose.track_id for m in windows for pose in m.poses} <= own
        # All three persons have a number.
        owners = {number: int(np.nanmedian(values, axis=0).argmin()) for number, values in off.items()}
        assert set(owners.values()) == {0, 1, 2}
        # A busy machine may lose a person, who then has a further number for a moment.
        for number in (1, 1001, 1002):
            assert np.nanmedian(np.array(off[number])[:, owners[number]]) < 6.0
        # Whoever reads the session finds the subject, without being told.
        assert len(read_pose2d(session)) == len(stamps)
        assert not any("several topics" in warning for warning in session.warnings)


def _off(message, truth, frame: int) -> list[float]:
    """px, median distance of a message's keypoints from each person's joints in an image."""
    xy = np.reshape(message.keypoints, (-1, 2))[:15]
    seen = np.isfinite(xy).all(axis=1)
    return [
        float(np.median(np.linalg.norm(xy - person[frame], axis=1)[seen])) if seen.any() else np.nan for person in truth
    ]
