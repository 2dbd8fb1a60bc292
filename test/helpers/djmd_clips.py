"""Writes DJI-like clips: a real video plus a ``djmd`` track whose messages hold a known flight.

The field numbers are those of the published tables, not taken from the reader.
"""

import random
import struct

import numpy as np

RATE_HZ, TIME_SCALE = 30, 30_000


def varint(value):
    value &= (1 << 64) - 1
    data = bytearray()
    while True:
        data.append((value & 0x7F) | (0x80 if value > 0x7F else 0))
        value >>= 7
        if not value:
            return bytes(data)


def message(fields):
    """Wire format of {number: int | float | bytes | {...}}; zeros are left out, as proto3 does."""
    data = b""
    for number, value in fields.items():
        if isinstance(value, dict):
            value = message(value)
        if isinstance(value, bytes):
            data += varint(number << 3 | 2) + varint(len(value)) + value
        elif isinstance(value, np.floating):  # float32
            data += varint(number << 3 | 5) + struct.pack("<f", value)
        elif isinstance(value, float):
            data += varint(number << 3 | 1) + struct.pack("<d", value)
        elif value:
            data += varint(number << 3) + varint(int(value))
    return data


def flight(count, seed=0):
    """Gimbal and aircraft (N, 3) whole tenths of a degree pitch, roll, yaw; geodetic (N, 3) deg, deg, m."""
    t = np.arange(count) / RATE_HZ
    wave = np.random.default_rng(seed).uniform(0, 6)
    gimbal = np.stack([-200 + 30 * np.sin(t + wave), 3 * np.sin(3 * t), 200 * t - 1700], axis=1)
    aircraft = np.stack([40 * np.sin(2 * t), 60 * np.cos(t), 200 * t - 1690], axis=1)
    geodetic = np.stack([47 + 2e-5 * np.sin(t), 8 + 2e-5 * np.cos(t), 12 + 0.3 * t], axis=1)
    return np.round(gimbal).astype(int), np.round(aircraft).astype(int), geodetic.round(9)


def quaternion(pitch_roll_yaw_deg):
    """w x y z of yaw about down, then pitch, then roll."""
    q = np.array([1.0, 0, 0, 0])
    for angle, axis in zip(np.deg2rad(pitch_roll_yaw_deg)[[2, 0, 1]], (3, 2, 1), strict=True):
        turn = np.zeros(4)
        turn[0], turn[axis] = np.cos(angle / 2), np.sin(angle / 2)
        w, v = q[0] * turn[0] - q[1:] @ turn[1:], q[0] * turn[1:] + turn[0] * q[1:] + np.cross(q[1:], turn[1:])
        q = np.array([w, *v])
    return q


def mini_sample(i, gimbal, aircraft, geodetic, degrees=False, position=1):
    """Mini 4 Pro, Air 3: radians, aircraft 3-3-3 (roll first), gimbal 3-4-3 (pitch first)."""
    lat, lon = geodetic[:2] if degrees else np.deg2rad(geodetic[:2])
    place = {1: 1 if degrees else 0, 2: float(lat), 3: float(lon)}
    return {
        1: {1: i, 2: round(i * 1e6 / RATE_HZ)},
        2: {7: {1: 100}},
        3: {
            3: {1: aircraft[1], 2: aircraft[0], 3: aircraft[2]},
            4: {position: place, 2: round(geodetic[2] * 1000) + 500_000},
            5: {1: round(geodetic[2] * 1000)},
        },
        4: {3: {1: gimbal[0], 2: gimbal[1], 3: gimbal[2]}},
    }


def avata_sample(i, gimbal, aircraft, geodetic):
    """Avata 2, Neo: aircraft 3-4-3 (roll first), position 3-4-4, no gimbal."""
    lat, lon = np.deg2rad(geodetic[:2])
    return {
        1: {1: i, 2: round(i * 1e6 / RATE_HZ)},
        4: {
            3: {1: aircraft[1], 2: aircraft[0], 3: aircraft[2]},
            4: {1: {2: float(lat), 3: float(lon)}, 2: round(geodetic[2] * 1000) + 500_000},
            5: {1: round(geodetic[2] * 1000)},
        },
    }


def mavic4_sample(i, gimbal, aircraft, geodetic):
    """Mavic 4 Pro: degrees whatever the unit, position at another place, quaternion of the exact angles in 3-4-4."""
    fields = mini_sample(i, np.round(gimbal), aircraft, geodetic, degrees=True, position=3)
    fields[3][4][3].pop(1)
    fields[4][4] = dict(enumerate(np.float32(quaternion(np.asarray(gimbal) / 10)), 1))
    return fields


def samples(schema, fields):
    """Messages of a clip; the first also holds the header."""
    head = {
        1: {1: {1: f"{schema}.proto".encode(), 5: b"SERIAL", 10: b"Drone"}},
        2: {3: {1: 320, 2: 180, 3: np.float32(30)}},
    }
    return [message({**(head if i == 0 else {}), 3: one}) for i, one in enumerate(fields)]


def box(name, *content):
    data = b"".join(content)
    return struct.pack(">I4s", 8 + len(data), name) + data


def full(name, *content):
    return box(name, bytes(4), *content)


def u32(*values):
    return struct.pack(f">{len(values)}I", *values)


def djmd_track(sizes, offsets, co64=False):
    """A ``trak`` with one sample a chunk."""
    count, ticks = len(sizes), TIME_SCALE // RATE_HZ
    offset = (
        full(b"co64", u32(count), struct.pack(f">{count}Q", *offsets)) if co64 else full(b"stco", u32(count, *offsets))
    )
    stbl = box(
        b"stbl",
        full(b"stsd", u32(1), box(b"djmd", bytes(6), b"\0\1")),
        full(b"stts", u32(1, count, ticks)),
        full(b"stsc", u32(1, 1, 1, 1)),
        full(b"stsz", u32(0, count, *sizes)),
        offset,
    )
    return box(
        b"trak",
        full(b"tkhd", bytes(80)),
        box(
            b"mdia",
            full(b"mdhd", u32(0, 0, TIME_SCALE, count * ticks, 0)),
            full(b"hdlr", u32(0), b"meta", bytes(12), b"DJI meta\0"),
            box(b"minf", stbl),
        ),
    )


def add_track(video, messages, out, co64=False):
    """The video with the messages in a second ``mdat`` and a new ``moov`` at the end; the old one becomes ``free``."""
    data, place, moov = bytearray(video), 0, None
    while place < len(data):
        size = struct.unpack_from(">I", data, place)[0] or len(data) - place
        if size == 1:
            size = struct.unpack_from(">Q", data, place + 8)[0]
        if data[place + 4 : place + 8] == b"moov":
            moov = bytes(data[place + 8 : place + size])
            data[place + 4 : place + 8] = b"free"
        place += size
    sizes = [len(one) for one in messages]
    offsets = len(data) + 8 + np.cumsum([0, *sizes[:-1]])
    data += box(b"mdat", *messages)
    data += box(b"moov", moov, djmd_track(sizes, [int(o) for o in offsets], co64))
    out.write_bytes(bytes(data))
    return out


def plain_video(path, count):
    """A video of real frames, 320x180, 30 images a second."""
    import cv2

    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (180, 400, 3), dtype=np.uint8), (0, 0), 3)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), RATE_HZ, (320, 180))
    for i in range(count):
        writer.write(noise[:, i % 80 : i % 80 + 320])
    writer.release()
    return path


def whole_clip(path, count=45):
    """A clip of a Mini 4 Pro."""
    angles, aircraft, geodetic = flight(count)
    fields = [mini_sample(i, angles[i], aircraft[i], geodetic[i]) for i in range(count)]
    return add_track(plain_video(path, count).read_bytes(), samples("dvtm_Mini4_Pro", fields), path)


def damaged_boxes(data, rng: random.Random):
    """A copy with one box that lies: a huge or zero size or count, a loop to an earlier place, or an end cut off."""
    data = bytearray(data)
    names = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"stts", b"stsc", b"stsz", b"stco", b"djmd", b"mdhd")
    name = rng.choice(names)
    places = [i for i in range(len(data) - 16) if data[i : i + 4] == name] if name != b"moov" else [data.rfind(name)]
    place = rng.choice([p for p in places if p >= 4] or [4])
    kind = rng.randrange(5)
    if kind == 0:
        struct.pack_into(">I", data, place - 4, rng.choice((0, 1, 7, 8, 16, 2**31, 2**32 - 1)))
    elif kind == 1:
        struct.pack_into(">I", data, place + 8, rng.choice((0, 1, 2**16, 2**31, 2**32 - 1)))
    elif kind == 2:
        struct.pack_into(">I", data, place + 12, rng.choice((0, 2**20, 2**32 - 1, place)))
    elif kind == 3:
        data[place : place + 4] = rng.choice(names)
    else:
        del data[rng.randrange(len(data) // 2, len(data)) :]
    return bytes(data)
