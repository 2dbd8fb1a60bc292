import numpy as np
import pytest
from recorded import NAMES, START_NS, image_message, random_image, record

from drocap_ros.errors import InputError
from drocap_ros.recording.image_messages import image_from_message, read_images
from drocap_ros.recording.open_session import open_session


@pytest.mark.parametrize(
    ("encoding", "pad"), [("bgr8", 0), ("rgb8", 0), ("rgb8", 5), ("bgra8", 3), ("rgba8", 0), ("mono8", 0), ("mono8", 1)]
)
def test_raw_images_equal_the_recorded_ones(tmp_path, messages, encoding, pad):
    import cv2

    images = [random_image(i) for i in range(3)]
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
def test_bayer_images_have_their_colours(messages, encoding, red):
    mosaic = np.zeros((32, 32), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200  # only the red pixels have light
    message = messages(NAMES["image"], height=32, width=32, encoding=encoding, step=32, data=mosaic.ravel())
    blue, green, red_level = image_from_message(message, compressed=False)[8:-8, 8:-8].reshape(-1, 3).mean(axis=0)
    assert red_level > 150
    assert max(blue, green) < 5


def test_yuv_images_are_grey_without_chroma(messages):
    for encoding, order in (("yuv422", (1, 0)), ("yuv422_yuy2", (0, 1))):  # UYVY, YUYV
        pair = np.zeros((4, 8, 2), np.uint8)
        pair[..., order[0]], pair[..., order[1]] = 120, 128
        message = messages(NAMES["image"], height=4, width=8, encoding=encoding, step=16, data=pair.ravel())
        image = image_from_message(message, compressed=False)
        assert np.ptp(image) <= 1  # grey
        assert abs(int(image.mean()) - 121) < 5


def test_image_of_a_stray_stamp_costs_no_other(tmp_path, messages):
    entries = []
    for i in range(4):
        stamp = START_NS + i + 10**17 * (i == 1)
        message = image_message(messages, random_image(i), stamp, "bgr8", 0)
        entries.append(("/camera", message, START_NS + i, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        assert [f.stamp_ns - START_NS for f in read_images(session)] == [0, 2, 3]
        assert "1 images" in session.warnings[0]


def test_damaged_compressed_images_are_left_out_with_a_warning(tmp_path, messages):
    import cv2

    images = [random_image(i) for i in range(4)]
    entries = []
    for i, image in enumerate(images):
        data = cv2.imencode(".png", image)[1].ravel()
        data = data[:40] if i == 2 else data
        message = messages(NAMES["compressed"], header=messages.header(START_NS + i), format="png", data=data)
        entries.append(("/camera/compressed", message, START_NS + i, messages.cdr(message)))
    record(tmp_path / "s", entries)
    with open_session(tmp_path / "s") as session:
        frames = list(read_images(session))
        assert any("1 images" in warning for warning in session.warnings)
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
def test_images_with_wrong_sizes_are_refused(tmp_path, messages, change):
    message = image_message(messages, random_image(0), START_NS)
    for name, value in change.items():
        setattr(message, name, value)
    record(tmp_path / "s", [("/camera", message, START_NS, messages.cdr(message))])
    with open_session(tmp_path / "s") as session, pytest.raises(InputError, match="image: expected"):
        list(read_images(session))
