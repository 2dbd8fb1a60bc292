"""Logs of positions alone: GPX, GoPro's track, subtitles with RTK, without a height, or in either order of numbers."""

import datetime
import math
import struct

import numpy as np
import pytest
from djmd_clips import plain_video
from telemetry_logs import srt_text, with_track

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import Lack, LogLack
from drocap_ros.recording.telemetry.read import read_telemetry

METRES = 111_320.0
START = datetime.datetime(2024, 5, 1, 10, tzinfo=datetime.timezone.utc)
#: An orbit of 20 m: latitude, longitude, height.
ANGLE = np.linspace(0, 2 * np.pi, 60)
LATITUDE, LONGITUDE = 46.5, 7.25
PLACE = np.stack(
    [LATITUDE + 20 * np.cos(ANGLE) / METRES, LONGITUDE + 20 * np.sin(ANGLE) / METRES / math.cos(math.radians(LATITUDE)),
     400 + ANGLE], axis=1,
)  # fmt: skip


def is_the_orbit(track, height_m=2 * np.pi):
    span = np.ptp(track.position[np.isfinite(track.position).all(axis=1)], axis=0)
    return span == pytest.approx([40, 40, height_m], rel=0.02, abs=0.02)


def gpx(tracks, time="%Y-%m-%dT%H:%M:%S.%fZ", namespace=True, height=True):
    def point(i, place):
        at = (START + datetime.timedelta(seconds=0.1 * i)).strftime(time)
        ele = f"<ele>{place[2]:.3f}</ele>" if height else ""
        return f'<trkpt lat="{place[0]:.8f}" lon="{place[1]:.8f}">{ele}<time>{at}</time></trkpt>'

    of = ' xmlns="http://www.topografix.com/GPX/1/1"' if namespace else ""
    parts = ("".join(point(i, p) for i, p in enumerate(places)) for places in tracks)
    body = "".join(f"<trk><name>a</name><trkseg>{part}</trkseg></trk>" for part in parts)
    return f'<?xml version="1.0"?>\n<gpx version="1.1"{of}>{body}</gpx>'


@pytest.mark.parametrize("time", ["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%dT%H:%M:%S.%f+00:00", "%Y-%m-%dT%H:%M:%S.%f"])
@pytest.mark.parametrize("namespace", [True, False])
def test_gpx_gives_positions_by_utc(tmp_path, time, namespace):
    (tmp_path / "x.gpx").write_text(gpx([PLACE], time, namespace))
    log = read_telemetry(tmp_path / "x.gpx")
    assert is_the_orbit(log.track)
    assert log.track.stamp_ns[0] == START.timestamp() * 1e9
    assert log.utc_minus_stamp_ns == 0
    assert LogLack(Lack.CAMERA_ATTITUDE) in log.lacks


def test_the_longest_track_of_a_gpx_is_taken_and_damage_ends_it(tmp_path):
    text = gpx([PLACE[:5], PLACE, PLACE[:20]])
    (tmp_path / "x.gpx").write_text(text)
    log = read_telemetry(tmp_path / "x.gpx")
    assert is_the_orbit(log.track)
    assert "2 is used" in next(lack.detail for lack in log.lacks if lack.kind is Lack.SEVERAL)
    assert len(read_telemetry(tmp_path / "x.gpx#3").track.stamp_ns) == 20
    (tmp_path / "x.gpx").write_text(text[: len(text) // 2])
    assert any(lack.kind is Lack.DAMAGED for lack in read_telemetry(tmp_path / "x.gpx").lacks)
    (tmp_path / "h.gpx").write_text(gpx([PLACE], height=False))
    log = read_telemetry(tmp_path / "h.gpx")
    assert is_the_orbit(log.track, 0.0)
    assert LogLack(Lack.HEIGHT_UNKNOWN) in log.lacks
    for content in ("<gpx></gpx>", "<gpx>", "", "<!ENTITY a>", gpx([PLACE]).replace("time>", "when>")):
        (tmp_path / "n.gpx").write_text(content)
        with pytest.raises(InputError, match=r"n\.gpx: expected"):
            read_telemetry(tmp_path / "n.gpx")


def klv(name, kind, size, count, content=b""):
    return struct.pack(">4s1sBH", name, kind, size, count) + content + bytes(-len(content) % 4)


def group(name, *parts):
    content = b"".join(parts)
    return klv(name, b"\0", 1, len(content), content)


def sample(places, second, newer, fix=3):
    """One second of GPMF: an accelerometer, then a stream of fixes."""
    scale = [10**7, 10**7, 1000, 1000, 100]
    rows = [[round(v * s) for v, s in zip((*place, 1.5, 1.5), scale, strict=True)] for place in places]
    motion = group(b"STRM", klv(b"SCAL", b"s", 2, 1, struct.pack(">h", 418)), klv(b"ACCL", b"s", 6, 200, bytes(1200)))
    if newer:
        scale += [1, 1000, 100, 1]
        days = (START - datetime.datetime(2000, 1, 1, tzinfo=datetime.timezone.utc)).days
        rows = [[*row, days, 1000 * (36_000 + second), 150, fix] for row in rows]
        fixes = (klv(b"TYPE", b"c", 1, 9, b"lllllllSS"), klv(b"SCAL", b"l", 4, 9, struct.pack(">9l", *scale)),
                 klv(b"GPS9", b"?", 32, len(rows), b"".join(struct.pack(">7l2H", *row) for row in rows)))  # fmt: skip
    else:
        time = (START + datetime.timedelta(seconds=second)).strftime("%y%m%d%H%M%S.000").encode()
        fixes = (klv(b"GPSF", b"L", 4, 1, struct.pack(">L", fix)), klv(b"GPSU", b"U", 16, 1, time),
                 klv(b"SCAL", b"l", 4, 5, struct.pack(">5l", *scale)),
                 klv(b"GPS5", b"l", 20, len(rows), b"".join(struct.pack(">5l", *row) for row in rows)))  # fmt: skip
    return group(b"DEVC", klv(b"DVNM", b"c", 1, 6, b"Hero11"), motion, group(b"STRM", *fixes))


@pytest.mark.parametrize("newer", [False, True])
@pytest.mark.parametrize("count", [5, 18])
def test_gopro_videos_hold_positions(tmp_path, newer, count, capsys):
    of_each = [PLACE[np.linspace(10 * i, 10 * i + 9, count).astype(int)] for i in range(6)]
    samples = [sample(places, i, newer) for i, places in enumerate(of_each)]
    video = plain_video(tmp_path / "v.mp4", 10)
    (tmp_path / "GX01.mp4").write_bytes(with_track(video, samples, b"gpmd", b"meta", 1000))
    log = read_telemetry(tmp_path / "GX01.mp4")
    assert log.kind == "GoPro GPMF track"
    assert is_the_orbit(log.track)
    assert np.diff(log.track.stamp_ns) == pytest.approx(1e9 / count, rel=1e-3)
    assert log.utc_minus_stamp_ns == pytest.approx(START.timestamp() * 1e9, abs=1e6)
    assert main(["info", str(tmp_path / "GX01.mp4")]) == 0
    assert "source: GoPro GPMF track" in capsys.readouterr().out
    lost = [sample(places, i, newer, fix=0) for i, places in enumerate(of_each)]
    for broken in (lost, [s[: len(s) // 2] for s in samples], [b"\xff" * 50] * 6):
        (tmp_path / "b.mp4").write_bytes(with_track(video, broken, b"gpmd", b"meta", 1000))
        with pytest.raises(InputError, match=r"b\.mp4: "):
            read_telemetry(tmp_path / "b.mp4")


@pytest.mark.parametrize("form", [
    "RTK ({1:.6f}, {0:.6f}, 28), HOME (7.25, 46.5, 103.55m), D {d:.2f}m, H {h:.2f}m",
    "GPS ({1:.6f}, {0:.6f}, 28), HOME (7.25, 46.5, 103.55m), D {d:.2f}m, H {h:.2f}m",
    "GPS ({0:.6f}, {1:.6f}, 28), HOME (46.5, 7.25, 103.55m), D {d:.2f}m, H {h:.2f}m",
    "GPS({0:.6f},{1:.6f},0.0M) BAROMETER:{h:.2f}M",
    "GPS({1:.6f},{0:.6f},16) Hb:{h:.2f} Hs:{h:.2f}",
    "GPS(N:{0:.6f}, E:{1:.6f}, {h:.2f}m)",
    "[latitude : {0:.6f}] [longtitude : {1:.6f}] [altitude: {h:.2f}]",
    "GPS({0:.6f},{1:.6f},{h:.3f}) BAROMETER({h:.1f})",
    "GPS({0:.6f},{1:.6f},{h:.3f}) BAROMETER:{h:.1f}",
    "GPS({1:.6f},{0:.6f},{h:.1f}) BAROMETER({h:.1f})\nHOME(7.25,46.5) D={d:.1f}m H={h:.1f}m",
    "GPS({0:.6f},{1:.6f},{h:.1f})\nHOME(46.5,7.25) D={d:.1f}m H={h:.1f}m",
])  # fmt: skip
def test_every_form_of_a_place_is_one_orbit(tmp_path, form):
    lines = [form.format(*place, d=20.0, h=place[2] - 400) for place in PLACE]
    (tmp_path / "x.srt").write_text(srt_text(np.arange(60.0), lines))
    assert is_the_orbit(read_telemetry(tmp_path / "x.srt").track)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("point", [".", ","])
def test_subtitles_are_read_in_every_spelling(tmp_path, encoding, newline, point):
    values = [[f"{v:.6f}".replace(".", point) for v in (*place[:2], place[2] - 400)] for place in PLACE]
    lines = [
        "2024-01-15 14:30:22,123\n[latitude: {}] [longitude: {}] [rel_alt: {} abs_alt: 1]".format(*v) for v in values
    ]
    text = ("\ufeff" if encoding.endswith("le") else "") + srt_text(np.arange(60.0), lines).replace("\n", newline)
    (tmp_path / "x.srt").write_bytes(text.encode(encoding))
    assert is_the_orbit(read_telemetry(tmp_path / "x.srt").track)


@pytest.mark.parametrize("latitude_first", [False, True])
def test_a_latitude_is_below_ninety(tmp_path, latitude_first):
    places = [(p[0], p[1] + 113) for p in PLACE]
    lines = ["GPS({:.6f},{:.6f},9)".format(*(p if latitude_first else p[::-1])) for p in places]
    (tmp_path / "x.srt").write_text(srt_text(np.arange(60.0), lines))
    assert is_the_orbit(read_telemetry(tmp_path / "x.srt").track, 0.0)


def test_a_mavic_2_has_places_without_heights(tmp_path):
    lines = [f"[focal_len : 280] [latitude : {p[0]:.6f}] [longtitude : {p[1]:.6f}]" for p in PLACE]
    (tmp_path / "x.srt").write_text(srt_text(np.arange(60.0), lines))
    log = read_telemetry(tmp_path / "x.srt")
    assert is_the_orbit(log.track, 0.0)
    assert LogLack(Lack.HEIGHT_UNKNOWN) in log.lacks
    assert log.lens.focal_35mm_mm == 28
    (tmp_path / "air.srt").write_text(srt_text(np.arange(60.0), ["[iso : 100] [fnum : 280]"] * 60))
    with pytest.raises(InputError, match="as the Mavic Air, write none"):
        read_telemetry(tmp_path / "air.srt")


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("damage", ["<trkpt lat=", "\x00\x01&", "</gpx>", "]]>"])
def test_points_behind_damage_of_a_gpx_are_read(tmp_path, share, damage):
    text = gpx([PLACE[:10], PLACE])
    at = text.index("<trkpt", int(share * len(text)))
    (tmp_path / "x.gpx").write_text(text[:at] + damage + text[at + 60 :])
    log = read_telemetry(tmp_path / "x.gpx#2")
    assert 56 <= len(log.track.stamp_ns) <= 60
    assert is_the_orbit(log.track)
    assert any(lack.kind is Lack.DAMAGED for lack in log.lacks)
