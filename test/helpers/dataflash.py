"""Writes a small ArduPilot DataFlash log: formats first, then messages in the order of time."""

import struct

import numpy as np

HEAD = b"\xa3\x95"
#: name -> type, format characters, struct codes, columns
FORMATS = {
    "FMT": (128, "BBnNZ", "<BB4s16s64s", "Type,Length,Name,Format,Columns"),
    "GPS": (129, "QBIHLLf", "<QBIHiif", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt"),
    "ATT": (130, "Qfff", "<Qfff", "TimeUS,Roll,Pitch,Yaw"),
    "POS": (131, "QLLf", "<Qiif", "TimeUS,Lat,Lng,Alt"),
    "MNT": (132, "Qffff", "<Qffff", "TimeUS,Roll,Pitch,YawB,YawE"),
    "PARM": (133, "QNf", "<Q16sf", "TimeUS,Name,Value"),
}
GPS_EPOCH_S = 315_964_800
LEAP_S = 18
START_UTC_S = 1_700_000_000


def packed(name, *values):
    number, _, codes, _ = FORMATS[name]
    return HEAD + bytes([number]) + struct.pack(codes, *values)


def write_dataflash_text(path, t, angles, geodetic, mounts, settings=()):
    """The same as text: degrees with their decimals, several mounts, and GPS in the place of POS."""
    columns = {"GPS": "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", "ATT": "TimeUS,Roll,Pitch,Yaw",
               "MNT": "TimeUS,I,Roll,Pitch,YawB,YawE", "PARM": "TimeUS,Name,Value"}  # fmt: skip
    forms = {"GPS": "QBIHLLf", "ATT": "Qfff", "MNT": "QBffff", "PARM": "QNf"}
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    lines += [f"FMT, {150 + i}, 50, {name}, {forms[name]}, {of}" for i, (name, of) in enumerate(columns.items())]
    lines += [f"PARM, 1, {name}, {value}" for name, value in settings]
    for i, s in enumerate(t):
        us, place = round((10 + s) * 1e6), geodetic[i]
        week, rest = divmod(START_UTC_S + s - GPS_EPOCH_S + LEAP_S, 604_800)
        lines.append(f"GPS, {us}, 3, {round(rest * 1000)}, {int(week)}, {place[0]:.7f}, {place[1]:.7f}, {place[2]:.3f}")
        lines.append("ATT, {}, {:.5f}, {:.5f}, {:.5f}".format(us, *np.rad2deg(angles[i])))
        nose = np.rad2deg(angles[i, 2])
        for number, (mount, step) in enumerate(mounts):
            if i % step == 0:
                roll, pitch, yaw = np.rad2deg(mount[i])
                lines.append(f"MNT, {us}, {number}, {roll:.5f}, {pitch:.5f}, {yaw - nose:.5f}, {yaw:.5f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def write_dataflash(path, t, angles, geodetic=None, mount=None, mount_type=None):
    """Power-up 10 s before the first of times t (N,) s; angles roll pitch yaw rad; latitude, longitude, altitude."""
    out = []
    for name, (number, form, codes, columns) in FORMATS.items():
        length = 3 + struct.calcsize(codes)
        out.append(packed("FMT", number, length, name.encode(), form.encode(), columns.encode()))
    if mount_type is not None:
        out.append(packed("PARM", 1, b"MNT1_TYPE", mount_type))
    for i, s in enumerate(t):
        us = round((10 + s) * 1e6)
        if geodetic is not None:
            lat, lon = (round(v * 1e7) for v in geodetic[i, :2])
            gps_s = START_UTC_S + s - GPS_EPOCH_S + LEAP_S
            week, rest = divmod(gps_s, 604_800)
            if i % 4 == 0:
                out.append(packed("GPS", us, 3, round(rest * 1000), int(week), lat, lon, geodetic[i, 2]))
            out.append(packed("POS", us, lat, lon, geodetic[i, 2]))
        out.append(packed("ATT", us, *np.rad2deg(angles[i])))
        if mount is not None:
            roll, pitch, yaw = np.rad2deg(mount[i])
            nose = np.rad2deg(angles[i, 2])
            yaw_b, yaw_e = (yaw, yaw + nose) if mount_type == 1 else (yaw - nose, yaw)
            out.append(packed("MNT", us, roll, pitch, yaw_b, yaw_e))
    path.write_bytes(b"".join(out))
    return path
