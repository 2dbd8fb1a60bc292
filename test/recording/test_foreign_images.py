"""Images in recordings of other programs: topics, clocks, encodings, packets of video."""

from __future__ import annotations

import base64
import itertools
import json
import struct

import numpy as np
import pytest
from recorded import NAMES, START_NS, image_message, random_image, record
from rendered_person import rendered_images

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.motion import load_motion
from drocap_ros.perception.sources.video import decoded_packets
from drocap_ros.recording.image_messages import image_from_message, read_images
from drocap_ros.recording.open_session import foxglove_message, open_session
from drocap_ros.tracks import load_tracks

cv2 = pytest.importorskip("cv2")
STEP_NS = 100_000_000


def jpeg(messages, image, stamp_ns):
    data = cv2.imencode(".jpg", image)[1].ravel()
    return messages(
        NAMES["compressed"], header=messages.header(stamp_ns), format="bgr8; jpeg compressed bgr8", data=data
    )


def raw(messages, pixels, encoding, stamp_ns=START_NS, step=None, **values):
    height, width = pixels.shape[:2] if "nv" not in encoding else (pixels.shape[0] * 2 // 3, pixels.shape[1])
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    return messages(
        NAMES["image"], header=messages.header(stamp_ns), height=height, width=width, encoding=encoding,
        step=step or data.size // pixels.shape[0], data=data, **values,
    )  # fmt: skip


def test_depth_is_passed_over_and_a_topic_chosen(tmp_path, messages, capsys):
    images, depth = rendered_images(4), np.full((48, 64), 3000, np.uint16)
    entries = []
    for i, image in enumerate(images):
        stamp = START_NS + i * STEP_NS
        for topic, message in (
            ("/aligned_depth/image_raw", raw(messages, depth, "16UC1", stamp)),
            ("/camera/image_raw", jpeg(messages, image, stamp)),
            ("/left/image_mono", raw(messages, depth.astype(np.uint8), "mono8", stamp)),
        ):
            entries.append((topic, message, stamp, messages.cdr(message)))
    record(tmp_path / "s", entries)
    words = ["track", str(tmp_path / "s"), "--models", "simulation", "--out"]
    assert main([*words, str(tmp_path / "a")]) == 0
    assert load_tracks(tmp_path / "a" / "tracks.npz").image_size == images[0].shape[1::-1]
    assert main([*words, str(tmp_path / "b"), "--topic", "camera/image_raw"]) == 0
    assert main([*words, str(tmp_path / "c"), "--topic", "/nothing"]) == 2
    assert "correct the name" in capsys.readouterr().err
    assert main(["reconstruct", *words[1:], str(tmp_path / "d"), "--topic", "/camera/image_raw", "--no-report"]) == 0
    assert load_motion(tmp_path / "d" / "motion.npz").meta["images"]["topic"] == "/camera/image_raw"
    with open_session(tmp_path / "s") as session:
        assert next(read_images(session, "/left/image_mono")).image.shape == (48, 64, 3)


@pytest.mark.parametrize("stamp", [lambda i: 0, lambda i: START_NS, lambda i: START_NS + i // 10 * 10**9])
def test_stamps_that_stand_still_give_way_to_the_recorder(tmp_path, messages, stamp):
    entries = []
    for i in range(12):
        message = image_message(messages, random_image(i), stamp(i))
        entries.append(("/camera", message, START_NS + i * STEP_NS, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        assert [f.stamp_ns for f in read_images(session)] == [START_NS + i * STEP_NS for i in range(12)]
        assert "do not advance" in session.warnings[0]


def test_stamps_from_before_the_clock_was_set_are_left_out(tmp_path, messages):
    entries = []
    for i in range(12):
        time_ns = START_NS + i * STEP_NS
        message = image_message(messages, random_image(i), time_ns if i > 2 else i * STEP_NS)
        entries.append(("/camera", message, time_ns, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        assert [f.stamp_ns for f in read_images(session)] == [START_NS + i * STEP_NS for i in range(3, 12)]
        assert "3 images on /camera were left out" in session.warnings[0]


@pytest.mark.parametrize(
    "encoding", ["mono16", "16UC1", "mono12", "bayer_rggb16", "rgb16", "bgr16", "nv12", "nv21", "8UC4"]
)
def test_encodings_keep_the_picture(messages, encoding):
    grey = np.tile(np.linspace(20, 220, 64).astype(np.uint8), (48, 1))
    pixels = {
        "nv12": np.vstack([grey, np.full((24, 64), 128, np.uint8)]),
        "nv21": np.vstack([grey, np.full((24, 64), 128, np.uint8)]),
        "8UC4": np.dstack([grey] * 4),
        "rgb16": np.dstack([grey.astype(np.uint16) * 16] * 3),
        "bgr16": np.dstack([grey.astype(np.uint16) * 16] * 3),
    }.get(encoding, grey.astype(np.uint16) * 16)
    for big in (False, True) if pixels.dtype == np.uint16 else (False,):
        data = pixels.astype(">u2") if big else pixels
        image = image_from_message(raw(messages, data, encoding, is_bigendian=int(big)))
        assert image.shape == (48, 64, 3)
        assert np.corrcoef(image.mean(axis=2).ravel(), grey.ravel())[0, 1] > 0.98
        assert np.ptp(image.mean(axis=2)) > 150


def video_packets(path, images):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), 10.0, images[0].shape[1::-1])
    if not writer.isOpened():
        pytest.skip("this OpenCV encodes no VP9")
    for image in images:
        writer.write(image)
    writer.release()
    reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    reader.set(cv2.CAP_PROP_FORMAT, -1)
    packets = []
    while (read := reader.read())[0]:
        packets.append(read[1].tobytes())
    return packets


def field(number, value):
    if isinstance(value, int):
        return bytes([number << 3 | 5]) + struct.pack("<I", value)
    size, head = len(value), b""
    while size > 0x7F:
        head, size = head + bytes([size & 0x7F | 0x80]), size >> 7
    return bytes([number << 3 | 2]) + head + bytes([size]) + value


def foxglove_file(path, kind, encoding, payloads):
    """An MCAP file of (bytes of an image or packet, format)."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        schema = writer.register_schema(f"foxglove.{kind}", "jsonschema" if encoding == "json" else "protobuf", b"{}")
        channel = writer.register_channel("/camera", encoding, schema)
        for i, (payload, form) in enumerate(payloads):
            stamp = START_NS + i * STEP_NS
            sec, nsec = divmod(stamp, 10**9)
            if encoding == "json":
                fields = {
                    "timestamp": {"sec": sec, "nsec": nsec},
                    "format": form,
                    "data": base64.b64encode(payload).decode(),
                }
                data = json.dumps(fields).encode()
            else:
                time = b"\x08" + bytes([sec >> s & 0x7F | 0x80 * (s < 28) for s in range(0, 35, 7)])
                time += b"\x10" + bytes([nsec >> s & 0x7F | 0x80 * (s < 28) for s in range(0, 35, 7)])
                parts = ((1, time), (2, payload), (3, form.encode()), (4, b"cam"))
                if kind == "CompressedVideo":
                    parts = ((1, time), (2, b"cam"), (3, payload), (4, form.encode()))
                data = b"".join(field(*part) for part in parts)
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
@pytest.mark.parametrize("kind", ["CompressedImage", "CompressedVideo"])
def test_foxglove_images_and_videos_are_read(tmp_path, encoding, kind):
    images = [cv2.GaussianBlur(random_image(i, (96, 128, 3)), (0, 0), 9) for i in range(8)]
    if kind == "CompressedImage":
        payloads = [(cv2.imencode(".jpg", image)[1].tobytes(), "jpeg") for image in images]
    else:
        payloads = [(packet, "vp9") for packet in video_packets(tmp_path / "a.webm", images)]
    path = foxglove_file(tmp_path / "a.mcap", kind, encoding, payloads)
    with open_session(path) as session:
        frames = list(read_images(session))
        assert session.warnings == []
    assert [f.stamp_ns for f in frames] == [START_NS + i * STEP_NS for i in range(8)]
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(frame.image.astype(int) - image).mean() < 6


@pytest.mark.parametrize(("encoding", "nothing"), [("json", b'{"timestamp": {}}'), ("protobuf", b"")])
def test_what_a_message_leaves_out_is_zero(encoding, nothing):
    found = foxglove_message(nothing, encoding, "foxglove.RawImage")
    assert (found.timestamp.sec, found.timestamp.nanosec, found.width, found.encoding) == (0, 0, 0, "")


@pytest.mark.parametrize(
    ("codec", "first"), [("hevc_nvenc", b"\0\0\0\x01\x40\x01"), ("libx264", b"\0\0\x01\x67"), ("vvc", b"")]
)
def test_codecs_without_a_picture_are_named(codec, first):
    with pytest.raises(InputError, match="H.265, VP9, AV1 or MJPEG" if codec == "vvc" else "expected a"):
        list(decoded_packets(codec, [(START_NS + i, first + b"\0" * 50) for i in range(3)]))


@pytest.mark.parametrize("name", ["ffmpeg_packet", "fox_video"])
def test_h264_packets_are_read(shared, name):
    with open_session(shared / "cases" / "video_messages_mcap" / name) as session:
        frames = list(read_images(session))
    assert len(frames) == 24
    assert {round((b.stamp_ns - a.stamp_ns) * 1e-6) for a, b in itertools.pairwise(frames)} == {67}


def test_video_in_compressed_images_is_read(shared):
    with open_session(shared / "cases" / "bag_h264_in_compressedimage" / "walk") as session:
        assert len(list(read_images(session))) == 24


def test_damaged_messages_end_in_one_line(tmp_path):
    """Seeded mutations of images and packets in both encodings: refused in one line, or left out."""
    rng = np.random.default_rng(0)
    packets = video_packets(tmp_path / "a.webm", [random_image(i) for i in range(3)])
    for number in range(40):
        kind, encoding = ("CompressedImage", "CompressedVideo")[number % 2], ("json", "protobuf")[number // 2 % 2]
        payloads = []
        for packet in packets:
            data = bytearray(packet)
            for at in rng.integers(0, len(data), 4):
                data[at] = rng.integers(256)
            payloads.append(
                (bytes(data[: rng.integers(0, len(data))]), ("vp9", "h264", "jpeg", "\x1b")[rng.integers(4)])
            )
        path = foxglove_file(tmp_path / "b.mcap", kind, encoding, payloads)
        try:
            with open_session(path) as session:
                assert len(list(read_images(session))) <= len(packets)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize(
    "message",
    [
        {"timestamp": 5, "data": "", "format": "jpeg"},
        {"timestamp": {"sec": 10**30, "nsec": 0}, "data": "/9j/", "format": "jpeg"},
        {"timestamp": {"sec": -1, "nsec": 10**12}, "data": "no base 64!", "format": 7},
        {"timestamp": {"sec": 1}, "data": 12, "format": None},
        {"timestamp": None},
        [1, 2],
        "text",
    ],
)
@pytest.mark.parametrize("kind", ["CompressedImage", "CompressedVideo", "RawImage"])
def test_json_of_wrong_types_ends_in_one_line(tmp_path, capsys, message, kind):
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        schema = writer.register_schema(f"foxglove.{kind}", "jsonschema", b"{}")
        channel = writer.register_channel("/camera", "json", schema)
        for i in range(3):
            writer.add_message(channel, START_NS + i, json.dumps(message).encode(), START_NS + i)
        writer.finish()
    words = ["--models", "simulation", "--quiet", "--out", str(tmp_path / "out")]
    assert main(["track", str(tmp_path / "a.mcap"), *words]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("steps_s", [{12: -40.0}, {12: 3600.0}, {8: 5.0, 16: -70.0}, {6: -1.5}, {18: 86_400.0 * 400}])
@pytest.mark.parametrize("latency", ["even", "late once", "paused"])
def test_a_clock_that_is_set_costs_no_image(tmp_path, messages, steps_s, latency):
    entries, off_s, time_ns = [], 0.0, START_NS
    for i in range(24):
        off_s += steps_s.get(i, 0.0)
        time_ns += 30 * 10**9 if latency == "paused" and i == 10 else STEP_NS
        late_ns = 3 * 10**9 - (i - 18) * STEP_NS if latency == "late once" and 18 <= i < 20 else 5_000_000
        message = image_message(messages, random_image(i), time_ns + round(off_s * 1e9))
        entries.append(("/camera", message, time_ns + late_ns, messages.cdr(message)))
    expected = np.diff([START_NS + STEP_NS * i + (30 * 10**9 - STEP_NS) * (latency == "paused" and i >= 10)
                        for i in range(24)])  # fmt: skip
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        found = np.array([f.stamp_ns for f in read_images(session)])
        assert np.abs(np.diff(found) - expected).max() < 10**7
        assert sum("was set during the recording" in warning for warning in session.warnings) >= 1


def test_files_of_a_mac_and_an_edited_description_change_nothing(tmp_path, messages):
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, folder = get_typestore(Stores.ROS2_JAZZY), tmp_path / "bag"
    kind = store.types["sensor_msgs/msg/CompressedImage"]
    stamp, header = (store.types[f"{name}"] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    with Writer(folder, version=9) as writer:
        topic = writer.add_connection("/camera", kind.__msgtype__, typestore=store)
        for i in range(12):
            data = cv2.imencode(".jpg", random_image(i))[1].ravel()
            message = kind(header(stamp(sec=100, nanosec=i * STEP_NS), "c"), "jpeg", data)
            writer.write(topic, START_NS + i * STEP_NS, store.serialize_cdr(message, kind.__msgtype__))
    (folder / "._bag.db3").write_bytes(bytes(100))
    text = (folder / "metadata.yaml").read_text()
    for before, after in (("''", "edited"), ("[]", "[{depth: 3}]")):
        text = text.replace(f"offered_qos_profiles: {before}", f"offered_qos_profiles: {after}")
    (folder / "metadata.yaml").write_text(text)
    with open_session(folder) as session:
        assert len(list(read_images(session))) == 12


def test_one_part_of_a_recording_is_said_to_be_one(tmp_path, messages):
    for i in range(3):
        message = image_message(messages, random_image(i), START_NS + i * STEP_NS)
        record(tmp_path / f"s{i}", [("/camera", message, START_NS, messages.cdr(message))])
        next((tmp_path / f"s{i}").glob("*.mcap")).rename(tmp_path / f"walk_{i}.mcap")
    with open_session(tmp_path / "walk_1.mcap") as session:
        assert any("is one of 3 parts; name the folder" in warning for warning in session.warnings)


@pytest.mark.parametrize(("suffix", "head", "command"), [
    (".zstd", b"\x28\xb5\x2f\xfd", "zstd -d"), (".gz", b"\x1f\x8b\x08", "gunzip"), (".bz2", b"BZh9", "bunzip2"),
    (".xz", b"\xfd7zXZ\x00", "unxz"), (".lz4", b"\x04\x22\x4d\x18", "unlz4"), (".7z", b"7z\xbc\xaf\x27\x1c", "7z x"),
    (".zip", b"PK\x03\x04", "unzip"),
])  # fmt: skip
@pytest.mark.parametrize("name", ["a.db3", "a.mcap", "a.bag", "walk.mp4"])
@pytest.mark.parametrize("command_of_ours", ["info", "track", "reconstruct"])
def test_packed_files_are_refused_with_the_command_that_unpacks(tmp_path, capsys, suffix, head, command, name,
                                                                command_of_ours):  # fmt: skip
    path = tmp_path / f"{name}{suffix}"
    path.write_bytes(head + bytes(200))
    assert main([command_of_ours, str(path), *["--models", "simulation"] * (command_of_ours != "info")]) == 2
    assert f"unpack it: {command} {path}" in capsys.readouterr().err
