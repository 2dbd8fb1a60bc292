"""Flight logs as Airdata exports them."""

import numpy as np

COLUMNS = (
    "time(millisecond)", "datetime(utc)", "latitude", "longitude", "height_above_takeoff({})", "speed(mph)",
    "compass_heading(degrees)", " pitch(degrees)", " roll(degrees)", "isPhoto", "isVideo", "gimbal_heading(degrees)",
    "gimbal_pitch(degrees)", "gimbal_roll(degrees)", "message",
)  # fmt: skip


def airdata_flight(seconds=40.0):
    """Times (N,) s, gimbal and aircraft (N, 3) rad roll, pitch, yaw, geodetic (N, 3)."""
    t = np.arange(0, seconds, 0.1).round(1)
    gimbal = np.stack([0 * t, -0.4 + 0.05 * np.sin(t), (0.1 * t + 1) % (2 * np.pi)], axis=1)  # roll, pitch, yaw
    body = np.stack([0.05 * np.cos(t), 0.03 * np.sin(t), (0.1 * t + 1.02) % (2 * np.pi)], axis=1)
    return t, gimbal, body, np.stack([47 + 1e-5 * np.sin(t), 8 + 1e-5 * np.cos(t), 10 + 0.1 * t], axis=1)


def write_airdata(path, video, unit="feet", flown=None, columns=COLUMNS):
    """Writes a flight with the camera recording in the parts (first, last) s of ``video``."""
    t, gimbal, body, geodetic = flown or airdata_flight()
    factor = {"feet": 0.3048, "meters": 1.0}.get(unit, 1.0)
    g, b = np.rad2deg(gimbal), np.rad2deg(body)
    lines = [",".join(columns).format(unit)]
    for i, s in enumerate(t):
        row = (
            f"{1000 * s:.0f}", f"2026-05-01 10:{int(s) // 60:02d}:{int(s) % 60:02d}", f"{geodetic[i, 0]:.9f}",
            f"{geodetic[i, 1]:.9f}", f"{geodetic[i, 2] / factor:.3f}", "3.1", f"{b[i, 2]:.4f}", f"{b[i, 1]:.4f}",
            f"{b[i, 0]:.4f}", "0", str(int(any(first <= s <= last for first, last in video))), f"{g[i, 2]:.4f}",
            f"{g[i, 1]:.4f}", f"{g[i, 0]:.4f}", '"Take-off, ""home"" set"' if i == 0 else "",
        )  # fmt: skip
        lines.append(",".join(row[: len(columns)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    return path
