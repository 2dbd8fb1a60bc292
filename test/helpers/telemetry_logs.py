"""Builds telemetry logs of which the truth is known, and damages them."""

import math
import struct

import numpy as np
from scipy.interpolate import CubicSpline

from drocap_ros.flight.vehicle import orientation_to_aviation
from drocap_ros.recording.telemetry.log import TelemetryLog, VehicleTrack


def angles_of(orientation):
    """(N, 3) roll, pitch, yaw rad, FRD against NED, of rotations FLU -> ENU."""
    x, y, z, w = orientation_to_aviation(orientation).T
    return np.stack(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ],
        axis=1,
    )


def wrapped(angle):
    return np.abs(np.angle(np.exp(1j * angle)))


def srt_text(t, lines):
    def stamp(s):
        ms = round(s * 1000)
        return f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"

    return "\n".join(
        f"{i + 1}\n{stamp(s)} --> {stamp(s + 0.033)}\n{line}\n"
        for i, (s, line) in enumerate(zip(t, lines, strict=True))
    )


def dji_subtitle(i, geodetic, mount):
    g, (roll, pitch, yaw) = geodetic, np.rad2deg(mount)
    return (
        f'<font size="28">FrameCnt: {i + 1}, DiffTime: 33ms\n2023-05-01 10:00:{i % 60:02d}.123\n[iso: 100]'
        f" [shutter: 1/1000.0] [focal_len: 24.00] [latitude: {g[0]:.7f}] [longitude: {g[1]:.7f}]"
        f" [rel_alt: {g[2] - 500:.3f} abs_alt: {g[2]:.3f}]"
        f" [gb_yaw: {yaw:.3f} gb_pitch: {pitch:.3f} gb_roll: {roll:.3f}] </font>"
    )


def mutated(data, rng):
    data = bytearray(data)
    for _ in range(rng.randrange(1, 8)):
        kind, place = rng.randrange(4), rng.randrange(len(data))
        if kind == 0:
            data[place] = rng.randrange(256)
        elif kind == 1:
            del data[place : place + rng.randrange(1, 300)]
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randrange(1, 300))
        else:
            data[place : place + 8] = struct.pack("<Q", 2 ** rng.randrange(64) - 1)
    return bytes(data)


def heading_at(t, even=False):
    """Heading rad, left positive, of an orbit flown unevenly by hand, or evenly."""
    knots = np.random.default_rng(3).normal(0, 0.12, 200)
    return 0.4 * t + (0 if even else CubicSpline(np.arange(200), knots)(t))


def turning_log(seconds, even=False):
    t = np.arange(0, seconds, 0.05)
    heading = heading_at(t, even)
    half = 0.5 * heading
    orientation = np.stack([0 * t, 0 * t, np.sin(half), np.cos(half)], axis=1)
    stamp_ns = 5 * 10**9 + np.round(t * 1e9).astype(np.int64)
    nan = np.full((len(t), 4), np.nan)
    utc = 1_700_000_000 * 10**9 - 5 * 10**9
    return TelemetryLog("test", VehicleTrack(stamp_ns, np.zeros((len(t), 3)), orientation, nan), utc)


def turning_video(path, start_s, seconds, even=False):
    """Video of a camera, 60 degrees wide, 30 images a second, that turns before a textured wall."""
    import cv2

    width, height, wide = 320, 180, 4000
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (height, wide, 3), dtype=np.uint8), (0, 0), 2)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    px_per_rad = width / math.radians(60)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (width, height))
    for i in range(round(seconds * 30)):
        heading = heading_at(start_s + i / 30, even)
        shift = round(-heading * px_per_rad) % wide
        writer.write(np.take(wall, np.arange(shift, shift + width) % wide, axis=1))
    writer.release()
    return path


def with_track(video, samples, code=b"tx3g", handler=b"sbtl", step_ms=100):
    """The video with a track of samples after its own tracks: 3GPP's timed text, unless it has another code."""

    def box(name, *parts):
        data = b"".join(parts)
        return struct.pack(">I4s", 8 + len(data), name) + data

    data, count = video.read_bytes(), len(samples)
    table = box(
        b"stbl",
        box(b"stsd", struct.pack(">II", 0, 1), box(code, bytes(30))),
        box(b"stts", struct.pack(">IIII", 0, 1, count, step_ms)),
        box(b"stsc", struct.pack(">IIIII", 0, 1, 1, count, 1)),
        box(b"stsz", struct.pack(">III", 0, 0, count), *(struct.pack(">I", len(s)) for s in samples)),
        box(b"stco", struct.pack(">III", 0, 1, data.index(b"moov") - 4 + 8)),
    )
    media = box(b"mdia", box(b"mdhd", struct.pack(">IIIIIHH", 0, 0, 0, 1000, count * step_ms, 0, 0)),
                box(b"hdlr", struct.pack(">II4s", 0, 0, handler), bytes(13)), box(b"minf", table))  # fmt: skip
    at = data.index(b"moov") - 4
    length = struct.unpack_from(">I", data, at)[0]
    assert at + length == len(data)
    track = box(b"trak", media)
    # The samples stand before the index, as the track's table of places says: after all that was there before it.
    return data[:at] + box(b"mdat", *samples) + struct.pack(">I", length + len(track)) + data[at + 4 :] + track


def write_ulog(path, topics):
    """PX4's log of topics: rows of (name, instance, format, struct codes, rows with their times us first)."""

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 0)]
    out += [message("F", f"{name}:{form}".encode()) for name, form in {t[0]: t[2] for t in topics}.items()]
    for number, (name, instance, *_) in enumerate(topics):
        out.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
    data = [(row[0], number, struct.pack(codes, *row))
            for number, (_, _, _, codes, rows) in enumerate(topics) for row in rows]  # fmt: skip
    out += [message("D", struct.pack("<H", number) + row) for _, number, row in sorted(data)]
    path.write_bytes(b"".join(out))
    return path
