from __future__ import annotations

import gc
import struct
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.perception.calibration import load_calibration
from drocap_ros.perception.sources import Frame, SourceEventKind, open_source
from drocap_ros.perception.sources.base import ImageIngestConfig, prefetch
from drocap_ros.perception.sources.image_files import read_image

cv2 = pytest.importorskip("cv2")


def write_video(path: Path, frames: int = 12, size: tuple[int, int] = (64, 48), rate: float = 10.0) -> Path:
    """Frame i is grey 20 * i (modulo 240), with a white block in the upper left corner."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
    for i in range(frames):
        image = np.full((size[1], size[0], 3), 20 * i % 240, np.uint8)
        image[:16, :16] = 255
        writer.write(image)
    writer.release()
    return path


def patch_box(path: Path, name: bytes, edit) -> None:
    """Edit the content of the first box of a name in an MP4 file, its size kept."""
    data = bytearray(path.read_bytes())
    at = data.index(name)
    size = struct.unpack(">I", data[at - 4 : at])[0]
    content = edit(bytes(data[at + 4 : at - 4 + size]))
    assert len(content) == size - 8
    data[at + 4 : at - 4 + size] = content
    path.write_bytes(data)


def test_stamps_are_the_presentation_times(tmp_path):
    with open_source(write_video(tmp_path / "a.mp4")) as source:
        frames = list(source)
    assert source.size == (64, 48)
    np.testing.assert_allclose([f.stamp_ns for f in frames], 1e8 * np.arange(12), atol=1000)
    assert frames[3].image.dtype == np.uint8
    assert frames[3].image.shape == (48, 64, 3)


def test_nominal_rate_does_not_replace_the_times(tmp_path):
    """Half the media's time scale doubles the times and leaves the nominal rate."""
    path = write_video(tmp_path / "a.mp4")

    def slower(content: bytes) -> bytes:
        scale = struct.unpack(">I", content[12:16])[0]
        return content[:12] + struct.pack(">I", scale // 2) + content[16:]

    patch_box(path, b"mdhd", slower)
    with open_source(path) as source:
        stamps = [f.stamp_ns for f in source]
    np.testing.assert_allclose(np.diff(stamps), 2e8, atol=1e4)


def test_frames_do_not_wait_for_the_garbage_collector(tmp_path):
    """Megabytes each, and too few objects for it to begin."""
    av = pytest.importorskip("av")
    video = tmp_path / "long.mp4"
    write_video(video, 60)
    gc.collect()
    gc.disable()
    try:
        with open_source(video) as source:
            assert sum(1 for _ in source) == 60
            left = sum(isinstance(thing, av.VideoFrame) for thing in gc.get_objects())
    finally:
        gc.enable()
    assert left < 10


def test_rotation_metadata_is_applied(tmp_path):
    path = write_video(tmp_path / "a.mp4")

    def quarter_turn(content: bytes) -> bytes:
        # tkhd version 0: the matrix stands 40 bytes in; 0 1 -1 0 turns by 90 degrees clockwise.
        matrix = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
        return content[:40] + matrix + content[76:]

    patch_box(path, b"tkhd", quarter_turn)
    with open_source(path) as source:
        first = next(iter(source))
    assert source.size == (48, 64)
    assert first.image.shape == (64, 48, 3)
    assert first.image[4, -4].mean() > 200  # the block has gone from the upper left to the upper right
    assert first.image[4, 4].mean() < 60


def test_cut_off_file_gives_its_frames_and_an_event(tmp_path, caplog):
    path = write_video(tmp_path / "a.mp4", frames=60)
    data = bytearray(path.read_bytes())
    # FFmpeg's writer puts the index last; a recorder that puts it first and is cut off leaves this:
    at = data.index(b"moov") - 4
    moov = data[at:]
    body = data[:at]
    offset = len(moov)
    place = moov.index(b"stco") + 4
    count = struct.unpack(">I", moov[place + 4 : place + 8])[0]
    head = body.index(b"mdat") - 4
    for i in range(count):
        spot = place + 8 + 4 * i
        moov[spot : spot + 4] = struct.pack(">I", struct.unpack(">I", moov[spot : spot + 4])[0] + offset)
    path.write_bytes(bytes(body[:head] + moov + body[head : head + (len(body) - head) // 2]))
    with open_source(path) as source:
        frames = list(source)
        events = source.events()
    assert 10 < len(frames) < 58
    assert [e.kind for e in events] == [SourceEventKind.ENDED_EARLY]
    assert f"{len(frames)} of 60" in caplog.text


def test_matroska_file_with_a_wrong_rate_is_whole(tmp_path):
    """Its header states a duration, and a rate from which the number of frames is guessed."""
    path = tmp_path / "a.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(60):
        writer.write(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(b"\x23\xe3\x83\x84") + 4  # DefaultDuration, four bytes
    data[at : at + 4] = struct.pack(">I", 25_000_000)
    for share, kinds in ((1.0, []), (0.8, [SourceEventKind.ENDED_EARLY])):
        path.write_bytes(data[: int(share * len(data))])
        with open_source(path) as source:
            count = len(list(source))
            assert [e.kind for e in source.events()] == kinds
        assert source.length == 240
        assert count == 60 if share == 1.0 else 40 < count < 50


@pytest.mark.parametrize("content", [b"", b"this is no video\n" * 20, None], ids=["empty", "text", "without index"])
def test_invalid_video_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "bad.mp4"
    if content is None:
        whole = write_video(tmp_path / "a.mp4", frames=60).read_bytes()
        content = whole[: len(whole) // 2]
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.mp4: expected a video") as caught:
        open_source(path)
    assert "\n" not in str(caught.value)


def test_missing_source_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        open_source(tmp_path / "nothing.mp4")
    with pytest.raises(InputError, match="/dev/video97"):
        open_source("/dev/video97")


def test_images_come_in_the_order_of_their_numbers(tmp_path):
    for i in (10, 9, 1):
        cv2.imwrite(str(tmp_path / f"frame_{i}.png"), np.full((10, 12, 3), i, np.uint8))
    (tmp_path / "notes.txt").write_text("not an image")
    with open_source(tmp_path, ImageIngestConfig(folder_rate_hz=4.0)) as source:
        frames = list(source)
    assert [int(f.image[0, 0, 0]) for f in frames] == [1, 9, 10]
    assert [f.stamp_ns for f in frames] == [0, 250_000_000, 500_000_000]


def test_file_names_that_are_times_are_the_stamps(tmp_path):
    names = ["1700000000000000000", "1700000000040000000"]
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4, 3), np.uint8))
    with open_source(tmp_path) as source:
        assert [f.stamp_ns for f in source] == [int(n) for n in names]


def test_images_of_different_sizes_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 4, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((5, 4, 3), np.uint8))
    with open_source(tmp_path) as source, pytest.raises(InputError, match="expected 4x4 px"):
        list(source)


@pytest.mark.parametrize(
    "pixels",
    [
        np.full((6, 8), 77, np.uint8),
        np.dstack([np.full((6, 8, 3), 77, np.uint8), np.zeros((6, 8, 1), np.uint8)]),
        np.full((6, 8, 3), 77 * 257, np.uint16),
        np.full((1, 1, 3), 77, np.uint8),
    ],
    ids=["grey", "alpha", "16 bit", "1x1"],
)
def test_each_pixel_format_becomes_bgr(tmp_path, pixels):
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    image = read_image(tmp_path / "a.png")
    assert image.shape == (*pixels.shape[:2], 3)
    assert image.dtype == np.uint8
    assert (image == 77).all()


def test_damaged_image_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\nand then nothing")
    with pytest.raises(InputError, match="expected an image"):
        open_source(tmp_path / "a.png")


def test_prefetch_keeps_order_and_raises_errors():
    def frames():
        for i in range(20):
            yield Frame(i, np.full((2, 2, 3), i, np.uint8))
        raise InputError("the twenty-first is bad")

    seen = []

    def read() -> None:
        seen.extend(frame.stamp_ns for frame in prefetch(frames()))

    with pytest.raises(InputError, match="twenty-first"):
        read()
    assert seen == list(range(20))


def test_prefetch_stops_when_the_reader_leaves():
    made = []

    def frames():
        for i in range(10_000):
            made.append(i)
            yield Frame(i, np.zeros((2, 2, 3), np.uint8))

    for frame in prefetch(frames(), ahead=3):
        if frame.stamp_ns == 5:
            break
    assert len(made) < 20


@pytest.mark.parametrize(
    ("focal", "words"),
    [("900.0", ""), ("0.7", "expected focal lengths in px, between 128 and 128000"), (".nan", "finite values")],
)
def test_calibration_in_another_unit_is_refused(tmp_path: Path, focal: str, words: str) -> None:
    path = tmp_path / "camera.yaml"
    matrix = f"[{focal}, 0.0, 640.0, 0.0, {focal}, 360.0, 0.0, 0.0, 1.0]"
    path.write_text(f"image_width: 1280\nimage_height: 720\ncamera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n")
    if not words:
        assert load_calibration(path).matrix[0, 0] == float(focal)
        return
    with pytest.raises(InputError, match=words) as refused:
        load_calibration(path)
    assert str(path) in str(refused.value)


def test_an_unknown_distortion_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    matrix = "[900.0, 0.0, 640.0, 0.0, 900.0, 360.0, 0.0, 0.0, 1.0]"
    text = f"image_width: 1280\nimage_height: 720\ncamera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n"
    path.write_text(f"{text}distortion_model: foo\n")
    with pytest.raises(InputError, match=r"distortion_model: expected one of plumb_bob, .* found 'foo'"):
        load_calibration(path)


@pytest.mark.parametrize("damaged", [(0,), (3,), (2, 3, 5), (0, 1, 5), (5,)])
@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff and then nothing", bytes(124)])
def test_damaged_and_hidden_files_of_a_folder_are_gaps(tmp_path, damaged, content, caplog):
    for i in range(6):
        cv2.imwrite(str(tmp_path / f"walk_{i}.png"), np.full((10, 12, 3), i, np.uint8))
        (tmp_path / f"._walk_{i}.png").write_bytes(bytes(124))  # as a Mac writes on other systems' disks
    for i in damaged:
        (tmp_path / f"walk_{i}.png").write_bytes(content)
    with open_source(tmp_path, ImageIngestConfig(folder_rate_hz=10.0)) as source:
        frames = list(source)
    kept = [i for i in range(6) if i not in damaged]
    assert [int(f.image[0, 0, 0]) for f in frames] == kept
    assert [f.stamp_ns for f in frames] == [i * 100_000_000 for i in kept]
    assert f"do not decode: {len(damaged)}, as walk_{damaged[0]}.png" in caplog.text
