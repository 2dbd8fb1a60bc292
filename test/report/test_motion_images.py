"""Images for the report out of videos and folders: the right ones, cropped, within their bytes."""

import dataclasses
import threading

import numpy as np
import pytest
from report_motions import first_frames

from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.open_images import open_images
from drocap_ros.report import motion_images
from drocap_ros.report.motion_images import ImagesBeside, has_images, read_motion_images
from drocap_ros.report.page import page_data
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.render.renderer import Renderer
from drocap_ros.simulation.simulated_person import simulate_person
from lab.simulation.orbit import orbit_camera

cv2 = pytest.importorskip("cv2")


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def level(jpeg):
    """Grey level of an image, which identifies its frame."""
    return round(decoded(jpeg).mean())


@pytest.fixture
def folder(tmp_path):
    """Forty images at 30 per second, each of one grey level."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(40):
        cv2.imwrite(str(frames / f"{number:04d}.png"), np.full((240, 320, 3), 5 * number + 20, np.uint8))
    return frames


def seen_at(person, stamps):
    """A motion whose frames are at these stamps, its keypoints in the middle of a 320 x 240 image."""
    motion = first_frames(person, len(stamps))
    spread = np.random.default_rng(0).uniform(-20, 20, (len(stamps), 15, 2))
    return dataclasses.replace(motion, stamp_ns=np.asarray(stamps, np.int64), keypoints=np.array([160, 120]) + spread)


def test_images_match_the_frames_by_their_stamps(person, folder):
    stamps = np.round(np.arange(0, 40, 2) / 30.0 * 1e9)
    found = read_motion_images(folder, seen_at(person, stamps))
    assert found.frames == tuple(range(20))
    assert [level(j) for j in found.jpegs] == pytest.approx([5 * n + 20 for n in range(0, 40, 2)], abs=1)


def test_images_begun_with_the_tracks_are_those_of_the_motion(person, folder):
    motion = seen_at(person, np.round(np.arange(0, 40, 2) / 30.0 * 1e9))
    with ImagesBeside(folder, lambda *_: None) as images:
        images.begin(motion, motion.meta)
        assert images.of(motion) == read_motion_images(folder, motion)
    with ImagesBeside(folder, lambda *_: None) as images:
        assert images.of(motion) == read_motion_images(folder, motion)


@pytest.fixture
def walk(person, tmp_path):
    """Pictures of noise, and a motion whose keypoints wander through them, come nearer and are missing at times."""
    rng = np.random.default_rng(0)
    for number in range(40):
        cv2.imwrite(str(tmp_path / f"{number:04d}.png"), rng.integers(0, 255, (240, 320, 3), np.uint8))
    motion = seen_at(person, np.round(np.arange(40) / 30.0 * 1e9))
    grown = (motion.keypoints - [160, 120]) * np.linspace(1, 2, 40)[:, None, None]
    keypoints = grown + np.stack([np.linspace(60, 260, 40), np.linspace(80, 160, 40)], -1)[:, None]
    keypoints[[*range(5), *range(20, 30)]] = np.nan
    keypoints[15, 3:] = np.nan
    return tmp_path, dataclasses.replace(motion, keypoints=keypoints)


def keep_all(images, folder, motion):
    with open_images(folder) as source:
        for frame, keypoints in zip(source.frames, motion.keypoints, strict=True):
            images.keep(frame, PoseObservation(frame.stamp_ns, 1, (320, 240), keypoints=keypoints))


@pytest.mark.parametrize("waiting", [0, 4])
def test_images_kept_with_their_poses_are_those_that_a_second_reading_finds(walk, monkeypatch, waiting):
    folder, motion = walk
    monkeypatch.setattr(motion_images, "MAX_IMAGES", 30)
    expected = read_motion_images(folder, motion)
    done = []
    with ImagesBeside(folder, lambda *now: done.append(now), waiting) as images:
        keep_all(images, folder, motion)
        for number in range(40):
            (folder / f"{number:04d}.png").unlink()
        images.begin(motion, motion.meta)
        assert images.of(motion) == expected
    assert done == [("report", 1.0)]


@pytest.mark.parametrize("most", [39, 25])
def test_more_images_than_are_kept_are_read_again(walk, monkeypatch, most):
    folder, motion = walk
    monkeypatch.setattr(motion_images, "_MOST_KEPT", most)
    with ImagesBeside(folder, lambda *_: None) as images:
        keep_all(images, folder, motion)
        assert images.of(motion) == read_motion_images(folder, motion)


def test_the_crop_follows_the_subject_evenly(walk):
    folder, motion = walk
    boxes = np.array(read_motion_images(folder, motion).boxes)
    assert (boxes[:5] == [0, 0, 320, 240]).all()  # nobody was seen
    assert (boxes[20:30] == boxes[19]).all()
    outside = (motion.keypoints <= boxes[:, None, :2]) | (motion.keypoints >= boxes[:, None, 2:])
    assert not outside[np.isfinite(motion.keypoints)].any()
    assert np.abs(np.diff(boxes[5:20], axis=0)).max() < 15
    assert np.median(boxes[35:, 0]) > np.median(boxes[5:10, 0]) + 50


def test_a_failure_beside_ends_the_reading_of_images(person, folder):
    motion = seen_at(person, np.round(np.arange(40) / 30.0 * 1e9))
    read, go_on = [], threading.Event()

    def progress(*done):
        read.append(done)
        go_on.wait(30)

    images = ImagesBeside(folder, progress)
    images.begin(motion, motion.meta)
    threading.Timer(0.5, go_on.set).start()
    with pytest.raises(InputError), images:
        raise InputError("no pose")
    assert len(read) <= 1


def test_a_motion_with_another_clock_starts_with_the_first_image(person, folder):
    stamps = np.round(np.arange(0, 40, 4) / 30.0 * 1e9) + 1_700_000_000_000_000_000
    found = read_motion_images(folder, seen_at(person, stamps))
    assert [level(j) for j in found.jpegs] == pytest.approx([5 * n + 20 for n in range(0, 40, 4)], abs=1)


@pytest.mark.parametrize("left_out", [0, 2, 7])
def test_keypoints_lie_on_the_rendered_person_when_the_first_poses_were_left_out(person, tmp_path, left_out):
    count, matrix = 14, pinhole_matrix(320, 240, 60)
    t = 0.7 + np.arange(count) / 30.0
    joints = simulate_person(t, "mixed", 0)
    ahead = np.tile([0, 0, 0.9], (count, 1))
    rotation, position = orbit_camera(t, ahead + joints[:, 0] * [1, 1, 0], 4.0, 2.0, 60.0, 0.0)
    rotation = np.repeat(rotation[:1], count, axis=0)  # a tripod: the person moves in the picture
    position = np.repeat(position[:1], count, axis=0)
    places = project(joints, rotation, position, matrix)[:, :15]
    rendered = [Renderer(matrix, 320, 240).render(*view) for view in zip(joints, rotation, position, strict=True)]
    for number, image in enumerate(rendered):
        cv2.imwrite(str(tmp_path / f"{number:04d}.png"), image)
    motion = seen_at(person, np.round(np.arange(left_out, count) / 30.0 * 1e9))
    motion = dataclasses.replace(motion, keypoints=places[left_out:])
    images = read_motion_images(tmp_path, motion)
    data = page_data(motion, motion_statistics(motion), images)
    drawn = np.array(data["keypoints"]).reshape(-1, 15, 2) / 10.0
    assert len(images.jpegs) == count - left_out
    picture = data["image"]
    for place, jpeg, (x0, y0, x1, y1) in zip(picture["places"], images.jpegs, picture["boxes"], strict=True):
        shown = decoded(jpeg).astype(float)
        assert shown.shape[:2] == (y1 - y0, x1 - x0)
        differences = [np.abs(shown - image[y0:y1, x0:x1]).mean() for image in rendered]
        off = np.linalg.norm(drawn[place] - places[int(np.argmin(differences))], axis=1)
        assert off.max() < 3.0


def test_the_crop_holds_the_keypoints(person, folder):
    motion = seen_at(person, np.round(np.arange(20) / 30.0 * 1e9))
    boxes = np.array(read_motion_images(folder, motion).boxes)
    inside = (motion.keypoints > boxes[:, None, :2]) & (motion.keypoints < boxes[:, None, 2:])
    assert inside.all()
    assert np.prod(boxes[:, 2:] - boxes[:, :2], axis=1).max() < 0.3 * 320 * 240


def test_images_of_noise_stay_within_their_bytes(person, tmp_path, monkeypatch):
    monkeypatch.setattr(motion_images, "MAX_BYTES", 200_000)
    monkeypatch.setattr(motion_images, "MAX_IMAGES", 20)
    rng = np.random.default_rng(0)
    for number in range(20):
        cv2.imwrite(str(tmp_path / f"{number:04d}.png"), rng.integers(0, 255, (480, 640, 3), np.uint8))
    motion = seen_at(person, np.round(np.arange(20) / 30.0 * 1e9))
    keypoints = motion.keypoints * 2
    keypoints[:, 0], keypoints[:, 1] = (10, 10), (630, 470)
    motion = dataclasses.replace(motion, keypoints=keypoints)
    found = read_motion_images(tmp_path, motion)
    data = page_data(motion, motion_statistics(motion), found)
    assert sum(len(text) for text in data["image"]["jpeg"]) <= 200_000
    assert all(decoded(jpeg) is not None for jpeg in found.jpegs)


def test_long_motions_have_few_images(person, folder, monkeypatch):
    monkeypatch.setattr(motion_images, "MAX_IMAGES", 7)
    found = read_motion_images(folder, seen_at(person, np.round(np.arange(40) / 30.0 * 1e9)))
    assert len(found.jpegs) == 7
    assert found.frames[0] == 0
    assert found.frames[-1] == 39


def test_every_frame_of_a_real_video_has_its_image(person, shared):
    count = 40
    motion = seen_at(person, np.arange(count) * 200_000_000)
    motion = dataclasses.replace(motion, keypoints=motion.keypoints + np.array([200, 400]))
    found = read_motion_images(shared / "media" / "pose_squats.mp4", motion)
    assert found.frames == tuple(range(count))


def test_the_images_of_a_recording_are_found(person, tmp_path):
    """A ROS 1 bag written by rosbags, compressed images on a topic of its own."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    image, header, time = (
        store.types[name]
        for name in ("sensor_msgs/msg/CompressedImage", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    stamps = 1_700_000_000_000_000_000 + np.arange(12) * 100_000_000
    with Writer(tmp_path / "flight.bag") as bag:
        connection = bag.add_connection("/front/image/compressed", image.__msgtype__, typestore=store)
        for number, stamp in enumerate(stamps.tolist()):
            jpeg = cv2.imencode(".jpg", np.full((240, 320, 3), 10 * number + 50, np.uint8))[1].ravel()
            at = header(seq=number, stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="camera")
            message = image(header=at, format="jpeg", data=jpeg)
            bag.write(connection, stamp, store.serialize_ros1(message, image.__msgtype__))
    assert has_images(tmp_path / "flight.bag")
    found = read_motion_images(tmp_path / "flight.bag", seen_at(person, stamps[::2]))
    assert [level(j) for j in found.jpegs] == pytest.approx([10 * n + 50 for n in range(0, 12, 2)], abs=1)


def test_inputs_without_images_are_refused(person, tmp_path):
    motion = first_frames(person, 5)
    (tmp_path / "text.mp4").write_text("no video")
    for name in ("none.mp4", "text.mp4"):
        with pytest.raises(InputError, match=name):
            read_motion_images(tmp_path / name, motion)
    assert not has_images(tmp_path / "tracks.npz")
    assert has_images(tmp_path / "text.mp4")
