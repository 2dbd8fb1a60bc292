"""Checks of the link: rates really achieved, delays, clocks, round trip."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from drocap_ros.flight.autopilot import UNKNOWN, Autopilot, autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.findings import Finding, Level
from drocap_ros.flight.mavlink.mode_reports import MAX_LOSS
from drocap_ros.flight.preflight.measured import Measured, Stream

_C = ConditionCode
_ENOUGH = 0.8
_MOST_SPREAD_S = 0.02
_MOST_BAD = 0.02
_MOUNT, _ECHO, _HEARTBEAT = "GIMBAL_DEVICE_ATTITUDE_STATUS", "POSITION_TARGET_LOCAL_NED", "HEARTBEAT"


def link_findings(config: MavlinkBridgeConfig, measured: Measured) -> Iterator[Finding]:
    """Everything about the link; the vehicle has been heard."""
    yield _packets(measured)
    if not measured.bridge:
        yield _losses(measured)
    if len(measured.systems) > 1:
        yield _several(config, measured)
    for name, stream in measured.streams.items():
        if name != _MOUNT:  # the mount is a check of its own
            yield _rate(config, measured, name, stream)
    if len(measured.delays_s):
        yield _delay(config, measured)
    # A bridge's own conditions watch how long an answer takes, and not whether there has ever been one.
    if not (measured.bridge and len(measured.round_trips_s)):
        yield from _time_sync(config, measured)


def _packets(measured: Measured) -> Finding:
    whole = max(measured.good_count + measured.bad_count, 1)
    share = measured.bad_count / whole
    bad = share > _MOST_BAD
    return Finding(
        "link", "link", Level.WARNING if bad else Level.OK,
        measured.bridge or f"heard, {100 * share:.2g} % of the data is no MAVLink",
        "" if measured.bridge else f"at most {100 * _MOST_BAD:.0f} %",
        "check the baud rate and the wiring (ground, RX and TX)" if bad else "",
        {"messages": measured.good_count, "bad": measured.bad_count, "unsigned": measured.unsigned_count},
    )  # fmt: skip


def _losses(measured: Measured) -> Finding:
    lost = measured.packet_loss
    level = Level.MISSING if lost > MAX_LOSS else Level.WARNING if lost > 0.5 * MAX_LOSS else Level.OK
    return Finding(
        "packet_loss", "packets of the autopilot", level, f"{100 * lost:.0f} % lost",
        f"below {100 * MAX_LOSS:.0f} %, above it no mode is requested",
        "" if level == Level.OK else "let routers pass all packets of the autopilot, or mend the link",
        {"lost": lost}, (_C.PACKETS_LOST,),
    )  # fmt: skip


def _several(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    names = ", ".join(map(str, sorted(measured.systems)))
    chosen = config.target_system_id
    return Finding(
        "vehicles", "vehicles on the link", Level.OK if chosen else Level.MISSING, f"systems {names}",
        "one, or a chosen one", "" if chosen else "set target_system_id to the system of your vehicle",
        {"systems": names}, (_C.SEVERAL_VEHICLES,),
    )  # fmt: skip


def _rate(config: MavlinkBridgeConfig, measured: Measured, name: str, stream: Stream) -> Finding:
    (limit_s, code), own_port = _limit(config, name), _own_port(measured)
    real, wanted, gap_s = stream
    found = f"{real:.1f} Hz" + (f", longest gap {gap_s:.2f} s" if real > 0 and math.isfinite(gap_s) else "")
    needed = f"{wanted:g} Hz, gaps below {limit_s:g} s" if limit_s else f"{wanted:g} Hz"
    level, remedy = Level.OK, ""
    if limit_s and real >= _ENOUGH * wanted and gap_s > limit_s:
        level, remedy = Level.WARNING, f"a gap above {limit_s:g} s ends an orbit by a hold; {own_port}"
    elif not real >= _ENOUGH * wanted:
        short = not real >= config.rate_shortfall * wanted or real * limit_s < 1.0
        level, remedy = Level.MISSING if short and code else Level.WARNING, own_port
    if name == _ECHO and level != Level.OK and not _in_control_mode(measured):
        level, remedy = Level.OK, ""
        found += ", as outside the control mode"
    elif name == _HEARTBEAT and level == Level.MISSING and real * limit_s >= 1.0:
        level, remedy = Level.WARNING, f"the pilot's change of mode is seen up to {1 / real:.1f} s late; {own_port}"
    if level != Level.OK and name in measured.refused:
        found += f", refused with result {measured.refused[name]}"
        remedy = remedy.replace(own_port, "this autopilot grants no other rate")
    return Finding(
        f"rate_{name.lower()}", f"rate of {name}", level, found, needed, remedy,
        {"real_hz": real, "wanted_hz": wanted, "longest_gap_s": gap_s}, code,
    )  # fmt: skip


def _limit(config: MavlinkBridgeConfig, name: str) -> tuple[float, tuple[ConditionCode, ...]]:
    """Greatest age of the message in flight, 0 = none, and the conditions that watch it."""
    if name == "ATTITUDE_QUATERNION":
        return config.max_state_age_s, (_C.ATTITUDE_OUTDATED, _C.LINK_SILENT)
    if name == "LOCAL_POSITION_NED":
        return config.max_state_age_s, (_C.POSITION_FROZEN,)
    if name == _HEARTBEAT:
        return config.max_heartbeat_age_s, (_C.MODE_OUTDATED,)
    if name in ("GPS_RAW_INT", "SYS_STATUS", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS"):
        return config.max_status_age_s, (_C.STATUS_OUTDATED,)
    return 0.0, ()


def _delay(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    typical, late = (float(v) for v in np.percentile(measured.delays_s, (50, 99)))
    limit = config.max_state_age_s
    level = Level.MISSING if late > limit else Level.WARNING if late > 0.5 * limit else Level.OK
    return Finding(
        "telemetry_delay", "delay of telemetry", level, f"{_ms(typical)} typical, {_ms(late)} in 99 %",
        f"below {_ms(0.5 * limit)} (max_state_age_s {limit:g})",
        "" if level == Level.OK else f"stop what loads this computer, or: {_own_port(measured)}",
        {"median_s": typical, "p99_s": late}, (_C.ATTITUDE_OUTDATED,),
    )  # fmt: skip


def _time_sync(config: MavlinkBridgeConfig, measured: Measured) -> Iterator[Finding]:
    trips = measured.round_trips_s
    if not len(trips):
        yield Finding(
            "round_trip", "round trip", Level.MISSING, "no answer to time synchronization",
            f"below {config.max_round_trip_s:g} s",
            "connect TX of this computer too, let the router pass TIMESYNC, and set signing_key_file if the autopilot "
            "drops unsigned packets", {}, (_C.ROUND_TRIP_TOO_LONG,),
        )  # fmt: skip
        return
    typical, late = (float(v) for v in np.percentile(trips, (50, 99)))
    # The condition counts from the sending of the message that was answered last.
    worst = late + 1.0 / config.time_sync_hz
    limit = config.max_round_trip_s
    level = Level.MISSING if worst > limit else Level.WARNING if worst > 0.7 * limit else Level.OK
    yield Finding(
        "round_trip", "round trip", level, f"{_ms(typical)} typical, {_ms(late)} in 99 %",
        f"with the period of {1 / config.time_sync_hz:g} s below {limit:g} s (max_round_trip_s)",
        "" if level == Level.OK else _own_port(measured), {"median_s": typical, "p99_s": late},
        (_C.ROUND_TRIP_TOO_LONG,),
    )  # fmt: skip
    if len(measured.offsets_s) < 2:
        return
    # The exchanges with the shortest round trips are the sure ones: the rest adds its queueing.
    sure = measured.offsets_s[trips <= np.percentile(trips, 50)]
    spread = float(np.ptp(np.percentile(sure, (5, 95))))
    offset = float(np.median(sure))
    unsteady = spread > _MOST_SPREAD_S
    yield Finding(
        "clock_offset", "clock of the autopilot", Level.WARNING if unsteady else Level.OK,
        f"offset steady to {_ms(spread)}", f"to {_ms(_MOST_SPREAD_S)}",
        "a pose belongs to another instant than its image; stop NTP steps (chrony: makestep at the start only), and "
        "lower the load of the link" if unsteady else "",
        {"spread_s": spread, "drift_s": offset},
    )  # fmt: skip


def _in_control_mode(measured: Measured) -> bool:
    return measured.vehicle is not None and measured.vehicle.mode == _autopilot(measured).control_mode


def _own_port(measured: Measured) -> str:
    port = _autopilot(measured).hints.port
    return f"give the bridge a telemetry port of its own at 921600 baud{port}; a radio or a router thins the stream"


def _autopilot(measured: Measured) -> Autopilot:
    return UNKNOWN if measured.vehicle is None else autopilot_of(measured.vehicle.autopilot)


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms"
