"""Folders and files of pictures as other programs name and mix them."""

import datetime
import itertools

import numpy as np
import pytest
from test_sources import write_video

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.perception.sources import open_source

cv2 = pytest.importorskip("cv2")
T0_NS, STEP_NS = 1_403_636_579_763_555_584, 50_000_000


def picture(value, size=(24, 32)):
    return np.full((*size, 3), value, np.uint8)


def folder_of(path, pictures):
    path.mkdir()
    for name, image in pictures.items():
        cv2.imwrite(str(path / name), image)
    return path


def read(path):
    with open_source(path) as source:
        frames = list(source)
    return np.array([f.stamp_ns for f in frames]), [int(f.image.mean().round(-1)) for f in frames]


FORMS = {
    "ns": lambda t: f"{t}", "us": lambda t: f"{t // 10**3}", "ms": lambda t: f"{t // 10**6}",
    "TUM": lambda t: f"{t // 10**9}.{t % 10**9 // 10**3:06d}", "parts": lambda t: f"{t // 10**9}_{t % 10**9:09d}",
    "prefix": lambda t: f"left_{t}", "camera": lambda t: f"cam0-{t // 10**6}",
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("steps", [[1] * 11, [1, 1, 4, 1, 1, 1, 1, 9, 1, 1, 1]])
def test_times_in_names_are_the_stamps_in_any_unit(tmp_path, form, steps):
    at = T0_NS // 10**6 * 10**6 + STEP_NS * np.cumsum([0, *steps])
    stamps, _ = read(folder_of(tmp_path / "a", {f"{form(t)}.png": picture(90) for t in at.tolist()}))
    assert (np.diff(stamps) == np.diff(at)).all()
    assert abs(int(stamps[0]) - int(at[0])) < 10**6


@pytest.mark.parametrize("name", ["f_{:04d}.png", "{:d}.jpg", "walk {:010d}.png", "IMG{:05d}.JPG"])
@pytest.mark.parametrize("step", [1, 5])
def test_numbers_that_are_missing_are_gaps_in_time(tmp_path, name, step):
    numbers = [step * i for i in (*range(3, 9), *range(20, 26))]
    stamps, _ = read(folder_of(tmp_path / "a", {name.format(i): picture(90) for i in numbers}))
    assert (stamps - stamps[0]) * 30e-9 == pytest.approx([i // step - 3 for i in numbers], abs=1e-6)


@pytest.mark.parametrize(
    "name", ["{:%Y-%m-%d_%H-%M-%S-%f}.jpg", "IMG_{:%Y%m%d_%H%M%S%f}.png", "frame{0.microsecond}.png"]
)
def test_other_numbers_are_no_time(tmp_path, name):
    at = [datetime.datetime(2024, 1, 15, 14, 30) + datetime.timedelta(milliseconds=33 * i) for i in range(40)]
    names = dict.fromkeys(name.format(t) for t in at)
    stamps, _ = read(folder_of(tmp_path / "a", {each: picture(90) for each in names}))
    assert len(stamps) == len(names)
    assert np.ptp(np.diff(stamps)) <= 1


KINDS = {
    "twins": ("f_{:03d}.jpg", "f_{:03d}.png"), "masks": ("f_{:03d}.jpg", "f_{:03d}_mask.png"),
    "depth first": ("rgb_{:03d}.png", "depth_{:03d}.png"), "suffix": ("{:03d}_left.jpg", "{:03d}_right.jpg"),
    "cameras": ("cam0_{:03d}.jpg", "cam1_{:03d}.jpg"), "cam names": ("a/../b{:03d}.png", "c{:03d}.png"),
    "times": (f"{T0_NS // 10**9}_" + "{:09d}.jpg", f"{T0_NS // 10**9}_" + "{:09d}.png"),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("odd", [[], ["cover.jpg", "Thumbs.png"]])
def test_one_of_several_recordings_in_a_folder_is_named(tmp_path, caplog, kind, odd):
    pictures = {kind[0].format(20_000_000 * i).rpartition("/")[2]: picture(200) for i in range(20)}
    others = {kind[1].format(20_000_000 * i): picture(50) for i in range(20)}
    stamps, values = read(folder_of(tmp_path / "a", {**pictures, **others, **{n: picture(9, (8, 8)) for n in odd}}))
    assert len(stamps) == 20
    assert len(set(values)) == 1
    assert values[0] == 200
    assert "several recordings" in caplog.text


def test_names_with_nothing_in_common_are_one_recording(tmp_path, caplog):
    names = ["a.jpg", "b.jpg", "final.png", "IMG_1.jpg", "IMG_2.jpg"]
    assert len(read(folder_of(tmp_path / "a", {name: picture(90) for name in names}))[0]) == 5
    assert not caplog.text


def test_a_file_of_many_pictures_is_no_single_one(tmp_path, capsys):
    pages = [picture(v) for v in (20, 90, 160)]
    cv2.imwritemulti(str(tmp_path / "a.tiff"), pages)
    names = ["a.tiff"]
    if hasattr(cv2, "Animation"):
        animation = cv2.Animation()
        animation.frames, animation.durations = pages, np.full(3, 40)
        names += [name for name in ("a.webp", "a.png") if cv2.imwriteanimation(str(tmp_path / name), animation)]
    for name in names:
        assert main(["track", str(tmp_path / name), "--models", "simulation", "--out", str(tmp_path / "out")]) == 2
        assert "found 3 in one file; convert it" in capsys.readouterr().err


@pytest.mark.parametrize(("names", "said"), [
    (["a.HEIC", "b.HEIC"], "found .HEIC;"), (["a.mp4"], "found .mp4; name one"), (["frames/x"], "frames/"),
    ([], "found none"), (["a.dng", "._a.jpg"], "found .dng"),
])  # fmt: skip
def test_what_a_folder_without_pictures_holds_is_said(tmp_path, names, said):
    (tmp_path / "a").mkdir()
    for name in names:
        (tmp_path / "a" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "a" / name).write_bytes(bytes(300))
    with pytest.raises(InputError, match=said):
        open_source(tmp_path / "a")


def test_a_song_s_cover_is_no_video(tmp_path):
    """An MP4 of sound with a picture of its album, as music programs write it."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mp4"), "w") as file:
        sound, cover = file.add_stream("aac", rate=44100), file.add_stream("png", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 24, "rgb24"
        cover.disposition = av.stream.Disposition.attached_pic
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", layout="mono")
        silence.rate = 44100
        shown = av.VideoFrame.from_ndarray(picture(90), "rgb24")
        packets = itertools.chain(cover.encode(shown), cover.encode(None), sound.encode(silence), sound.encode(None))
        for packet in packets:
            file.mux(packet)
    with pytest.raises(InputError, match="found sound without pictures"):
        open_source(tmp_path / "a.mp4")


@pytest.mark.parametrize("start_s", [-0.1, 0, 4, 7200])
@pytest.mark.parametrize("container", ["mkv", "mov", "mp4"])
def test_a_recording_that_begins_late_is_whole(tmp_path, caplog, start_s, container):
    av = pytest.importorskip("av")
    with av.open(str(write_video(tmp_path / "a.mp4"))) as whole, av.open(str(tmp_path / f"b.{container}"), "w") as late:
        stream = late.add_stream_from_template(whole.streams.video[0])
        for packet in whole.demux(video=0):
            if packet.dts is not None:
                packet.pts += round(start_s / packet.time_base)
                packet.dts += round(start_s / packet.time_base)
                packet.stream = stream
                late.mux(packet)
    with open_source(tmp_path / f"b.{container}") as source:
        stamps = [frame.stamp_ns for frame in source]
        assert not source.events()
    assert stamps[0] == 0
    assert max(np.diff(stamps)) < 10**9
    assert not caplog.text


@pytest.mark.parametrize(("size", "told"), [((48, 64), True), ((64, 48), False), ((48, 36), False), ((64, 36), True)])
def test_images_of_another_shape_on_the_way_are_told(tmp_path, caplog, size, told):
    """As a browser's recording of a phone that is turned, or of a link that gets slower."""
    av = pytest.importorskip("av")
    for name, (width, height) in (("a.ts", (64, 48)), ("b.ts", size)):
        with av.open(str(tmp_path / name), "w", format="mpegts") as file:
            stream = file.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for value in [*range(90, 110), None]:
                frame = None if value is None else av.VideoFrame.from_ndarray(picture(value, (height, width)), "bgr24")
                for packet in stream.encode(frame):
                    file.mux(packet)
    (tmp_path / "c.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    with open_source(tmp_path / "c.ts") as source:
        assert {frame.image.shape for frame in source} == {(48, 64, 3)}
    assert ("shape of the images changes" in caplog.text) == told


@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("name", ["a.mjpeg", "a.jpg"])
def test_pictures_one_after_the_other_are_a_video(tmp_path, count, name):
    """As simple cameras write them; two are a picture and its preview."""
    pictures = [cv2.imencode(".jpg", picture(5 * i))[1].tobytes() for i in range(count)]
    (tmp_path / name).write_bytes(b"".join(pictures))
    stamps, values = read(tmp_path / name)
    assert len(stamps) == (1 if count < 3 else count)
    assert values == sorted(values)


def test_info_tells_what_a_folder_of_pictures_holds(tmp_path, capsys):
    folder_of(tmp_path / "a", {f"f_{i:03d}.png": picture(9) for i in range(31)})
    assert main(["info", str(tmp_path / "a")]) == 0
    out = capsys.readouterr().out
    assert all(words in out for words in ("images: 31", "32x24 px", "duration: 1.000 s"))
