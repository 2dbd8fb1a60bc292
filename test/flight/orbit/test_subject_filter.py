import dataclasses

import numpy as np
import pytest

from drocap_ros.errors import ParameterError
from drocap_ros.flight.bridge_config import SubjectConfig
from drocap_ros.flight.subject.subject_filter import SubjectFilter
from drocap_ros.flight.subject.subject_measurement import locate_subject
from drocap_ros.flight.vehicle import OPTICAL_FROM_FLU, CameraPose, PoseHistory, VehicleFilter, VehicleState
from drocap_ros.geometry.rotations import quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import SimulationConfig, simulate_capture

S = 1_000_000_000


def flight(action, seconds=12.0, seed=3, **changes):
    settings = {"attitude_error_deg": 0.3, "position_error_m": 0.0, "stature_m": 1.7, **changes}
    return simulate_capture(seconds, 15.0, seed, SimulationConfig(action=action, **settings))


def observations(capture, track_id=1):
    tracks = capture.tracks
    for i, stamp in enumerate(tracks.stamp_ns):
        pose = CameraPose(tracks.camera_rotation[i], tracks.camera_position[i])
        yield i, pose, PoseObservation(
            int(stamp) + S, track_id, tracks.image_size,
            keypoints=tracks.keypoints[i], covariance=tracks.covariance[i], confidence=tracks.confidence[i],
        )  # fmt: skip


@pytest.mark.parametrize(("action", "bound"), [("stand", 0.4), ("walk", 0.45), ("squats", 0.6), ("boxing", 0.4)])
def test_filter_finds_the_pelvis_of_a_moving_person(action, bound):
    capture = flight(action)
    subject = SubjectFilter(SubjectConfig())
    errors = []
    for i, pose, seen in observations(capture):
        subject.update(seen, capture.tracks.camera_matrix, pose)
        if i > 20:
            estimate = subject.estimate(seen.stamp_ns)
            errors.append(np.linalg.norm(estimate.position[:2] - capture.joints3d_world[i, 0, :2]))
            assert estimate.position_sd_m < 1.0
    assert np.mean(errors) < bound


@pytest.mark.parametrize(("action", "bound"), [("stand", 0.25), ("squats", 0.3), ("kicking", 0.3)])
def test_range_of_a_person_seen_from_steeply_above(action, bound):
    capture = flight(action, radius_m=4.0, height_m=6.0)
    subject = SubjectFilter(SubjectConfig())
    errors, sizes = [], []
    for i, pose, seen in observations(capture):
        subject.update(seen, capture.tracks.camera_matrix, pose)
        truth = np.linalg.norm(capture.joints3d_world[i, 0, :2] - pose.position[:2])
        measured = locate_subject(seen, capture.tracks.camera_matrix, pose, SubjectConfig())
        if measured is not None:
            sizes.append(measured.range_size_m / truth)
        if i > 20:
            place = subject.estimate(seen.stamp_ns).position[:2]
            errors.append(np.linalg.norm(place - pose.position[:2]) - truth)
    assert np.mean(np.abs(errors)) < bound
    assert np.max(errors) < 3 * bound  # what is farther than it is costs distance
    if action == "stand":
        assert np.nanmedian(sizes) == pytest.approx(1.0, abs=0.12)


def test_a_few_wrong_first_images_do_not_decide_the_range():
    # The mount's attitude is late: the ground of the first images is twice as far away.
    capture = flight("stand", stature_m=1.7)
    subject, errors = SubjectFilter(SubjectConfig()), []
    for i, pose, seen in observations(capture):
        if i < 6:
            up = np.deg2rad(10.0)
            turn = np.array([[1, 0, 0], [0, np.cos(up), np.sin(up)], [0, -np.sin(up), np.cos(up)]])
            pose = pose._replace(rotation=turn @ pose.rotation)
        subject.update(seen, capture.tracks.camera_matrix, pose)
        truth = np.linalg.norm(capture.joints3d_world[i, 0, :2] - pose.position[:2])
        if i > 45:
            estimate = subject.estimate(seen.stamp_ns)
            errors.append(np.linalg.norm(estimate.position[:2] - pose.position[:2]) - truth)
    assert np.abs(errors).max() < 1.0


def test_one_wrong_joint_does_not_change_the_bearing():
    capture = flight("stand", noise_scale=0.0, outlier_fraction=0.0, missed_fraction=0.0, attitude_error_deg=0.0)
    _, pose, seen = next(observations(capture))
    keypoints = seen.keypoints.copy()
    keypoints[0] += 100.0
    places = [
        locate_subject(dataclasses.replace(seen, keypoints=k), capture.tracks.camera_matrix, pose, SubjectConfig())
        for k in (seen.keypoints, keypoints)
    ]
    assert np.linalg.norm(places[1].position - places[0].position) < 0.2


def test_range_ignores_a_foot_at_the_horizon():
    capture = flight("stand", noise_scale=0.0, outlier_fraction=0.0, missed_fraction=0.0, attitude_error_deg=0.0)
    _, pose, seen = next(observations(capture))
    ankle = seen.joints.index("rankle")
    keypoints = seen.keypoints.copy()
    keypoints[ankle, 1] = seen.keypoints[seen.joints.index("neck"), 1] - 80
    kicked = locate_subject(
        dataclasses.replace(seen, keypoints=keypoints), capture.tracks.camera_matrix, pose, SubjectConfig()
    )
    truth = np.linalg.norm(capture.joints3d_world[0, 0, :2] - pose.position[:2])
    assert kicked.range_ground_m == pytest.approx(truth, rel=0.1)


@pytest.mark.parametrize("up", [0.0, 0.4, 0.7])
def test_missed_shanks_and_knees_too_high_put_nobody_farther(up):
    # A network that does not see shanks of the ground's colour puts the knees on the thighs.
    capture = flight("stand", noise_scale=0.0, outlier_fraction=0.0, missed_fraction=0.0, attitude_error_deg=0.0)
    for i, pose, seen in observations(capture):
        keypoints, confidence = seen.keypoints.copy(), seen.confidence.copy()
        for side in "rl":
            hip, knee, ankle = (seen.joints.index(side + name) for name in ("hip", "knee", "ankle"))
            keypoints[knee] += up * (keypoints[hip] - keypoints[knee])
            confidence[ankle] = 0.1
        seen = dataclasses.replace(seen, keypoints=keypoints, confidence=confidence)
        found = locate_subject(seen, capture.tracks.camera_matrix, pose, SubjectConfig())
        truth = np.linalg.norm(capture.joints3d_world[i, 0, :2] - pose.position[:2])
        assert 0.9 * truth < found.range_size_m < 1.1 * truth


@pytest.mark.parametrize("action", ["stand", "walk"])
def test_one_whose_legs_leave_the_picture_is_still_followed(action):
    """A fixed camera tilts up as the vehicle gives way to one who comes nearer."""
    capture, subject, errors, located = flight(action), SubjectFilter(SubjectConfig()), [], []
    legs = [i for i, name in enumerate(BODY_15.joints) if name[1:] in ("knee", "ankle")]
    for i, pose, seen in observations(capture):
        if i >= 60:
            seen.keypoints[legs] = np.nan
            seen.confidence[legs] = 0.0
        accepted = subject.update(seen, capture.tracks.camera_matrix, pose)
        if i >= 60:
            errors.append(
                np.linalg.norm(subject.estimate(seen.stamp_ns).position[:2] - capture.joints3d_world[i, 0, :2])
            )
            located.append(accepted)
    assert np.mean(located) > 0.9  # a network misses a neck
    assert np.mean(errors[:30]) < 0.6  # 2 s: longer than a vehicle leans
    assert np.max(errors) < 2.0


def test_velocity_of_a_standing_person_is_small_while_the_position_wanders():
    capture = flight("stand")
    rng = np.random.default_rng(0)
    wander = np.cumsum(rng.normal(0, 0.03, (len(capture.tracks.stamp_ns), 3)), axis=0)
    velocity = np.gradient(capture.camera_position, 1 / 15.0, axis=0)
    history, subject, speeds, places = PoseHistory(), SubjectFilter(SubjectConfig()), [], []
    own = VehicleFilter(0.02)
    for i, pose, seen in observations(capture):
        reported = capture.camera_position[i] + wander[i]
        forward_left_up = quaternion_from_matrix(pose.rotation.T @ OPTICAL_FROM_FLU)
        own.take(seen.stamp_ns * 1e-9, reported, velocity[i])
        history.add(
            VehicleState(
                seen.stamp_ns, position_enu_m=reported, velocity_enu_m_s=velocity[i],
                orientation_xyzw=np.array([0.0, 0.0, 0.0, 1.0]), gimbal_orientation_xyzw=forward_left_up,
            ),
            own.position,
        )  # fmt: skip
        camera = history.at(seen.stamp_ns)
        assert np.allclose(camera.position + history.offset, reported)
        subject.update(seen, capture.tracks.camera_matrix, camera)
        if i > 30:
            estimate = subject.estimate(seen.stamp_ns)
            speeds.append(np.linalg.norm(estimate.velocity[:2]))
            places.append(estimate.position + history.offset - reported - capture.joints3d_world[i, 0] + pose.position)
    assert np.mean(speeds) < 0.25  # 0.5 m/s by the position as reported
    assert np.mean(np.linalg.norm(np.array(places)[:, :2], axis=1)) < 0.4


def test_velocity_of_a_walking_person():
    capture = flight("walk", noise_scale=0.5)
    subject = SubjectFilter(SubjectConfig())
    truth = np.gradient(capture.joints3d_world[:, 0, :2], 1 / 15.0, axis=0)
    errors = []
    for i, pose, seen in observations(capture):
        subject.update(seen, capture.tracks.camera_matrix, pose)
        if i > 30:
            errors.append(np.linalg.norm(subject.estimate(seen.stamp_ns).velocity[:2] - truth[i]))
    assert np.mean(errors) < 0.5
    assert np.mean(np.linalg.norm(truth, axis=1)) > 0.8


def test_each_range_source_works_alone_and_size_wins_on_a_slope():
    capture = flight("stand", noise_scale=0.0, outlier_fraction=0.0, missed_fraction=0.0, attitude_error_deg=0.0)
    _, pose, seen = next(observations(capture))
    truth = np.linalg.norm(capture.joints3d_world[0, 0, :2] - pose.position[:2])
    both = locate_subject(seen, capture.tracks.camera_matrix, pose, SubjectConfig())
    assert both.range_size_m == pytest.approx(truth, rel=0.08)
    assert both.range_ground_m == pytest.approx(truth, rel=0.08)
    size_only = locate_subject(seen, capture.tracks.camera_matrix, pose, SubjectConfig(use_ground_plane=False))
    assert np.isnan(size_only.range_ground_m)
    wrong = locate_subject(seen, capture.tracks.camera_matrix, pose, SubjectConfig(ground_height_m=-6.0))
    assert np.linalg.norm(wrong.position[:2] - pose.position[:2]) == pytest.approx(wrong.range_size_m)
    assert wrong.systematic[0, 0] + wrong.systematic[1, 1] > size_only.systematic[0, 0] + size_only.systematic[1, 1]


def test_too_few_joints_or_a_steep_view_give_no_measurement():
    capture = flight("stand")
    _, pose, seen = next(observations(capture))
    matrix, config = capture.tracks.camera_matrix, SubjectConfig()
    assert locate_subject(PoseObservation(S, 0, (640, 480)), matrix, pose, config) is None
    blind = dataclasses.replace(seen, keypoints=np.full((15, 2), np.nan, np.float32))
    assert locate_subject(blind, matrix, pose, config) is None
    down = CameraPose(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0, 0, 10.0]))
    assert locate_subject(seen, matrix, down, config) is None


def accepted(subject, capture, count, **kwargs):
    done = []
    for i, pose, seen in observations(capture):
        if i >= count:
            break
        done.append(subject.update(seen, capture.tracks.camera_matrix, pose, **kwargs))
    return done


@pytest.mark.parametrize(
    "spoil",
    [
        lambda last, seen: dataclasses.replace(seen, keypoints=seen.keypoints + np.float32(400)),
        lambda last, seen: dataclasses.replace(seen, track_id=2),
        lambda last, seen: dataclasses.replace(seen, keypoints=np.full((15, 2), np.nan, np.float32)),
    ],
    ids=["jumped", "another", "nan"],
)
def test_age_grows_without_accepted_keypoints(spoil):
    capture = flight("stand")
    subject = SubjectFilter(SubjectConfig())
    assert sum(accepted(subject, capture, 30)) > 25
    rows = list(observations(capture))
    last = rows[29][2]
    stamp = subject.estimate(last.stamp_ns).stamp_ns
    for _, pose, seen in rows[30:45]:
        assert not subject.update(spoil(last, seen), capture.tracks.camera_matrix, pose, locked=True)
    estimate = subject.estimate(rows[44][2].stamp_ns)
    assert estimate.stamp_ns == stamp
    assert estimate.age_s == pytest.approx(1.0, abs=0.1)


def test_unlocked_filter_switches_to_another_person():
    capture, other = flight("stand"), flight("stand", seed=9)
    subject = SubjectFilter(SubjectConfig())
    accepted(subject, capture, 5)
    _, pose, seen = list(observations(other, track_id=2))[6]
    assert subject.update(seen, capture.tracks.camera_matrix, pose)
    assert subject.estimate(seen.stamp_ns).track_id == 2


def test_parameters_out_of_range_are_refused():
    with pytest.raises(ParameterError, match="body_height_m"):
        SubjectConfig(body_height_m=-1.0)
