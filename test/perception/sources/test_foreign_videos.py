"""Videos that other programs write."""

from __future__ import annotations

import struct

import av
import numpy as np
import pytest
from test_sources import patch_box, write_video

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.open_images import open_images
from drocap_ros.perception.sources import SourceEventKind, open_source
from drocap_ros.perception.sources.image_files import to_bgr

cv2 = pytest.importorskip("cv2")


@pytest.mark.parametrize(
    "text",
    [
        "a man walks\n" * 60,
        "#EXTM3U\n#EXTINF:1,\nother.mp4\n",
        "\x1b[42m   \x1b[0m\n" * 99,
        "The free text\n" + "\x1b[42m   \x1b[0m\n" * 99,
        "GIF89a is a format\n" * 60,
    ],
)
@pytest.mark.parametrize("name", ["notes.txt", "clip.mp4"])
def test_text_is_no_video(tmp_path, capsys, text, name):
    write_video(tmp_path / "other.mp4")
    (tmp_path / name).write_text(text)
    words = ["--models", "simulation", "--out", str(tmp_path / "out")]
    assert main(["track", str(tmp_path / name), *words]) == 2
    assert main(["reconstruct", str(tmp_path / name), *words]) == 2
    err = capsys.readouterr().err
    assert err.count("found text") == 2
    assert err.count("\n") == 2


def test_names_do_not_decide(tmp_path):
    write_video(tmp_path / "a.mp4").rename(tmp_path / "video")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((10, 12, 3), 90, np.uint8))
    (tmp_path / "a.png").rename(tmp_path / "image.mp4")
    for name, size in (("video", (64, 48)), ("image.mp4", (12, 10))):
        with open_source(tmp_path / name) as source:
            assert source.size == size


@pytest.mark.parametrize(
    ("across", "down", "size"), [(4, 3, (85, 48)), (1, 2, (64, 96)), (1, 1, (64, 48)), (900, 1, (64, 48))]
)
def test_pixels_that_are_no_squares_are_shown_as_they_are(tmp_path, across, down, size):
    path = write_video(tmp_path / "a.mp4")
    data = path.read_bytes()
    # An MPEG-4 stream states the shape in its own header; the container's box takes precedence.
    box = struct.pack(">I4sII", 16, b"pasp", across, down)
    at = data.index(b"mp4v") - 4
    grown = bytearray(data)
    found = data.find(b"pasp", at)
    if found > 0:
        grown[found - 4 : found + 12] = box
    else:
        length = struct.unpack(">I", data[at : at + 4])[0]
        grown[at + length : at + length] = box
        for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
            place = data.index(name) - 4
            grown[place : place + 4] = struct.pack(">I", struct.unpack(">I", data[place : place + 4])[0] + len(box))
    path.write_bytes(bytes(grown))
    with open_source(path) as source:
        frame = next(iter(source))
    assert source.size == size
    assert frame.image.shape[1::-1] == size


def test_largest_of_several_streams_is_read(tmp_path):
    """A second video track of twice the size behind the first: that of another file, its samples appended."""
    small, large = (write_video(tmp_path / f"{k}.mp4", size=(64 * k, 48 * k)).read_bytes() for k in (1, 2))
    shift = len(small)

    def box(data, name):
        at = data.index(name) - 4
        return at, struct.unpack(">I", data[at : at + 4])[0]

    at, size = box(large, b"trak")
    track = bytearray(large[at : at + size])
    place = track.index(b"stco") + 8
    for i in range(struct.unpack(">I", track[place : place + 4])[0]):
        spot = place + 4 + 4 * i
        track[spot : spot + 4] = struct.pack(">I", struct.unpack(">I", track[spot : spot + 4])[0] + shift)
    at, size = box(small, b"moov")
    moov = bytearray(small[at : at + size]) + track
    moov[:4] = struct.pack(">I", len(moov))
    whole = bytearray(small[:at] + small[at : at + size].replace(b"moov", b"free", 1) + small[at + size :])
    path = tmp_path / "two streams.mp4"
    path.write_bytes(bytes(whole) + large.replace(b"moov", b"free", 1).replace(b"ftyp", b"free", 1) + bytes(moov))
    with open_source(path) as source:
        assert source.size == (128, 96)
        assert len(list(source)) == 12


def test_trimmed_video_is_whole(tmp_path, caplog):
    """An edit list that shows the first 20 of 60 frames, as after a trim."""
    path = write_video(tmp_path / "a.mp4", frames=60)

    def shorter(content: bytes) -> bytes:
        scale = struct.unpack(">I", content[12:16])[0]
        return content[:16] + struct.pack(">I", 2 * scale) + content[20:]

    def edit(content: bytes) -> bytes:
        scale = struct.unpack(">I", path.read_bytes()[path.read_bytes().index(b"mvhd") + 16 :][:4])[0]
        return content[:8] + struct.pack(">I", 2 * scale) + content[12:]

    if b"elst" not in path.read_bytes():
        pytest.skip("this OpenCV writes no edit list")
    patch_box(path, b"mvhd", shorter)
    patch_box(path, b"elst", edit)
    with open_source(path) as source:
        assert source.length == 20
        assert 19 <= len(list(source)) <= 22
        assert source.events() == []
    assert "ended early" not in caplog.text


def test_info_knows_videos_of_any_name_and_container(tmp_path, capsys):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(6):
        writer.write(np.full((48, 64, 3), 30 * i, np.uint8))
    writer.release()
    path.rename(tmp_path / "clip")
    assert main(["info", str(tmp_path / "clip")]) == 0
    assert "64x48 px, 6 samples, 10.00/s" in capsys.readouterr().out


def test_black_pictures_are_not_nobody(tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for _ in range(6):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert main(["track", str(tmp_path / "a.mp4"), "--models", "simulation", "--out", str(tmp_path / "out")]) == 2
    assert "expected pictures, found 6 of one colour" in capsys.readouterr().err


def read(path):
    with open_source(path) as source:
        return list(source)


def write_h264(path, frames, codec="libx264", options=None, edit=None):
    """Moving blocks, 10 images/s; ``edit`` sets properties of the stream and of each frame."""
    with av.open(str(path), "w", options=options or {}) as file:
        stream = file.add_stream(codec, 10)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        for i in range(frames):
            image = np.full((96, 128, 3), 60, np.uint8)
            image[20:60, 8 * (i % 10) + 4 : 8 * (i % 10) + 34] = 220
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            if edit:
                edit(stream, frame)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("codec", ["libsvtav1", "libvpx-vp9", "libx264", "mpeg4"])
def test_each_codec_is_decoded(tmp_path, codec):
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg writes no {codec}")
    frames = read(write_h264(tmp_path / "a.mp4", 12, codec))
    assert [frame.stamp_ns for frame in frames] == [100_000_000 * i for i in range(12)]
    assert frames[3].image[40, 45].min() > 180
    assert frames[3].image[80, 45].max() < 90


def test_ordinary_pictures_are_those_of_opencv(tmp_path):
    """Bit for bit, with their times."""
    path = write_h264(tmp_path / "a.mp4", 20)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    for frame in read(path):
        assert np.array_equal(capture.read()[1], frame.image)
        assert round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6) == frame.stamp_ns


def test_interlaced_pictures_become_progressive(tmp_path):
    """Lines of a still picture stay, those of a moving one are no combs."""

    def interlaced(stream, frame):
        stream.codec_context.flags |= 1 << 18 | 1 << 29

    path = write_h264(tmp_path / "a.mp4", 12, "mpeg2video", {}, interlaced)
    with av.open(str(path)) as file:
        assert any(frame.interlaced_frame for frame in file.decode(video=0))
    frames = read(path)
    assert [frame.stamp_ns for frame in frames] == [100_000_000 * i for i in range(12)]
    assert np.median(np.abs(np.diff(frames[5].image[24:56, 30:70].astype(int), axis=0))) <= 2


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), lambda image: image),
        ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
        ((1, 0, 0, -1), lambda image: image[::-1]),
        ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
        ((0, -1, 1, 0), lambda image: np.rot90(image)),
        ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
    ],
    ids=["as it is", "mirrored", "upside down", "turned right", "turned left", "transposed"],
)
def test_the_display_matrix_is_applied(tmp_path, matrix, shown):
    path = write_h264(tmp_path / "a.mp4", 3)
    plain = read(path)[0].image

    def edit(content):
        a, b, c, d = (value << 16 for value in matrix)
        return content[:40] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + content[76:]

    patch_box(path, b"tkhd", edit)
    assert np.array_equal(read(path)[0].image, shown(plain))


def test_decoding_goes_on_after_damage(tmp_path, caplog):
    path = write_h264(tmp_path / "a.mp4", 60, "mpeg4")
    with av.open(str(path)) as file:
        packets = [(packet.pos, packet.size) for packet in file.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for place, size in packets[29:32]:
        data[place : place + size] = bytes(size)
    path.write_bytes(data)
    with open_source(path) as source:
        stamps = [frame.stamp_ns for frame in source]
        kinds = [event.kind for event in source.events()]
    assert stamps[-1] == 5_900_000_000
    assert 57 <= len(stamps) <= 59
    assert kinds == [SourceEventKind.DAMAGED]
    assert "packets that do not decode" in caplog.text


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("av1_codec/av1.mp4", 24), ("interlaced_black/interlaced.mp4", 24), ("still_start/black_start.mp4", 60),
        ("decode_errors_midway/biterrors.mp4", 59), ("trimmed_edit_list/trimmed.mp4", 32),
    ],
)  # fmt: skip
def test_videos_of_users_are_read(shared, name, count):
    assert len(read(shared / "cases" / name)) == count


def test_a_video_in_fragments_is_read(tmp_path):
    """Its index holds no samples; they stand between its parts, as browsers and streaming programs write."""
    write_h264(tmp_path / "a.mp4", 12, options={"movflags": "frag_keyframe+empty_moov"})
    assert main(["info", str(tmp_path / "a.mp4")]) == 0
    assert len(read(tmp_path / "a.mp4")) == 12


def test_an_elementary_stream_is_no_index_of_an_mp4(tmp_path):
    """Its first bytes are a box of a size in 64 bits, beyond any file."""
    (tmp_path / "a.h264").write_bytes(b"\0\0\0\x01\x67\x64\0\x1e" + b"\xff" * 400)
    with pytest.raises(InputError, match="expected a video"):
        open_source(tmp_path / "a.h264")


def test_unknown_codec_is_named(tmp_path):
    path = write_video(tmp_path / "a.mp4")
    data = bytearray(path.read_bytes())
    at = data.index(b"stsd") + 16
    data[at : at + 4] = b"aprn"
    data = data.replace(b"esds", b"free")
    path.write_bytes(data)
    with pytest.raises(InputError, match="Apple ProRes RAW"):
        open_source(path)


def test_a_still_picture_is_a_video(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for _ in range(40):
        writer.write(random_picture())
    writer.release()
    with open_source(tmp_path / "a.mp4") as source:
        assert len(list(source)) == 40


def random_picture():
    return np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(("low", "high"), [(0, 4095), (7000, 9000), (0, 65535)], ids=["12 bit", "thermal", "16 bit"])
def test_sixteen_bits_keep_their_contrast(low, high):
    ramp = np.linspace(low, high, 64 * 64).reshape(64, 64).astype(np.uint16)
    ramp[0, 0] = 65535  # a dead pixel
    image = to_bgr(ramp)
    assert image.std() > 60
    assert image[40, 40, 0] > image[20, 20, 0]


def test_damaged_heads_end_in_one_line(tmp_path):
    """Seeded mutations of whole files: refused in one line, or read."""
    rng = np.random.default_rng(0)
    whole = write_video(tmp_path / "a.mp4", frames=4).read_bytes()
    for number in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 12)):
            data[at] = rng.integers(256)
        data = data[: rng.integers(1, len(data))] if number % 3 == 0 else data
        (tmp_path / "b.mp4").write_bytes(data)
        try:
            with open_source(tmp_path / "b.mp4") as source:
                assert len(list(source)) < 1000
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize(("name", "others", "said"), [
    ("GX010012.MP4", ["GX020012.MP4", "GX030012.MP4", "GX010013.MP4"], 3), ("GOPR0012.MP4", ["GP010012.MP4"], 2),
    ("GX010012.MP4", ["GX010013.MP4", "GL010012.LRV"], 0), ("walk.mp4", ["walk2.mp4"], 0),
])  # fmt: skip
def test_a_chapter_of_a_recording_is_said_to_be_one(tmp_path, caplog, name, others, said):
    write_video(tmp_path / "v.mp4").rename(tmp_path / name)
    for other in others:
        (tmp_path / other).write_bytes(b"")
    open_source(tmp_path / name).close()
    assert (f"is one of {said} chapters" in caplog.text) == (said > 0)


@pytest.mark.parametrize(("rate", "said"), [("240.000000", True), ("120", True), ("30.0", False), ("x", False)])
def test_a_capture_rate_above_the_videos_is_slow_motion(tmp_path, caplog, rate, said):
    path = tmp_path / "slow.mp4"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as output:
        output.metadata["com.android.capture.fps"] = rate
        stream = output.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(8):
            output.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * i, np.uint8), "bgr24")))
        output.mux(stream.encode())
    with open_source(path) as source:
        assert len(list(source)) == 8
    assert f"--rate {float(rate):g} gives the true times" in caplog.text if said else "slow motion" not in caplog.text


@pytest.mark.parametrize("container", ["mp4", "mkv", "mov", "avi", "ts"])
@pytest.mark.parametrize("sizes", [[(64, 48), (128, 96)], [(128, 96), (64, 48)], [(64, 48), (64, 64), (32, 32)]])
def test_one_of_several_tracks_is_named_and_another_chosen(tmp_path, caplog, container, sizes):
    path = tmp_path / f"two.{container}"
    with av.open(str(path), "w") as output:
        streams = []
        for width, height in sizes:
            streams.append(output.add_stream("mpeg4", rate=10))
            streams[-1].width, streams[-1].height, streams[-1].pix_fmt = width, height, "yuv420p"
        for i in range(8):
            for stream in streams:
                image = np.full((stream.height, stream.width, 3), 10 * i + 50, np.uint8)
                output.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        for stream in streams:
            output.mux(stream.encode())
    with open_images(path) as images:
        assert next(iter(images.frames)).image.shape[1::-1] == max(sizes, key=lambda s: s[0] * s[1])
    assert f"several video tracks, 1 ({sizes[0][0]}x{sizes[0][1]} px)" in caplog.text
    for number, size in enumerate(sizes, 1):
        with open_images(path, topic=str(number)) as images:
            assert [f.image.shape[1::-1] for f in images.frames] == [size] * 8
    with (
        pytest.raises(InputError, match=f"expected a video track of .*, 1 to {len(sizes)}"),
        open_images(path, topic="9"),
    ):
        pass
