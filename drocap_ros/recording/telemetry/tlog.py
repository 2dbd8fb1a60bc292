"""States of the vehicle from a MAVLink ``.tlog``, by the estimator that serves the live link."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.recording.telemetry.read import UTC, TelemetryLog, make_log
from drocap_ros.recording.telemetry.tlog_packets import read_tlog

_MIN_UTC_NS = 1_000_000_000 * 10**9


def read_tlog_track(path: Path) -> TelemetryLog:
    """Attitude, position and gimbal of the first autopilot in the log, by the ground station's clock.

    Raises
    ------
    InputError
        When the file cannot be read, is no tlog, or tells no attitude.
    """
    from drocap_ros.errors import InputError
    from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator

    estimator, rows = VehicleStateEstimator(), []
    for message, received_ns in read_tlog(path):
        try:
            state = estimator.update(message, received_ns)
        except (ArithmeticError, ValueError):  # a damaged message that decodes all the same
            continue
        if state is not None:
            rows.append((state.stamp_ns, state.position_enu_m, state.orientation_xyzw, state.gimbal_orientation_xyzw))
    if not rows:
        raise InputError(f"{path}: expected the attitude of an autopilot, found none; was ATTITUDE streamed?")
    stamps, position, orientation, gimbal = (np.array([row[i] for row in rows]) for i in range(4))
    return make_log(
        path,
        "MAVLink tlog",
        stamps,
        clock=UTC,
        orientation=orientation,
        position=position,
        gimbal=gimbal,
        # A ground station without a clock begins at 1970.
        utc_minus_stamp_ns=0 if stamps[0] > _MIN_UTC_NS else None,
    )
