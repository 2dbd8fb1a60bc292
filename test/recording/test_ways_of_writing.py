"""The same images and lens out of every way in which recorders pack, split, name and describe a recording."""

from __future__ import annotations

import base64
import json
import shutil
import sqlite3
import struct
from fractions import Fraction

import numpy as np
import pytest
from recorded import NAMES, START_NS, random_image, record

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.image_messages import image_from_message, read_images
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.other_poses import read_other_poses
from drocap_ros.recording.pose_messages import lens_of
from drocap_ros.recording.session_tracks import with_recorded_camera
from drocap_ros.tracks import Tracks

cv2 = pytest.importorskip("cv2")
STEP_NS, COUNT = 50_000_000, 12
MATRIX = np.array([60.0, 0, 32, 0, 60, 24, 0, 0, 1])


def jpeg(i, size=(48, 64, 3)):
    return cv2.imencode(".jpg", random_image(i, size))[1].ravel()


def entries(messages, count=COUNT):
    found = {"/camera/image": [], "/camera/camera_info": []}
    for i in range(count):
        header = messages.header(START_NS + i * STEP_NS)
        found["/camera/image"].append(messages(NAMES["compressed"], header=header, format="jpeg", data=jpeg(i)))
        values = {"height": 48, "width": 64, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": MATRIX}
        found["/camera/camera_info"].append(messages(NAMES["info"], header=header, **values))
    return found


def write(folder, messages, storage, packing="NONE", found=None, store=None):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage])
    if packing != "NONE":
        writer.set_compression(CompressionMode[packing], CompressionFormat.ZSTD)
    store = store or messages.store
    with writer:
        for topic, group in (found or entries(messages)).items():
            connection = writer.add_connection(topic, group[0].__msgtype__, typestore=store)
            for i, message in enumerate(group):
                data = bytes(store.serialize_cdr(message, message.__msgtype__))
                writer.write(connection, START_NS + i * STEP_NS, data)
    return folder


def read(path, near="/camera/image"):
    """Number of images, and the camera's matrix or None."""
    with open_session(path) as session:
        images = list(read_images(session))
        size = images[0].image.shape[1::-1]
        stamps = np.array([image.stamp_ns for image in images])
        names = tuple(f"j{i}" for i in range(17))
        tracks = with_recorded_camera(session, Tracks(np.full((len(images), 17, 2), 20.0), names, stamps, size), near)
        return len(images), tracks.camera_matrix


def is_whole(path):
    count, matrix = read(path)
    return count == COUNT and matrix is not None and np.allclose(matrix.ravel(), MATRIX)


@pytest.mark.parametrize(("storage", "packing"), [
    ("SQLITE3", "NONE"), ("SQLITE3", "FILE"), ("SQLITE3", "MESSAGE"), ("MCAP", "NONE"), ("MCAP", "FILE"),
    ("MCAP", "MESSAGE"), ("MCAP", "STORAGE"),
])  # fmt: skip
def test_every_packing_is_read(tmp_path, messages, storage, packing):
    import zstandard

    folder = write(tmp_path / "s", messages, storage, packing)
    assert is_whole(folder)
    assert is_whole(folder / "metadata.yaml")
    file = next(path for path in folder.iterdir() if path.name != "metadata.yaml")
    if packing == "FILE":  # unpacked by hand, as the refusal of such a file says
        data = zstandard.ZstdDecompressor().decompressobj().decompress(file.read_bytes())
        file.unlink()
        file = file.with_suffix("")
        file.write_bytes(data)
        assert is_whole(folder)
    assert is_whole(file)
    file.rename(file.with_stem("walk"))
    assert is_whole(folder)
    (folder / "metadata.yaml").unlink()
    assert is_whole(folder)


@pytest.mark.parametrize("kept", [1, 7, 19])
def test_messages_in_the_journal_of_a_killed_recorder_are_read(tmp_path, messages, kept):
    folder = write(tmp_path / "s", messages, "SQLITE3")
    base = sqlite3.connect(folder / "s.db3")
    base.execute("PRAGMA journal_mode=WAL")
    rows = base.execute("SELECT * FROM messages WHERE id > ?", (kept,)).fetchall()
    base.execute("DELETE FROM messages WHERE id > ?", (kept,))
    base.commit()
    base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    base.executemany(f"INSERT INTO messages VALUES({','.join('?' * len(rows[0]))})", rows)
    base.commit()
    shutil.copytree(folder, tmp_path / "copied")  # as it lies on the disk while the recorder runs
    base.close()
    assert (tmp_path / "copied" / "s.db3-wal").stat().st_size
    assert is_whole(tmp_path / "copied")
    with open_session(tmp_path / "copied" / "s.db3") as session:
        assert "journal" in session.warnings[0]


def test_the_tables_of_the_first_distributions_are_read(tmp_path, messages):
    """Until Eloquent topics have no quality of service, until Humble there are no definitions."""
    folder = write(tmp_path / "s", messages, "SQLITE3")
    base = sqlite3.connect(folder / "s.db3")
    base.executescript(
        "CREATE TABLE t (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
        "INSERT INTO t SELECT id, name, type, serialization_format FROM topics; DROP TABLE topics;"
        "ALTER TABLE t RENAME TO topics; DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata;"
    )
    base.close()
    assert is_whole(folder)
    (folder / "metadata.yaml").unlink()
    assert is_whole(folder)


PACKET = "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n" \
    "bool is_bigendian\nuint8[] data\n"  # fmt: skip


def with_type(kind, text):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, kind))
    return store


@pytest.mark.parametrize("defined", [True, False])
def test_packets_of_video_need_no_definition(tmp_path, messages, defined):
    av = pytest.importorskip("av")
    kind = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    store = with_type(kind, PACKET)
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 64, 48, "yuv420p", Fraction(1, 20)
    encoder.options = {"tune": "zerolatency"}
    pictures = (av.VideoFrame.from_ndarray(random_image(i // 4, (48, 64, 3)), "bgr24") for i in range(COUNT))
    data = [bytes(packet) for picture in (*pictures, None) for packet in encoder.encode(picture)]
    header, time = (store.types[name] for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    packets = [
        store.types[kind](header=header(time(*divmod(START_NS + i * STEP_NS, 10**9)), "c"), width=64, height=48,
                          encoding="h264", pts=i, flags=0, is_bigendian=False, data=np.frombuffer(packet, np.uint8))
        for i, packet in enumerate(data)
    ]  # fmt: skip
    folder = write(tmp_path / "s", messages, "SQLITE3", found={"/camera/image": packets}, store=store)
    if not defined:
        base = sqlite3.connect(folder / "s.db3")
        base.execute("DELETE FROM message_definitions")
        base.commit()
        base.close()
    assert read(folder)[0] == COUNT


def test_images_that_nobody_can_decode_are_refused_with_their_type(tmp_path, messages, capsys):
    folder = write(tmp_path / "s", messages, "SQLITE3", found={"/a": entries(messages)["/camera/image"]})
    base = sqlite3.connect(folder / "s.db3")
    base.execute("UPDATE messages SET data = x'0001000005'")
    base.commit()
    base.close()
    with open_session(folder) as session, pytest.raises(InputError, match="12 messages of sensor_msgs/msg/Compressed"):
        list(read_images(session))
    assert main(["track", str(folder), "--models", "simulation", "--out", str(tmp_path / "out")]) == 2
    assert "record them with their definition" in capsys.readouterr().err


def fields(values):
    """Protobuf of (number, value): bytes, an integer of 32 bits, or doubles."""
    out = b""
    for number, value in values:
        if isinstance(value, int):
            out += bytes([number << 3 | 5]) + struct.pack("<I", value)
        else:
            value = value if isinstance(value, bytes) else np.asarray(value, "<f8").tobytes()
            head, size = b"", len(value)
            while size > 0x7F:
                head, size = head + bytes([size & 0x7F | 0x80]), size >> 7
            out += bytes([number << 3 | 2]) + head + bytes([size]) + value
    return out


def varint(number, value):
    return bytes([number << 3]) + bytes([value >> s & 0x7F | 0x80 * (s < 28) for s in range(0, 35, 7)])


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
@pytest.mark.parametrize("packing", ["LZ4", "ZSTD", "NONE"])
@pytest.mark.parametrize("indexed", [True, False])
def test_foxglove_s_calibration_is_the_lens(tmp_path, encoding, packing, indexed):
    from mcap.writer import CompressionType, Writer

    with (tmp_path / "f.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType[packing], use_chunking=indexed, use_statistics=indexed)
        writer.start("", "")
        form = "jsonschema" if encoding == "json" else "protobuf"
        image, lens = (
            writer.register_channel(topic, encoding, writer.register_schema(f"foxglove.{kind}", form, b"{}"))
            for topic, kind in (("/camera/image", "CompressedImage"), ("/camera/lens", "CameraCalibration"))
        )
        for i in range(COUNT):
            stamp = START_NS + i * STEP_NS
            sec, nsec = divmod(stamp, 10**9)
            if encoding == "json":
                time = {"timestamp": {"sec": sec, "nsec": nsec}}
                content = base64.b64encode(jpeg(i).tobytes()).decode()
                both = [{**time, "format": "jpeg", "data": content},
                        {**time, "width": 64, "height": 48, "distortion_model": "", "K": MATRIX.tolist()}]  # fmt: skip
                data = [json.dumps(message).encode() for message in both]
            else:
                time = varint(1, sec) + varint(2, nsec)
                data = [fields([(1, time), (2, jpeg(i).tobytes()), (3, b"jpeg")]),
                        fields([(1, time), (2, 64), (3, 48), (5, np.zeros(5)), (6, MATRIX)])]  # fmt: skip
            for channel, message in zip((image, lens), data, strict=True):
                writer.add_message(channel, stamp, message, stamp)
        writer.finish()
    assert is_whole(tmp_path / "f.mcap")


@pytest.mark.parametrize(("name", "count", "known"), [
    ("equidistant", 4, "equidistant"), ("fisheye", 4, "equidistant"), ("radtan", 4, "plumb_bob"), ("", 5, "plumb_bob"),
    ("plumb_bob", 5, "plumb_bob"), ("ds", 6, None),
])  # fmt: skip
def test_other_names_of_a_distortion_are_known(messages, name, count, known):
    values = {"height": 48, "width": 64, "k": MATRIX, "d": np.full(count, 0.01)}
    lens, words = lens_of(messages(NAMES["info"], distortion_model=name, **values))
    assert bool(words) == (known is None)
    assert not lens.distortion.any() if known is None else lens.distortion_model == known


@pytest.mark.parametrize("stated", [True, False])
def test_an_attitude_that_an_imu_says_it_lacks_is_none(tmp_path, messages, stated):
    covariance = np.zeros(9) if stated else np.array([-1.0, *np.zeros(8)])
    written = []
    for i in range(COUNT):
        stamp = START_NS + i * STEP_NS
        values = {"orientation": messages.quaternion((0, 0, 0, 1)), "orientation_covariance": covariance}
        message = messages("sensor_msgs/msg/Imu", header=messages.header(stamp), **values)
        written.append(("/imu/data", message, stamp, messages.cdr(message)))
    record(tmp_path / "s", written)
    with open_session(tmp_path / "s") as session:
        found = read_other_poses(session)
    assert np.isfinite(found.orientation).all() == stated
    assert np.isnan(found.orientation).all() != stated


@pytest.mark.parametrize("stamp", [lambda i: 0, lambda i: START_NS, lambda i: START_NS + i * STEP_NS])
def test_poses_whose_stamps_stand_still_have_the_recorder_s_times(tmp_path, messages, stamp):
    written = []
    for i in range(COUNT):
        pose = messages("geometry_msgs/msg/Pose", position=messages("geometry_msgs/msg/Point", x=float(i)),
                        orientation=messages.quaternion((0, 0, 0, 1)))  # fmt: skip
        message = messages("geometry_msgs/msg/PoseStamped", header=messages.header(stamp(i)), pose=pose)
        written.append(("/drone/pose", message, START_NS + i * STEP_NS, messages.cdr(message)))
    record(tmp_path / "s", written)
    with open_session(tmp_path / "s") as session:
        found = read_other_poses(session)
        assert found.stamp_ns.tolist() == [START_NS + i * STEP_NS for i in range(COUNT)]
        assert found.position[:, 0].tolist() == list(range(COUNT))
        assert any("do not advance" in words for words in session.warnings) == (stamp(0) == stamp(1))


@pytest.mark.parametrize(("small", "large", "wanted"), [(12, 12, 64), (12, 8, 64), (12, 3, 32), (3, 12, 64)])
@pytest.mark.parametrize("damaged", [False, True])
def test_a_preview_is_not_taken_for_the_picture(tmp_path, messages, small, large, wanted, damaged):
    written = []
    for topic, count, size in (("/a/preview", small, (24, 32, 3)), ("/z/image", large, (48, 64, 3))):
        for i in range(count):
            data = jpeg(i, size)[: 200 if damaged and topic == "/a/preview" and i == 0 else None]
            stamp = START_NS + i * STEP_NS
            message = messages(NAMES["compressed"], header=messages.header(stamp), format="jpeg", data=data)
            written.append((topic, message, stamp, messages.cdr(message)))
    record(tmp_path / "s", written)
    with open_session(tmp_path / "s") as session:
        assert next(read_images(session)).image.shape[1] == wanted
        assert "several topics of images" in session.warnings[0]


@pytest.mark.parametrize(("encoding", "count"), [
    ("BGR8", 3), ("bgr", 3), ("Bgra8", 4), ("gray8", 1), ("GREY", 1), ("Y8", 1), ("mono", 1), (" bgr8", 3), ("y16", 2),
])  # fmt: skip
@pytest.mark.parametrize("step", [True, False])
def test_raw_images_are_read_in_other_spellings_and_without_a_step(messages, encoding, count, step):
    shape = (48, 64) if count in (1, 2) else (48, 64, count)
    pixels = np.random.default_rng(0).integers(0, 255, shape, np.uint8).astype(np.uint16 if count == 2 else np.uint8)
    header, data = messages.header(START_NS), pixels.view(np.uint8).ravel()
    message = messages(NAMES["image"], header=header, height=48, width=64, encoding=encoding, data=data,
                       step=64 * count * step)  # fmt: skip
    image = image_from_message(message)
    assert image.shape == (48, 64, 3)
    if count != 2:
        assert (image == (pixels[..., :3] if pixels.ndim == 3 else pixels[..., None])).all()


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize(
    "form", ["bayer_{}8; jpeg compressed ", "bayer_{}8; png compressed", "bayer_{}8;jpeg compressed bgr8"]
)
def test_a_compressed_mosaic_becomes_a_picture(messages, pattern, form):
    colour = np.full((48, 64, 3), (40, 90, 200), np.uint8)  # blue green red
    picture = colour
    if not form.endswith("bgr8"):  # else the publisher has made a picture of it
        picture = np.empty((48, 64), np.uint8)
        for i, letter in enumerate(pattern):
            picture[i // 2 :: 2, i % 2 :: 2] = dict(zip("bgr", colour[0, 0], strict=True))[letter]
    data = cv2.imencode(".png", picture)[1].ravel()
    message = messages(NAMES["compressed"], header=messages.header(START_NS), format=form.format(pattern), data=data)
    assert np.abs(image_from_message(message)[4:-4, 4:-4].astype(int) - colour[4:-4, 4:-4]).max() < 3
