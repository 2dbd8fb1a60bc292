"""Initializer and bundle adjuster in the running graph, through all events of a stream."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from telemetry_stream import orbit

from drocap_ros.background import FixedPoints
from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.flight.vehicle import OPTICAL_FROM_FLU, VehicleState
from drocap_ros.geometry.rotations import quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.perception.calibration import CameraModel
from drocap_ros.recording.open_session import open_session
from drocap_ros.ros.conversions import (
    background_to_ros,
    camera_info_to_ros,
    header_at,
    pose2d_to_ros,
    pose3d_to_ros,
    stamp_from_ros,
    vehicle_state_to_ros,
)
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import TOPICS
from drocap_ros.simulation.capture import simulate_capture

NODES = ("initializer", "bundle_adjuster", "session_recorder")
S = 10**9
BEGIN = 1_790_000_000 * S


def observed(seconds, track_id=1, begin_ns=BEGIN, seed=0):
    tracks = simulate_capture(seconds, 20.0, seed=seed).tracks
    return [
        PoseObservation(
            begin_ns + int(stamp - tracks.stamp_ns[0]),
            track_id,
            tracks.image_size,
            keypoints=tracks.keypoints[i].astype(np.float32),
            covariance=tracks.covariance[i].astype(np.float32),
            confidence=tracks.confidence[i].astype(np.float32),
        )
        for i, stamp in enumerate(tracks.stamp_ns)
    ]


def eventful():
    """A stream with a duplicate, a late, a stray and a blind image, a gap, a second round, other subjects."""
    first = observed(3.0)
    unseen = {"keypoints": np.full((15, 2), np.nan), "covariance": np.full((15, 3), np.nan), "confidence": np.zeros(15)}
    unseen = {name: values.astype(np.float32) for name, values in unseen.items()}
    blind = replace(first[29], stamp_ns=first[29].stamp_ns + 1, **unseen)
    stray = observed(0.05, begin_ns=BEGIN + 600 * S)[:1]  # farther away StampValidator refuses it
    gap = observed(2.0, begin_ns=BEGIN + 6 * S, seed=1)
    other = observed(2.5, track_id=2, begin_ns=BEGIN + 3 * S, seed=2)
    hidden = [replace(o, track_id=3, stamp_ns=o.stamp_ns + 20 * S, **unseen) for o in first[:12]]
    return [*first[:30], first[29], first[20], *stray, blind, *first[30:], *gap, *first, *other, *hidden]


def fly(folder, observations, pause_s=0.035, **adjuster):
    """Publish the observations to a recorded graph; gives latest poses, windows and what /diagnostics counted."""
    config = DrocapConfig().replace("session_recorder", session_dir=str(folder))
    config = config.replace("bundle_adjuster", period_s=0.5, window_s=4.0, **adjuster)
    seen = {topic: [] for topic in ("pose3d/initial", "pose3d/latest", "pose3d/refined", "/diagnostics")}
    with bringup(config, NODES) as graph:
        for topic, messages in seen.items():
            graph.node.create_subscription(TOPICS[topic].message, topic, messages.append, TOPICS[topic].qos)
        publisher = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", TOPICS["pose2d"].qos)
        graph.wait_until(lambda: publisher.get_subscription_count() == 3, 20, "the nodes to listen")
        for observation in observations:
            publisher.publish(pose2d_to_ros(observation, "camera"))
            graph.spin_for(pause_s)
        last = observations[-1].stamp_ns
        graph.wait_until(
            lambda: any(stamp_from_ros(m.header.stamp) == last for m in seen["pose3d/latest"][-1:]), 30, "the last pose"
        )
        reports = len(seen["/diagnostics"])
        graph.wait_until(lambda: len(seen["/diagnostics"]) > reports + 6, 20, "the counts on /diagnostics")
    counts = {}
    for message in seen["/diagnostics"]:
        for status in message.status:
            counts.setdefault(status.name.rsplit("/", 1)[-1], {}).update({v.key: v.value for v in status.values})
    return seen, counts


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("events") / "session"
    return folder, *fly(folder, eventful())


def test_each_event_is_counted_by_its_key(flown):
    _, _, counts = flown
    found = counts["initializer"]
    assert found["stream_event/duplicate"] == "1"
    assert found["stream_event/late"] == "1"
    # Ten minutes ahead, and the first image of the second round, which alone could be a stray as well.
    assert found["stream_event/stray"] == "2"
    assert found["stream_event/time_jump"] == "1"
    assert found["stream_event/new_subject"] == "2"
    assert found["stream_event/gap"] == "1"
    assert found[Key.IMAGES_INCOMPLETE] == "13"
    adjuster = counts["bundle_adjuster"]
    assert adjuster["stream_event/time_jump"] == "1"
    assert adjuster["stream_event/new_subject"] == "2"
    assert int(adjuster[Key.ADJUSTMENTS]) >= 6
    # A window without keypoints cannot be adjusted.
    assert adjuster[Key.ADJUSTMENTS_FAILED] == "1"


def test_every_initial_pose_has_a_latest_pose(flown):
    _, seen, _ = flown
    stamps = [[stamp_from_ros(m.header.stamp) for m in seen[t]] for t in ("pose3d/initial", "pose3d/latest")]
    assert stamps[0] == stamps[1]
    # Of 60 + 40 + 60 + 50 + 12 images and the blind one, the second round's first was dropped.
    assert len(stamps[0]) == 222
    stages = {m.stage for m in seen["pose3d/latest"]}
    assert stages == {TOPICS["pose3d/latest"].message.INITIAL, TOPICS["pose3d/latest"].message.REFINED}


def test_no_window_mixes_subjects_or_rounds(flown):
    _, seen, _ = flown
    for window in seen["pose3d/refined"]:
        stamps = np.array([stamp_from_ros(pose.header.stamp) for pose in window.poses])
        assert (np.diff(stamps) > 0).all()
        assert len({pose.track_id for pose in window.poses}) == 1
        assert stamps[-1] - stamps[0] < 3 * S
        assert np.diff(stamps).max() < S


@pytest.mark.parametrize("late", [False, True], ids=["in time", "always late"])
def test_the_recording_repeats_the_windows_bit_for_bit(flown, tmp_path, late):
    folder = flown[0]
    if late:
        folder = tmp_path / "session"
        seen, counts = fly(folder, observed(4.0), pause_s=0.045, max_solve_s=0.01, max_stride=2)
        assert int(counts["bundle_adjuster"][Key.ADJUSTMENTS_CUT]) >= 2
        assert any(window.steps for window in seen["pose3d/refined"])
        assert any(window.stride == 2 for window in seen["pose3d/refined"])
    with open_session(folder) as session:
        _, _, agreement = reconstruct_live(session, recorded_config(session))
    assert agreement.initial[0] == agreement.initial[1] >= 80
    assert agreement.windows[0] == agreement.windows[1] >= 4


@pytest.fixture(scope="module")
def orbited(tmp_path_factory):
    """An orbit whose telemetry ends before its images; the session, the messages and the texts of /diagnostics."""
    folder, flown = tmp_path_factory.mktemp("orbit") / "session", orbit(14.0, begin_ns=BEGIN)
    config = DrocapConfig().replace("session_recorder", session_dir=str(folder))
    # A busy machine takes its time here, instead of every fourth image.
    config = config.replace("bundle_adjuster", max_solve_s=5.0)
    seen = {topic: [] for topic in ("pose3d/latest", "pose3d/refined", "/diagnostics")}
    width, height = flown.observations[0].image_size
    camera = CameraModel(width, height, flown.matrix)
    gimbal = quaternion_from_matrix(np.swapaxes(OPTICAL_FROM_FLU.T @ flown.rotation, 1, 2))
    with bringup(config, NODES) as graph:
        for topic, messages in seen.items():
            graph.node.create_subscription(TOPICS[topic].message, topic, messages.append, TOPICS[topic].qos)
        publishers = {
            topic: graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
            for topic in ("pose2d", "vehicle/state", "camera_info", "background")
        }
        graph.wait_until(
            lambda: [p.get_subscription_count() for p in publishers.values()] == [3, 2, 2, 2],
            20,
            "the nodes to listen",
        )
        for i, observation in enumerate(flown.observations):
            stamp_ns = observation.stamp_ns
            if stamp_ns < BEGIN + 9.2 * S:
                state = VehicleState(stamp_ns, position_enu_m=flown.position[i], gimbal_orientation_xyzw=gimbal[i])
                publishers["vehicle/state"].publish(vehicle_state_to_ros(state))
            publishers["camera_info"].publish(camera_info_to_ros(header_at(stamp_ns, "camera"), camera))
            seen_here = flown.background.frame == i
            points = FixedPoints(flown.background.track[seen_here], flown.background.point[seen_here])
            publishers["background"].publish(background_to_ros(points, header_at(stamp_ns, "camera")))
            publishers["pose2d"].publish(pose2d_to_ros(observation, "camera"))
            graph.spin_for(0.066)
        reports = len(seen["/diagnostics"])
        graph.wait_until(lambda: len(seen["/diagnostics"]) > reports + 6, 20, "the counts on /diagnostics")
    texts = [s for m in seen["/diagnostics"] for s in m.status if s.name.endswith("bundle_adjuster")]
    return folder, flown, seen, texts


def test_poses_with_telemetry_are_in_map_and_metric_until_it_stops(orbited):
    _, flown, seen, texts = orbited
    place = {int(stamp): i for i, stamp in enumerate(flown.stamp_ns)}
    frames = [window.header.frame_id for window in seen["pose3d/refined"]]
    assert frames[0] == frames[-1] == "camera"
    assert "map" in frames
    for window in seen["pose3d/refined"]:
        in_map = window.header.frame_id == "map"
        assert {(pose.header.frame_id, pose.metric) for pose in window.poses} == {(window.header.frame_id, in_map)}
        assert in_map == all(np.isfinite(pose.camera_orientation.w) for pose in window.poses)
    assert {m.header.frame_id for m in seen["pose3d/latest"]} == {"camera", "map"}
    placed = [m for m in seen["pose3d/latest"] if m.header.frame_id == "map"]
    off = [
        np.linalg.norm(np.reshape(m.joints, (-1, 3))[0] - flown.truth[place[stamp_from_ros(m.header.stamp)], 0])
        for m in placed
    ]
    assert np.median(off) < 0.4
    assert all(m.metric and np.isfinite(m.camera_orientation.w) for m in placed)
    # 0.1 s after the last state there is no camera pose to hold.
    assert max(stamp_from_ros(m.header.stamp) for m in placed) < BEGIN + 9.4 * S
    used = [{v.key: v.value for v in status.values} for status in texts]
    assert {"used", "late"} <= {values.get(Key.TELEMETRY) for values in used}
    assert any("yaw" in values.get(Key.CALIBRATION, "") for values in used)
    assert any(window.background_stamp.sec for window in seen["pose3d/refined"])
    assert used[-1][Key.FRAME] == "camera"
    assert texts[-1].level == b"\1"
    assert "no reported camera pose" in texts[-1].message


def test_the_recording_of_windows_in_map_repeats_them_bit_for_bit(orbited):
    folder = orbited[0]
    with open_session(folder) as session:
        motion, _, agreement = reconstruct_live(session, recorded_config(session))
        assert session.warnings == []
    windows = len(orbited[2]["pose3d/refined"])
    assert agreement.initial == [210, 210]
    assert agreement.windows[0] >= windows >= 5
    assert agreement.windows[0] == agreement.windows[1]
    # The windows after the end of the telemetry hold older images too, whose poses stay in the world.
    placed = {stamp_from_ros(p.header.stamp) for w in orbited[2]["pose3d/refined"] for p in w.poses if p.metric}
    if 2 * len(placed) >= agreement.initial[0]:
        assert (motion.frame, motion.metric) == ("world", True)
        assert set(motion.stamp_ns.tolist()) == placed
    else:
        assert (motion.frame, len(motion.stamp_ns)) == ("camera", 210)


def initial_pose(observation, track_id, joints, skeleton=None):
    """An initial pose of 0, 15 or 17 joints."""
    return pose3d_to_ros(
        header_at(observation.stamp_ns, "camera"),
        track_id=track_id,
        stage=1,
        skeleton=skeleton or f"body{joints or 15}",
        joints=np.random.default_rng(joints).normal(size=(joints, 3)),
        covariance=np.zeros((joints, 6)),
        confidence=np.ones(joints),
        reprojection_rms_px=1.0,
    )


def test_initial_poses_of_another_subject_and_of_other_joints_do_not_end_the_node():
    config = DrocapConfig().replace("bundle_adjuster", period_s=0.3, window_s=4.0, blend_s=1.0)
    latest, reports = [], []
    with bringup(config, ["bundle_adjuster"]) as graph:
        publishers = {}
        for topic in ("pose2d", "pose3d/initial"):
            publishers[topic] = graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
        for topic, into in (("pose3d/latest", latest), ("/diagnostics", reports)):
            graph.node.create_subscription(TOPICS[topic].message, topic, into.append, TOPICS[topic].qos)
        graph.wait_until(lambda: all(p.get_subscription_count() for p in publishers.values()), 20, "the node to listen")

        def publish(observation, *pose):
            publishers["pose2d"].publish(pose2d_to_ros(observation, "camera"))
            publishers["pose3d/initial"].publish(initial_pose(observation, *pose))
            graph.spin_for(0.12)  # raises the error of the node

        # Windows of fifteen and of seventeen joints in turn: a gap empties the window.
        taken = [o for burst in range(4) for o in observed(1.0, begin_ns=BEGIN + 3 * S * burst)[::2]]
        for i, observation in enumerate(taken):
            publish(observation, 1, (15, 17)[i // 10 % 2])
        for observation, pose in zip(
            observed(0.3, begin_ns=BEGIN + 14 * S), [(1, 17, "coco17"), (0, 0), (2, 15)], strict=False
        ):
            publish(observation, *pose)
        graph.wait_until(lambda: len(latest) == len(taken), 10, "the latest poses")
        count = len(reports)
        graph.wait_until(lambda: len(reports) > count + 1, 10, "the counts on /diagnostics")
    values = {v.key: v.value for v in reports[-1].status[0].values}
    assert int(values[Key.ADJUSTMENTS]) >= 4
    assert values[Key.MESSAGES_REFUSED] == "3"
    assert "track_id: expected 1 in pose3d/initial" in values[Key.LAST_REFUSED]
