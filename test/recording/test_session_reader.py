import numpy as np
import pytest
from recorded import NAMES, START_NS, write_poses

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import OPTICAL_FROM_FLU
from drocap_ros.geometry.rotations import angle_between, quaternion_from_matrix
from drocap_ros.recording.mcap.schemas import schema_text
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.session_reader import is_recording, open_session, read_images, read_pose2d, session_info
from drocap_ros.simulation.vehicle.path import SampledPath

POSE2D, STATE, INFO = NAMES["pose2d"], NAMES["state"], NAMES["info"]


def test_keypoints_exactly_as_in_the_messages(pose_session, capture):
    with open_session(pose_session) as session:
        assert session.has_pose2d
        assert not session.has_images
        tracks = read_pose2d(session)
        assert session.warnings == []
    for name in ("keypoints", "confidence", "covariance"):
        expected = getattr(capture.tracks, name).astype(np.float32).astype(np.float64)
        assert np.array_equal(getattr(tracks, name), expected, equal_nan=True)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns)
    assert tracks.image_size == capture.tracks.image_size
    assert tracks.camera_rotation is None
    assert tracks.camera_matrix is None


def test_lone_mcap_reads_like_its_folder(pose_session):
    with open_session(pose_session) as a, open_session(pose_session / "session_0.mcap") as b:
        assert np.array_equal(read_pose2d(a).keypoints, read_pose2d(b).keypoints, equal_nan=True)


def test_images_without_a_subject_are_frames_of_nan(tmp_path, messages, capture):
    write_poses(tmp_path / "s", messages, capture.tracks, absent=(0, 5, 6))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
    assert len(tracks) == len(capture.tracks)
    gone = np.isnan(tracks.keypoints).all(axis=(1, 2))
    assert np.flatnonzero(gone).tolist() == [0, 5, 6]
    assert (tracks.confidence[gone] == 0).all()


def record(folder, entries):
    """entries: (topic, message, log time)."""
    with SessionWriter(folder) as writer:
        for topic, message, log_ns, cdr in entries:
            writer.register(topic, message.__msgtype__, schema_text(message.__msgtype__))
            writer.write(topic, cdr, log_ns)
    return folder


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


def test_telemetry_at_each_picture(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert session.warnings == []
    # The last picture lies between the last state of the moving path and the first of the standing one.
    assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation))[:-1].max() < 0.01
    assert np.linalg.norm(tracks.camera_position - capture.camera_position, axis=1)[:-1].max() < 0.001
    assert np.array_equal(tracks.camera_matrix, capture.tracks.camera_matrix)


def test_without_a_gimbal_the_rotation_is_not_invented(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, gimbal=False))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert tracks.camera_rotation is None
        assert tracks.camera_position is not None
        assert any("hold no gimbal" in warning for warning in session.warnings)


def test_camera_fixed_to_the_body_at_a_told_pitch(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, gimbal=False))
    camera = quaternion_from_matrix(np.swapaxes(capture.camera_rotation, 1, 2) @ OPTICAL_FROM_FLU)
    forward = np.swapaxes(capture.camera_rotation, 1, 2)[:, :, 2]
    pitch = np.rad2deg(np.arcsin(forward[:, 2]))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session, mount_pitch_deg=float(pitch.mean()))
    assert camera.shape == (len(tracks), 4)
    assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation)).max() < np.ptp(pitch) + 0.2


def test_short_gap_in_the_telemetry_is_bridged_and_told(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, skip_s=(1.0, 2.5)))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert len(tracks) == len(capture.tracks)
        assert np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation))[:-1].max() < 2.0
        assert any("the attitude was interpolated over gaps of up to 1.5 s" in w for w in session.warnings)


def test_long_gap_in_the_telemetry_leaves_it_unknown(tmp_path, messages, capture):
    record(tmp_path / "s", flight_entries(messages, capture, skip_s=(0.8, 3.2)))
    with open_session(tmp_path / "s") as session:
        tracks = read_pose2d(session)
        assert len(tracks) == len(capture.tracks)
        assert tracks.camera_rotation is None
        assert tracks.camera_position is None
        assert any("2.4 s from an attitude" in warning for warning in session.warnings)


def test_telemetry_that_starts_late(tmp_path, messages, capture):
    record(tmp_path / "a", flight_entries(messages, capture, start_s=1.0))
    record(tmp_path / "b", flight_entries(messages, capture, start_s=3.0))
    with open_session(tmp_path / "a") as session:
        tracks = read_pose2d(session)
        assert any("27 images at the start or end are up to 1.0 s" in w for w in session.warnings)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns[27:])
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[27:].astype(np.float32), equal_nan=True)
    error = np.rad2deg(angle_between(tracks.camera_rotation, capture.camera_rotation[27:]))
    assert error.max() < 3.0  # the first state holds for the three pictures right before it
    assert np.median(error) < 0.01
    with open_session(tmp_path / "b") as session:
        tracks = read_pose2d(session)
    assert tracks.camera_rotation is None
    assert len(tracks) == len(capture.tracks)


def test_several_topics_the_named_one_counts(tmp_path, messages, capture):
    tracks = capture.tracks
    entries = [("/a/pose2d", messages.pose2d(tracks, i, START_NS + i), START_NS + i) for i in range(3)]
    entries += [("/b/pose2d", messages.pose2d(tracks, i, START_NS + i), START_NS + i) for i in range(5)]
    record(tmp_path / "s", [(t, m, s, messages.cdr(m)) for t, m, s in entries])
    with open_session(tmp_path / "s") as session:
        assert len(read_pose2d(session)) == 5
        assert any("several topics" in warning for warning in session.warnings)
        assert len(read_pose2d(session, "/a/pose2d")) == 3
        assert len(read_pose2d(session, "a/pose2d")) == 3
        with pytest.raises(InputError, match="name one of these"):
            read_pose2d(session, "/c/pose2d")


def test_out_of_order_and_repeated_poses(tmp_path, messages, capture):
    tracks = capture.tracks
    order = [3, 1, 2, 0, 2]
    entries = [("/pose2d", messages.pose2d(tracks, i, START_NS + i), START_NS + k) for k, i in enumerate(order)]
    record(tmp_path / "s", [(t, m, s, messages.cdr(m)) for t, m, s in entries])
    with open_session(tmp_path / "s") as session:
        read = read_pose2d(session)
        assert np.array_equal(read.stamp_ns, START_NS + np.arange(4))
        assert np.array_equal(read.keypoints, tracks.keypoints[:4].astype(np.float32), equal_nan=True)
        assert any("had one already" in warning for warning in session.warnings)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"skeleton": "octopus"}, "skeleton: expected one of"),
        ({"keypoints": np.zeros(7, np.float32)}, "keypoints: expected 30 values, got 7"),
        ({"covariance": np.zeros(0, np.float32)}, "covariance: expected 45 values"),
        ({"keypoints": np.full(30, np.inf, np.float32)}, "infinity"),
        ({"image_width": 640}, "image size: expected"),
    ],
)
def test_poses_that_cannot_be_used(tmp_path, messages, capture, change, text):
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


def picture(seed, shape=(48, 64, 3)):
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


def image_message(messages, image, stamp_ns, encoding="bgr8", pad=0):
    import cv2

    convert = {
        "rgb8": cv2.COLOR_BGR2RGB,
        "mono8": cv2.COLOR_BGR2GRAY,
        "bgra8": cv2.COLOR_BGR2BGRA,
        "rgba8": cv2.COLOR_BGR2RGBA,
    }
    data = cv2.cvtColor(image, convert[encoding]) if encoding in convert else image
    rows = np.pad(data.reshape(data.shape[0], -1), ((0, 0), (0, pad)))
    return messages(
        NAMES["image"], header=messages.header(stamp_ns), height=image.shape[0], width=image.shape[1],
        encoding=encoding, step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("encoding", "pad"), [("bgr8", 0), ("rgb8", 0), ("rgb8", 5), ("bgra8", 3), ("rgba8", 0), ("mono8", 0), ("mono8", 1)]
)
def test_raw_pictures(tmp_path, messages, encoding, pad):
    import cv2

    images = [picture(i) for i in range(3)]
    entries = []
    for i, image in enumerate(images):
        message = image_message(messages, image, START_NS + i, encoding, pad)
        entries.append(("/camera", message, START_NS + i, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        frames = list(read_images(session))
    assert [f.stamp_ns for f in frames] == [START_NS + i for i in range(3)]
    for frame, image in zip(frames, images, strict=True):
        gray = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
        assert np.array_equal(frame.image, gray if encoding == "mono8" else image)


@pytest.mark.parametrize(
    ("encoding", "red"),
    [("bayer_rggb8", (0, 0)), ("bayer_grbg8", (0, 1)), ("bayer_gbrg8", (1, 0)), ("bayer_bggr8", (1, 1))],
)
def test_bayer_pictures_have_their_colours(messages, encoding, red):
    from drocap_ros.recording.pictures import image_from_message

    mosaic = np.zeros((32, 32), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200  # only the red pixels have light
    message = messages(NAMES["image"], height=32, width=32, encoding=encoding, step=32, data=mosaic.ravel())
    blue, green, red_level = image_from_message(message, compressed=False)[8:-8, 8:-8].reshape(-1, 3).mean(axis=0)
    assert red_level > 150
    assert max(blue, green) < 5


def test_yuv_pictures(messages):
    from drocap_ros.recording.pictures import image_from_message

    for encoding, order in (("yuv422", (1, 0)), ("yuv422_yuy2", (0, 1))):  # UYVY, YUYV
        pair = np.zeros((4, 8, 2), np.uint8)
        pair[..., order[0]], pair[..., order[1]] = 120, 128
        message = messages(NAMES["image"], height=4, width=8, encoding=encoding, step=16, data=pair.ravel())
        image = image_from_message(message, compressed=False)
        assert np.ptp(image) <= 1  # grey
        assert abs(int(image.mean()) - 121) < 5


def test_compressed_pictures_and_damaged_ones(tmp_path, messages):
    import cv2

    images = [picture(i) for i in range(4)]
    entries = []
    for i, image in enumerate(images):
        data = cv2.imencode(".png", image)[1].ravel()
        data = data[:40] if i == 2 else data
        message = messages(NAMES["compressed"], header=messages.header(START_NS + i), format="png", data=data)
        entries.append(("/camera/compressed", message, START_NS + i, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        frames = list(read_images(session))
        assert any("1 pictures" in warning for warning in session.warnings)
    assert [f.stamp_ns - START_NS for f in frames] == [0, 1, 3]
    assert all(np.array_equal(f.image, images[f.stamp_ns - START_NS]) for f in frames)


@pytest.mark.parametrize(
    "change",
    [
        {"encoding": "magic"},
        {"step": 3},
        {"height": 4000},
        {"height": 0},
        {"width": 2**31},
        {"data": np.zeros(5, np.uint8)},
    ],
)
def test_pictures_that_do_not_fit_are_refused(tmp_path, messages, change):
    message = image_message(messages, picture(0), START_NS)
    for name, value in change.items():
        setattr(message, name, value)
    record(tmp_path / "s", [("/camera", message, START_NS, messages.cdr(message))])
    with open_session(tmp_path / "s") as session, pytest.raises(InputError, match="image: expected"):
        list(read_images(session))


def write_with_rosbags(path, kind, messages, capture):
    """The same pictures and poses, recorded by rosbags and not by us."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    poses = [messages.pose2d(capture.tracks, i, START_NS + i * 10**7) for i in range(10)]
    images = [image_message(messages, picture(i), START_NS + i * 10**7) for i in range(5)]
    if kind == "bag":
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        text = schema_text(POSE2D).split("=" * 80)[0]
        from rosbags.typesys import get_types_from_msg

        store.register(get_types_from_msg(text, POSE2D))
        with Writer1(path) as writer:
            for topic, group in (("/drocap/pose2d", poses), ("/camera", images)):
                connection = writer.add_connection(topic, group[0].__msgtype__, typestore=store)
                for i, message in enumerate(group):
                    old = ros1_copy(store, message, i)
                    writer.write(
                        connection, START_NS + i * 10**7, bytes(store.serialize_ros1(old, message.__msgtype__))
                    )
        return path
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        for topic, group in (("/drocap/pose2d", poses), ("/camera", images)):
            connection = writer.add_connection(topic, group[0].__msgtype__, typestore=messages.store)
            for i, message in enumerate(group):
                writer.write(connection, START_NS + i * 10**7, messages.cdr(message))
    return path


def ros1_copy(store, message, i):
    values = {name: getattr(message, name) for name, _ in store.fielddefs[message.__msgtype__][1] if name != "header"}
    time = store.types["builtin_interfaces/msg/Time"]
    stamp = START_NS + i * 10**7
    header = store.types["std_msgs/msg/Header"](seq=i, stamp=time(stamp // 10**9, stamp % 10**9), frame_id="camera")
    return store.types[message.__msgtype__](header=header, **values)


@pytest.mark.parametrize("kind", ["bag", "sqlite3", "mcap"])
def test_recordings_of_others(tmp_path, messages, capture, kind):
    path = write_with_rosbags(tmp_path / ("other.bag" if kind == "bag" else "other"), kind, messages, capture)
    assert is_recording(path)
    with open_session(path) as session:
        tracks = read_pose2d(session)
        frames = list(read_images(session))
        info = session.info
    assert np.array_equal(tracks.keypoints, capture.tracks.keypoints[:10].astype(np.float32), equal_nan=True)
    assert np.array_equal(tracks.stamp_ns, START_NS + np.arange(10) * 10**7)
    assert len(frames) == 5
    assert all(np.array_equal(frame.image, picture(i)) for i, frame in enumerate(frames))
    assert {t.name: t.count for t in info.topics} == {"/drocap/pose2d": 10, "/camera": 5}
    assert info.duration_s == pytest.approx(0.09)


def test_sqlite3_of_an_older_ros_without_embedded_definitions(tmp_path, messages, capture):
    import sqlite3

    path = write_with_rosbags(tmp_path / "old", "sqlite3", messages, capture)
    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("DELETE FROM message_definitions")
    connection.close()
    with open_session(path) as session:
        assert len(read_pose2d(session)) == 10


def test_session_without_its_metadata_file(pose_session, capture):
    (pose_session / "metadata.yaml").unlink()
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)
        assert any("metadata.yaml is missing" in warning for warning in session.warnings)
    (pose_session / "metadata.yaml").write_text("{[broken")
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)


def test_info(pose_session, capture):
    info = session_info(pose_session)
    assert info.message_count == len(capture.tracks)
    assert info.topics[0].type_name == POSE2D
    assert info.duration_s == pytest.approx(len(capture.tracks) / 30, abs=0.05)
    assert info.warnings == ()


def test_missing_and_foreign_paths(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("not a recording, but long enough to look at")
    (tmp_path / "zero.mcap").write_bytes(b"")
    (tmp_path / "text.bag").write_text("neither is this")
    (tmp_path / "text.db3").write_text("nor this")
    (tmp_path / "notes.txt").write_text("x")
    for name in ("missing", "missing.mcap", "empty", "text.mcap", "zero.mcap", "text.bag", "text.db3", "notes.txt"):
        with pytest.raises(InputError, match="expected") as error, open_session(tmp_path / name) as session:
            read_pose2d(session)
        assert "\n" not in str(error.value)
        assert name in str(error.value)


def test_newer_version_of_the_folder_is_still_read_by_its_file(pose_session, capture):
    text = (pose_session / "metadata.yaml").read_text()
    (pose_session / "metadata.yaml").write_text(text.replace("version: 9", "version: 42"))
    with open_session(pose_session) as session:
        assert len(read_pose2d(session)) == len(capture.tracks)
