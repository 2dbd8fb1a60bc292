import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from angles import angle_between
from recorded import NAMES, START_NS, record, write_poses

from drocap_ros.errors import InputError
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.pose_messages import add_calibration, read_observations
from drocap_ros.recording.session import BACKGROUND_TRACKS as POINTS
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE
from drocap_ros.recording.session_tracks import read_pose2d
from lab.simulation.capture import simulate_capture
from lab.simulation.path_vehicle import SampledPath

POSE2D, STATE, INFO = NAMES["pose2d"], NAMES["state"], NAMES["info"]


def test_keypoints_exactly_as_in_the_messages(pose_session, capture):
    with open_session(pose_session) as session:
        assert session.topics_of(POSE2D)
        assert not session.topics_of(IMAGE, COMPRESSED_IMAGE)
        tracks = read_pose2d(session)
        assert session.warnings == []
    for name in ("keypoints", "confidence", "covariance"):
        expected = getattr(capture.tracks, name).astype(np.float32).astype(np.float64)
        assert np.array_equal(getattr(tracks, name), expected, equal_nan=True)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns)
    assert tracks.image_size == capture.tracks.image_size
    assert tracks.camera_rotation is None
    assert tracks.camera_matrix is None


def test_fixed_points_exactly_as_in_the_messages(tmp_path, messages, capture):
    """One message has another image's stamp, one has too few numbers, one repeats a number and one a lost point."""
    stamps = capture.tracks.stamp_ns.tolist()
    rng = np.random.default_rng(0)
    entries, sent = [], {}
    for i, stamp in enumerate(stamps):
        entries.append(("/drocap/pose2d", messages.pose2d(capture.tracks, i, stamp), stamp))
        track = np.arange(i, i + 20, dtype=np.int64)
        point = rng.uniform(0, 700, (20, 2)).astype(np.float32)
        if i < 4:
            sent[i] = track, point.copy()
        shown = stamp + 5 if i == 4 else stamp
        track = track[:-1] if i == 5 else np.append(track[:-1], track[0]) if i == 6 else track
        if i == 7:
            point[3, 1] = np.nan
        if i < 8:
            message = messages(POINTS, header=messages.header(shown), track=track, point=point.ravel())
            entries.append(("/drocap/background", message, stamp))
    record(tmp_path / "s", [(topic, message, log, messages.cdr(message)) for topic, message, log in entries])
    with open_session(tmp_path / "s") as session:
        background = read_pose2d(session).background
        assert session.warnings == ["3 messages on /drocap/background were refused"]
    assert sorted(set(background.frame.tolist())) == sorted(sent)
    for i, (track, point) in sent.items():
        assert np.array_equal(background.track[background.frame == i], track)
        assert np.array_equal(background.point[background.frame == i], point)


def test_images_without_a_subject_are_frames_of_nan(tmp_path, messages, capture):
    write_poses(tmp_path / "s", messages, capture.tracks, absent=(0, 5, 6))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
    assert len(tracks) == len(capture.tracks)
    gone = np.isnan(tracks.keypoints).all(axis=(1, 2))
    assert np.flatnonzero(gone).tolist() == [0, 5, 6]
    assert (tracks.confidence[gone] == 0).all()


def test_poses_of_a_stray_stamp_are_refused_as_in_the_live_graph(tmp_path, messages, capture):
    entries = []
    for i, stamp in enumerate(capture.tracks.stamp_ns.tolist()):
        shown = 5 * 10**9 if i == 3 else stamp + 86_400 * 10**9 * (i >= 8)
        entries.append(("/drocap/pose2d", messages.pose2d(capture.tracks, i, shown), stamp))
    record(tmp_path / "s", [(topic, message, log, messages.cdr(message)) for topic, message, log in entries])
    with open_session(tmp_path / "s") as session:
        kept = [o.stamp_ns for o in read_observations(session, "/drocap/pose2d")]
        assert len(session.warnings) == 1
        tracks = read_pose2d(session)  # has all images: those of most stamps
        assert "8 poses with a stamp more than a day from most others" in session.warnings[-1]
    expected = capture.tracks.stamp_ns + 86_400 * 10**9 * (np.arange(len(capture.tracks)) >= 8)
    assert np.array_equal(tracks.stamp_ns, expected[8:])
    assert kept == np.delete(expected, [3, 8, 9, 10, 11]).tolist()


def flight_entries(messages, capture, *, gimbal=True, rate_hz=50.0, skip_s=(9.0, 9.0), start_s=-0.5, lag_ns=0):
    tracks = capture.tracks
    t = (tracks.stamp_ns - START_NS) * 1e-9
    path = SampledPath(t, capture.camera_rotation, capture.camera_position)
    entries = []
    for i, stamp in enumerate(tracks.stamp_ns.tolist()):
        entries.append(("/drocap/pose2d", messages.pose2d(tracks, i, stamp), stamp))
    width, height = tracks.image_size
    k = tracks.camera_matrix.ravel()
    entries.append(
        (
            "/drocap/camera_info",
            messages(INFO, header=messages.header(START_NS), width=width, height=height, k=k),
            START_NS,
        )
    )
    for s in np.arange(start_s, t[-1] + 0.5, 1 / rate_hz):
        if skip_s[0] < s < skip_s[1]:
            continue
        pose, stamp = path.at(s), START_NS + round(s * 1e9)
        nan = np.full(4, np.nan)
        state = messages(
            STATE, header=messages.header(stamp, "map"), position_enu_m=pose.position_enu_m,
            orientation=messages.quaternion(pose.orientation_xyzw),
            gimbal_orientation=messages.quaternion(pose.gimbal_orientation_xyzw if gimbal else nan),
        )  # fmt: skip
        entries.append(("/drocap/vehicle/state", state, stamp + lag_ns))
    entries.sort(key=lambda entry: entry[2])
    return [(topic, message, log, messages.cdr(message)) for topic, message, log in entries]


def test_camera_pose_at_each_image(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert session.warnings == []
    # The last image is between the last state of the moving path and the first of the resting one.
    assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation))[:-1].max() < 0.01
    assert np.linalg.norm(tracks.camera_position - capture.camera_position, axis=1)[:-1].max() < 0.001
    assert np.array_equal(tracks.camera_matrix, capture.tracks.camera_matrix)


def test_calibration_in_another_unit_is_refused(tmp_path, messages, capture):
    entries = flight_entries(messages, capture)
    (i,) = (i for i, entry in enumerate(entries) if entry[0] == "/drocap/camera_info")
    topic, info, log, _ = entries[i]
    info.k = info.k / np.array([*6 * [capture.tracks.image_size[0]], 1.0, 1.0, 1.0])
    entries[i] = (topic, info, log, messages.cdr(info))
    record(tmp_path / "s", entries)
    with (
        open_session(tmp_path / "s") as session,
        pytest.raises(InputError, match="camera_matrix: expected focal lengths in px") as refused,
    ):
        read_pose2d(session)
    assert str(tmp_path / "s") in str(refused.value)
    with pytest.raises(InputError, match="expected focal lengths in px"):
        add_calibration(CameraHistory(1.0), info)  # as the live graph does


def test_warning_names_the_recording_and_no_folder(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, gimbal=False))
    words = ["reconstruct", tmp_path / "s", "--out", tmp_path / "out", "--method", "initial", "--quiet"]
    command = [sys.executable, "-m", "drocap_ros.cli", *map(str, words)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stderr.startswith("drocap: s: camera telemetry incomplete: ")


def test_rotation_is_unknown_without_a_gimbal(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, gimbal=False))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert tracks.camera_rotation is None
        assert tracks.camera_position is not None
        assert any("hold no gimbal" in warning for warning in session.warnings)
        assert any("--mount-pitch DEG" in warning for warning in session.warnings)


def test_short_gap_in_the_telemetry_is_interpolated_with_a_warning(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, skip_s=(1.0, 2.5)))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert len(tracks) == len(capture.tracks)
        assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation))[:-1].max() < 2.0
        assert any("the attitude was interpolated over gaps of up to 1.5 s" in w for w in session.warnings)


def test_camera_pose_is_unknown_after_a_long_gap(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, skip_s=(0.8, 3.2)))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert len(tracks) == len(capture.tracks)
        assert tracks.camera_rotation is None
        assert tracks.camera_position is None
        assert any("2.4 s from an attitude" in warning for warning in session.warnings)


def test_images_in_a_long_gap_are_left_out_if_most_remain(tmp_path, messages):
    capture = simulate_capture(10, 30, seed=2, start_ns=START_NS)
    record(tmp_path / "s", flight_entries(messages, capture, skip_s=(3.005, 5.995)))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert any("images in gaps of the attitude of up to 3.0 s: left out" in w for w in session.warnings)
    t = (capture.tracks.stamp_ns - START_NS) * 1e-9
    stays = (t < 3.001) | (t > 5.999)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns[stays])
    expected = capture.tracks.keypoints[stays].astype(np.float32)
    assert np.array_equal(tracks.keypoints, expected, equal_nan=True)
    assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation[stays]))[:-1].max() < 0.01


def test_images_before_the_telemetry_are_left_out_if_most_remain(tmp_path, messages, capture):
    record(tmp_path / "a", flight_entries(messages, capture, start_s=1.0))
    record(tmp_path / "b", flight_entries(messages, capture, start_s=3.0))
    with open_session(tmp_path / "a") as session:
        tracks = read_pose2d(session)
        assert any("27 images at the start or end are up to 1.0 s" in w for w in session.warnings)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns[27:])
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[27:].astype(np.float32), equal_nan=True)
    error = np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation[27:]))
    assert error.max() < 3.0  # the first state holds for the three images right before it
    assert np.median(error) < 0.01
    with open_session(tmp_path / "b") as session:
        tracks = read_pose2d(session)
    assert tracks.camera_rotation is None
    assert len(tracks) == len(capture.tracks)


def test_only_the_person_in_most_images_is_read(tmp_path, messages, capture):
    tracks = capture.tracks
    other = range(40, 60)
    entries = []
    for i, stamp in enumerate(tracks.stamp_ns.tolist()):
        pose = messages.pose2d(tracks, i, stamp, track_id=2 if i in other else 1)
        entries.append(("/drocap/pose2d", pose, stamp, messages.cdr(pose)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        read = read_pose2d(session)
        (warning,) = session.warnings
    assert "poses of 2 persons" in warning
    assert "20 poses of others are left out" in warning
    gone = np.isnan(read.keypoints).all(axis=(1, 2))
    assert np.flatnonzero(gone).tolist() == list(other)


def with_calibration(messages, capture, *calibrations):
    """Entries of a flight with other calibrations (stamp ns, width, height, factor of the matrix's first two rows)."""
    entries = [e for e in flight_entries(messages, capture) if e[0] != "/drocap/camera_info"]
    for stamp, width, height, factor in calibrations:
        k = capture.tracks.camera_matrix * np.array([[factor], [factor], [1.0]])
        info = messages(INFO, header=messages.header(stamp), width=width, height=height, k=k.ravel())
        entries.append(("/drocap/camera_info", info, stamp, messages.cdr(info)))
    return entries


def test_calibration_of_another_image_size_is_resized_or_left_out(tmp_path, messages, capture):
    width, height = capture.tracks.image_size
    record(tmp_path / "a", with_calibration(messages, capture, (START_NS, 2 * width, 2 * height, 2.0)))
    with open_session(tmp_path / "a") as session:
        tracks = read_pose2d(session)
        assert any("the same picture, resized" in warning for warning in session.warnings)
    assert np.allclose(tracks.camera_matrix, capture.tracks.camera_matrix)
    record(tmp_path / "b", with_calibration(messages, capture, (START_NS, 2 * width, height, 2.0)))
    with open_session(tmp_path / "b") as session:
        tracks = read_pose2d(session)
        assert any("not used; record the calibration" in warning for warning in session.warnings)
    assert tracks.camera_matrix is None


def test_change_of_the_calibration_is_reported(tmp_path, messages, capture):
    size = capture.tracks.image_size
    changes = (START_NS, *size, 1.0), (START_NS + 10**9, *size, 1.0), (START_NS + 2 * 10**9, *size, 1.5)
    record(tmp_path / "s", with_calibration(messages, capture, *changes[:2]))
    with open_session(tmp_path / "s") as session:
        read_pose2d(session)
        assert session.warnings == []
    record(tmp_path / "t", with_calibration(messages, capture, *changes))
    with open_session(tmp_path / "t") as session:
        tracks = read_pose2d(session)
        assert any("calibration on /drocap/camera_info changes" in warning for warning in session.warnings)
    assert np.array_equal(tracks.camera_matrix, capture.tracks.camera_matrix)


def test_trees_of_frames_are_said_not_to_be_read(tmp_path, messages, capture):
    entries = [e for e in flight_entries(messages, capture) if e[0] != "/drocap/vehicle/state"]
    tree = messages("tf2_msgs/msg/TFMessage", transforms=[])
    record(tmp_path / "s", [*entries, ("/tf", tree, START_NS + 10**10, messages.cdr(tree))])
    with open_session(tmp_path / "s") as session:
        assert read_pose2d(session).camera_position is None
        (warning,) = session.warnings
    assert "/tf is not read, drocap_ros/msg/VehicleState is" in warning


def of_other_systems(messages, entries, forms):
    """The entries with the vehicle's states as other systems write them."""
    found = [e for e in entries if e[0] != "/drocap/vehicle/state"]
    for _, state, log, _ in (e for e in entries if e[0] == "/drocap/vehicle/state"):
        stamp = state.header.stamp
        x, y, z = (float(v) for v in state.position_enu_m)
        point = messages("geometry_msgs/msg/Point", x=x, y=y, z=z)
        pose = messages("geometry_msgs/msg/Pose", position=point, orientation=state.orientation)
        header = messages("std_msgs/msg/Header", stamp=stamp, frame_id="map")
        held = messages("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
        alone = messages("geometry_msgs/msg/PoseStamped", header=header, pose=pose)
        fix = messages("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        east = x / 111_320.0 / np.cos(np.deg2rad(47))
        other = messages("geometry_msgs/msg/Pose", position=messages("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
                         orientation=state.orientation)  # fmt: skip
        known = {
            "odom": ("/mavros/local_position/odom", messages("nav_msgs/msg/Odometry", header=header, pose=held,
                                                             child_frame_id="base_link")),
            "pose": ("/mavros/local_position/pose", alone),
            "goal": ("/mavros/setpoint_position/local",
                     messages("geometry_msgs/msg/PoseStamped", header=header, pose=other)),
            "imu": ("/mavros/imu/data", messages("sensor_msgs/msg/Imu", header=header, orientation=state.orientation)),
            "gps": ("/mavros/global_position/global", messages(
                "sensor_msgs/msg/NavSatFix", header=header, status=fix, latitude=47 + y / 111_320.0, longitude=8 + east,
                altitude=400 + z)),
        }  # fmt: skip
        found += [(topic, message, log, messages.cdr(message)) for topic, message in (known[form] for form in forms)]
    return sorted(found, key=lambda entry: entry[2])


@pytest.mark.parametrize(("forms", "used"), [
    (["odom"], "/mavros/local_position/odom"), (["pose"], "/mavros/local_position/pose"),
    (["pose", "goal", "odom", "imu", "gps"], "/mavros/local_position/odom"), (["goal", "pose"], "local_position/pose"),
    (["imu", "gps"], "/mavros/imu/data (sensor_msgs/msg/Imu) and /mavros/global_position/global"),
])  # fmt: skip
def test_poses_of_mavros_are_the_vehicles(tmp_path, messages, capture, forms, used):
    entries = flight_entries(messages, capture, gimbal=False)
    record(tmp_path / "own", entries)
    record(tmp_path / "other", of_other_systems(messages, entries, forms))
    found = []
    for name in ("own", "other"):
        with open_session(tmp_path / name) as session:
            found.append(read_pose2d(session, -20.0))
    assert any(used in warning for warning in session.warnings)
    own, other = found
    assert np.rad2deg(angle_between(own.camera_rotation, other.camera_rotation)).max() < 1e-4
    moved = [t.camera_position - t.camera_position[0] for t in (own, other)]
    assert np.abs(moved[0] - moved[1]).max() < (0.03 if "gps" in forms and len(forms) == 2 else 1e-6)


@pytest.mark.parametrize("frame", ["camera_link", "camera_color_optical_frame"])
def test_a_frame_of_a_camera_is_the_cameras(tmp_path, messages, capture, frame):
    from drocap_ros.flight.vehicle import optical_orientation

    entries = flight_entries(messages, capture)
    record(tmp_path / "own", entries)
    turned = []
    for e in entries:
        if e[0] == "/drocap/vehicle/state":
            g = e[1].gimbal_orientation
            xyzw = np.array([g.x, g.y, g.z, g.w])
            xyzw = optical_orientation(xyzw) if "optical" in frame else xyzw
            point = messages(
                "geometry_msgs/msg/Point", **dict(zip("xyz", map(float, e[1].position_enu_m), strict=True))
            )
            pose = messages("geometry_msgs/msg/Pose", position=point, orientation=messages.quaternion(xyzw))
            held = messages("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
            odom = messages("nav_msgs/msg/Odometry", header=e[1].header, pose=held, child_frame_id=frame)
            turned.append(("/slam/odom", odom, e[2], messages.cdr(odom)))
        else:
            turned.append(e)
    record(tmp_path / "other", turned)
    found = []
    for name in ("own", "other"):
        with open_session(tmp_path / name) as session:
            found.append(read_pose2d(session))
    assert np.rad2deg(angle_between(found[0].camera_rotation, found[1].camera_rotation)).max() < 1e-4


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
@pytest.mark.parametrize("rectified", [False, True])
def test_the_distortion_and_the_projection_of_a_camera_info_are_used(tmp_path, messages, capture, model, rectified):
    from drocap_ros.geometry.lens import CameraModel
    from drocap_ros.recording.session_tracks import with_recorded_camera

    tracks = dataclasses.replace(capture.tracks, camera_matrix=None)
    k, size = capture.tracks.camera_matrix, tracks.image_size
    d = {"plumb_bob": [-0.2, 0.05, 1e-3, -1e-3, 0.0], "equidistant": [0.02, -0.01, 0.003, 0.0],
         "rational_polynomial": [-0.2, 0.05, 1e-3, -1e-3, 0.0, 0.1, 0.0, 0.0]}[model]  # fmt: skip
    p = np.hstack([k * [[0.8], [0.8], [1.0]], np.zeros((3, 1))])
    info = messages(INFO, header=messages.header(START_NS), width=size[0], height=size[1], k=k.ravel(), p=p.ravel(),
                    distortion_model=model, d=np.array(d))  # fmt: skip
    record(tmp_path / "s", [("/camera/camera_info", info, START_NS, messages.cdr(info))])
    with open_session(tmp_path / "s") as session:
        found = with_recorded_camera(session, tracks, "/camera/image_rect" if rectified else "/camera/image_raw")
    if rectified:
        assert np.array_equal(found.camera_matrix, p[:, :3])
        assert np.array_equal(found.keypoints, tracks.keypoints, equal_nan=True)
    else:
        lens = CameraModel(*size, k, np.array(d), model)
        flat = lens.undistorted(tracks.keypoints.reshape(-1, 2)).reshape(tracks.keypoints.shape)
        assert np.array_equal(found.camera_matrix, k)
        assert np.array_equal(found.keypoints, flat, equal_nan=True)
        assert np.nanmax(np.abs(flat - tracks.keypoints)) > 0.5


def test_poses_are_sorted_and_repeated_ones_left_out(tmp_path, messages, capture):
    tracks = capture.tracks
    order = [3, 1, 2, 0, 2]
    entries = [("/pose2d", messages.pose2d(tracks, i, START_NS + i * 10**7), START_NS + k) for k, i in enumerate(order)]
    record(tmp_path / "s", [(t, m, s, messages.cdr(m)) for t, m, s in entries])
    with open_session(tmp_path / "s") as session:
        read = read_pose2d(session)
        assert np.array_equal(read.stamp_ns, START_NS + np.arange(4) * 10**7)
        assert np.array_equal(read.keypoints, tracks.keypoints[:4].astype(np.float32), equal_nan=True)
        assert any("repeated poses" in warning for warning in session.warnings)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"skeleton": "octopus"}, "skeleton: expected one of"),
        ({"keypoints": np.zeros(7, np.float32)}, "keypoints: expected 30 values .*, got 7"),
        ({"covariance": np.zeros(0, np.float32)}, "covariance: expected 45 values"),
        ({"keypoints": np.full(30, np.inf, np.float32)}, "infinity"),
        ({"image_width": 640}, "image size: expected"),
    ],
)
def test_unusable_poses_are_refused_in_one_line(tmp_path, messages, capture, change, text):
    entries = []
    for i in range(3):
        message = messages.pose2d(capture.tracks, i, START_NS + i)
        if i or "image_width" not in change:
            for name, value in change.items():
                setattr(message, name, value)
        entries.append(("/pose2d", message, START_NS + i, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session, pytest.raises(InputError, match=text) as error:
        read_pose2d(session)
    assert "\n" not in str(error.value)
