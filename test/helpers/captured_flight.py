"""Keypoints of a simulated capture as a session, which ``session_player`` publishes to the live nodes."""

from __future__ import annotations

import time
from pathlib import Path

from recorded import NAMES, Messages, record

from drocap_ros.config import DrocapConfig
from lab.simulation.capture import simulate_capture

FLIGHT = ("session_player", "initializer", "bundle_adjuster", "session_recorder")


def captured_config(folder: Path, seconds=4.0, rate_hz=15.0, seed=3) -> DrocapConfig:
    """Configuration of a player of ``pose2d`` and ``camera_info`` from now on, which it writes to a folder."""
    tracks, messages, entries = simulate_capture(seconds, rate_hz, seed).tracks, Messages(), []
    (width, height), start_ns = tracks.image_size, time.time_ns()
    for i, offset_ns in enumerate(tracks.stamp_ns.tolist()):
        stamp_ns = start_ns + offset_ns
        info = messages(
            NAMES["info"], header=messages.header(stamp_ns), width=width, height=height, k=tracks.camera_matrix.ravel()
        )
        seen = messages.pose2d(tracks, i, stamp_ns)
        entries += [("/drocap/pose2d", seen, stamp_ns, messages.cdr(seen))]
        entries += [("/drocap/camera_info", info, stamp_ns, messages.cdr(info))]
    session = record(folder / f"capture_{seed}", entries)
    return DrocapConfig().replace("session_player", session=str(session), clock=False, delay_s=2.0)


def flight_config(session_dir, folder: Path, seconds=4.0):
    """That of ``FLIGHT``: a recording into ``session_dir``, its keypoints beside it in ``folder``."""
    config = captured_config(folder, seconds).replace("bundle_adjuster", limb_iterations=3, period_s=0.5)
    return config.replace("session_recorder", session_dir=str(session_dir))
