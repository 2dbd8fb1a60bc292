"""Joints of overlapping bodies: each goes to one body or to none."""

from __future__ import annotations

import numpy as np
from people_scenes import PeopleScene, camera_of, people_of

from drocap_ros.perception.pose.body_pose import BodyPose
from drocap_ros.perception.pose.pose_model import NetworkKeypoints
from drocap_ros.perception.tracking.own_joints import ExpectedJoints, Poses, own_joints
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.subject import SubjectTracker
from drocap_ros.skeleton import BODY_15

SCENE = PeopleScene("cross", 1)
TIMES = 10**9 + np.round(SCENE.times * 1e9).astype(np.int64)
TRUTH = [camera_of(SCENE).pixels(joints) for joints in people_of(SCENE)]
GREY = np.full((15, 3), 128.0)


def pose_of(xy: np.ndarray) -> BodyPose:
    network = NetworkKeypoints("body15", xy, np.ones(15), np.zeros((15, 3)), np.zeros(15), 100.0)
    return BodyPose(xy.astype(float), np.ones((15, 3)), np.full(15, 0.95), network)


def tracks_up_to(frame: int, who: tuple[int, ...]) -> list[ExpectedJoints]:
    """Tracks that have seen every image before ``frame`` and expect the joints in it."""
    found = []
    for k in who:
        xy = TRUTH[k]
        track = ExpectedJoints(pose_of(xy[0]), BODY_15, int(TIMES[0]))
        for i in range(1, frame):
            track.predict(int(TIMES[i]))
            track.accept(xy[i], np.ones(15, bool), believed=True)
        track.predict(int(TIMES[frame]))
        found.append(track)
    return found


def nearest(a: int, b: int) -> int:
    """Frame in which two persons' pelvises are nearest in the image."""
    return int(np.linalg.norm(TRUTH[a][:, 0] - TRUTH[b][:, 0], axis=1)[5:].argmin()) + 5


def poses(*xy: np.ndarray) -> Poses:
    return Poses(np.array(xy), np.full((len(xy), 15), 0.95), np.tile(GREY, (len(xy), 1, 1)))


def test_own_poses_stay_with_their_bodies_where_two_cross() -> None:
    for frame, least in ((nearest(0, 1), 0.6), (nearest(0, 1) - 3, 0.85)):  # joints at one place are nobody's
        pose, joint = own_joints(tracks_up_to(frame, (0, 1)), poses(TRUTH[0][frame], TRUTH[1][frame]))
        assert pose.tolist() == [0, 1]
        for k in (0, 1):
            assert (joint[k] >= 0).mean() > least
            assert not (joint[k] == 1 - k).any()


def test_poses_that_the_boxes_exchanged_go_back() -> None:
    frame = nearest(0, 1) - 4
    pose, _ = own_joints(tracks_up_to(frame, (0, 1)), poses(TRUTH[1][frame], TRUTH[0][frame]))
    assert pose.tolist() == [1, 0]


def test_one_body_in_both_boxes_is_that_of_whom_it_fits() -> None:
    frame = nearest(0, 1) - 4
    for front in (0, 1):
        twice = poses(TRUTH[front][frame], TRUTH[front][frame] + 0.5)
        pose, joint = own_joints(tracks_up_to(frame, (0, 1)), twice)
        assert pose[front] >= 0
        assert pose[1 - front] == -1
        assert (joint[1 - front] == -1).all()


def test_wrist_on_another_body_is_dropped() -> None:
    frame = nearest(0, 1) - 6
    wrist = BODY_15.index("lwrist")
    borrowed = TRUTH[0][frame].copy()
    borrowed[wrist] = TRUTH[1][frame, wrist]
    _, joint = own_joints(tracks_up_to(frame, (0, 1)), poses(borrowed, TRUTH[1][frame]))
    assert joint[0, wrist] == -1
    assert joint[1, wrist] == 1
    assert (np.delete(joint[0], wrist) >= 0).sum() >= 12


def test_one_gap_is_as_long_as_many_images_without_the_person() -> None:
    """A busy machine leaves images out: the last speed is believed no longer than where the images show nobody."""
    left_out, hidden = tracks_up_to(10, (0, 0))
    for ns in range(40, 1001, 40):
        hidden.predict(int(TIMES[10]) + 1_000_000 * ns)
    left_out.predict(hidden.stamp_ns)
    apart = np.linalg.norm(left_out.xy - hidden.xy, axis=1)
    assert (apart < 0.15 * np.linalg.norm(hidden.xy - tracks_up_to(10, (0,))[0].xy, axis=1)).all()


def test_who_is_behind_somebody_is_lost_when_that_one_has_moved_on() -> None:
    tracker, image, score = (
        SubjectTracker(PoseEstimatorConfig(subject="roi")),
        np.zeros((720, 1280, 3), np.uint8),
        [0.8],
    )
    box = ExpectedJoints(pose_of(TRUTH[0][0]), BODY_15, 0).box
    right = np.array([1, 0, 1, 0])
    tracker.update(image, 0, np.array([box, box + 400 * right]), np.array([0.8, 0.8]))
    hidden = tracker.persons[1]
    hidden.joints = ExpectedJoints(pose_of(TRUTH[0][0] + [10, 0]), BODY_15, 0)

    def see(n: int, moved_px: float) -> None:
        tracker.update(image, n * 200_000_000, box[None] + moved_px * right, np.array(score))

    for n in range(1, 25):
        see(n, 0.0)
    assert hidden in tracker.persons
    for n in range(25, 50):
        see(n, 12.0 * (n - 24))
    assert (hidden in tracker.persons, tracker.lost) == (False, [hidden])
    for n in range(50, 130):
        see(n, 300.0)
    assert tracker.lost == []  # nobody is kept for longer than anyone is found again
