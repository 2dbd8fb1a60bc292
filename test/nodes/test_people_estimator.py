"""Several persons live: the graph with ``people`` on a rendered scene of three."""

from __future__ import annotations

from collections import Counter, defaultdict
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from people_scenes import PeopleScene, camera_of, images_of, people_of

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session import header_stamp_ns
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.diagnostics import Key, node_of, values_of
from drocap_ros.ros.topics import NODES, TOPICS, with_people

hri = pytest.importorskip("hri_msgs.msg", reason="hri_msgs are not built: `make setup` builds them")

SCENE = PeopleScene("walk", 3, duration_s=4.0, rate_hz=12.5, distance_m=7.0, orbit=False)
LIVE = ["image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "visualizer", "session_recorder"]
TRUTH = [camera_of(SCENE).pixels(person) for person in people_of(SCENE)]
#: Of the scene's images those before two cross, and at which rate they come.
FRAMES, RATE_HZ = 15, 4.0
SCALE = 0.5
PERSONS = ("", "person_2/", "person_3/")


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
    """Three who walk some steps and go back: repeated, a walk without an end."""
    folder = tmp_path_factory.mktemp("three")
    ahead = [cv2.resize(f.image, None, fx=SCALE, fy=SCALE) for f in images_of(SCENE, people_of(SCENE))][:FRAMES]
    for i, image in enumerate(ahead + ahead[-2:0:-1]):
        cv2.imwrite(str(folder / f"{i:03d}.png"), image)
    return folder


def test_three_persons_have_topics_of_their_own(images: Path, tmp_path: Path):
    config = DrocapConfig().replace("image_ingest", source=str(images), folder_rate_hz=RATE_HZ, loop=True)
    config = config.replace("pose_estimator", models_dir="simulation", people=3, max_load_level=0)
    # A busy machine leaves out images of the others.
    config = config.replace("initializer", gap_s=3.0).replace("bundle_adjuster", gap_s=3.0, period_s=4.0)
    config = config.replace("visualizer", human_topics=True)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "session"))
    tracked, followed = [], set()
    arrived = Counter()

    def take(message):
        found = {node_of(s)[1]: values_of(s) for s in message.status}
        followed.add(found.get("people_estimator", {}).get(Key.FOLLOWED, ""))

    with bringup(config, LIVE, processes=True) as graph:
        hear = partial(graph.node.create_subscription, qos_profile=TOPICS["pose2d"].qos)
        hear(TOPICS["/diagnostics"].message, "/diagnostics", take)
        hear(hri.IdsList, "/humans/bodies/tracked", lambda m: tracked.append(set(m.ids)))
        wanted = [f"{person}pose3d/{of}" for person in PERSONS for of in ("initial", "refined")]
        for topic in wanted:
            hear(TOPICS[topic].message, topic, lambda _, topic=topic: arrived.update([topic]))
        graph.wait_until(
            lambda: all(arrived[t] >= (1 if t.endswith("refined") else 12) for t in wanted), 120, "poses of three"
        )
    assert {"b1", "b1001", "b1002"} in tracked
    assert "1001, 1002" in followed
    with open_session(tmp_path / "session") as session:
        assert {t.name for t in session.info.topics} >= {f"/drocap/{topic}" for topic in TOPICS if topic[0] != "/"}
        begin_ns = min(header_stamp_ns(m) for _, m in session.messages(["/drocap/image/compressed"]))
        off = defaultdict(list)
        for person in PERSONS:
            seen = [m for _, m in session.messages([f"/drocap/{person}pose2d"]) if m.track_id]
            assert all((m.track_id > 1000) == bool(person) for m in seen)
            own = {m.track_id for m in seen}
            for message in seen:
                image = round((header_stamp_ns(message) - begin_ns) * 1e-9 * RATE_HZ) % (2 * FRAMES - 2)
                off[message.track_id].append(_off(message, min(image, 2 * FRAMES - 2 - image)))
            initial = [m for _, m in session.messages([f"/drocap/{person}pose3d/initial"])]
            assert {m.track_id for m in initial} == own
            windows = [m for _, m in session.messages([f"/drocap/{person}pose3d/refined"])]
            assert {pose.track_id for m in windows for pose in m.poses} <= own
        # Each of the three persons has a number, those that a busy machine loses have a further one later.
        owners = [int(np.nanmedian(off[number], axis=0).argmin()) for number in (1, 1001, 1002)]
        assert sorted(owners) == [0, 1, 2]
        for number, owner in zip((1, 1001, 1002), owners, strict=True):
            assert np.nanmedian(np.array(off[number])[:, owner]) < 6.0
        # Whoever reads the session finds the subject, without being told.
        subject = [m.track_id for _, m in session.messages(["/drocap/pose2d"])]
        assert len(read_pose2d(session)) == len(subject)
        assert not any("several topics" in warning for warning in session.warnings)


def _off(message, frame: int) -> list[float]:
    """px, median distance of a message's keypoints from each person's joints in an image of the scene."""
    xy = np.reshape(message.keypoints, (-1, 2))[:15]
    seen = np.isfinite(xy).all(axis=1)
    distances = [np.linalg.norm(xy - SCALE * person[frame], axis=1)[seen] for person in TRUTH]
    return [float(np.median(values)) if seen.any() else np.nan for values in distances]
