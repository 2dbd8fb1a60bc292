"""Configuration of a short simulated capture through the live nodes."""

from __future__ import annotations

from drocap_ros.config import DrocapConfig

FLIGHT = ("capture_simulator", "initializer", "bundle_adjuster", "session_recorder")


def flight_config(session_dir, seconds=4.0):
    config = DrocapConfig().replace("capture_simulator", seconds=seconds, rate_hz=15.0, seed=3)
    config = config.replace("bundle_adjuster", limb_iterations=3, period_s=0.5)
    return config.replace("session_recorder", session_dir=str(session_dir))
