"""Checks of the link: rates really achieved, delays, clocks, round trip."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import UNKNOWN, Autopilot, autopilot_of
from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.reports import MAX_LOSS
from drocap_ros.flight.preflight.findings import Finding, Measured, Stream, check, graded

_C = ConditionCode
_ENOUGH = 0.8  # share of a wanted rate: autopilots round intervals to their own loops
_MOST_SPREAD_S = 0.02  # of the clock's offset: at 25 deg/s half a degree of yaw
_MOST_BAD = 0.02  # share of the data: a wiring without errors has none
#: Parameter of the greatest age in flight, and the conditions that watch it, by message.
_STATUS = ("max_status_age_s", (_C.STATUS_OUTDATED,))
_WATCHED = {
    "ATTITUDE_QUATERNION": ("max_state_age_s", (_C.ATTITUDE_OUTDATED, _C.LINK_SILENT)),
    "LOCAL_POSITION_NED": ("max_state_age_s", (_C.POSITION_FROZEN,)),
    "HEARTBEAT": ("max_heartbeat_age_s", (_C.MODE_OUTDATED,)),
    **dict.fromkeys(("GPS_RAW_INT", "SYS_STATUS", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS"), _STATUS),
}
_MOUNT, _ECHO, _HEARTBEAT = "GIMBAL_DEVICE_ATTITUDE_STATUS", "POSITION_TARGET_LOCAL_NED", "HEARTBEAT"


def link_findings(config: MavlinkBridgeConfig, measured: Measured) -> Iterator[Finding]:
    """Everything about the link; the vehicle has been heard."""
    yield _packets(measured)
    if not measured.bridge:
        yield _losses(measured)
    if len(measured.systems) > 1:
        yield _several(config, measured)
    if measured.others or len(measured.addresses) > 1:
        yield _others(measured)
    for name, stream in measured.streams.items():
        if name != _MOUNT:  # the mount is a check of its own
            verdict, conditions = _rate(config, measured, name, stream)
            yield verdict.named(f"rate_{name.lower()}", f"rate of {name}", conditions)
    if len(measured.delays_s):
        yield _delay(config, measured)
    # A bridge's own conditions watch how long an answer takes, and not whether there has ever been one.
    if not (measured.bridge and len(measured.round_trips_s)):
        yield _round_trip(config, measured)
        if len(measured.round_trips_s) and len(measured.offsets_s) >= 2:
            yield _clock_offset(measured)


@check("link", "link")
def _packets(measured: Measured) -> Finding:
    share = measured.bad_count / max(measured.good_count + measured.bad_count, 1)
    values = {"messages": measured.good_count, "bad": measured.bad_count, "unsigned": measured.unsigned_count}
    found = measured.bridge or f"heard, {100 * share:.2g} % of the data is no MAVLink"
    wanted = "" if measured.bridge else f"at most {100 * _MOST_BAD:.0f} %"
    remedy = "check the baud rate and the wiring (ground, RX and TX)"
    return Finding(graded(warning=share > _MOST_BAD), found, wanted, remedy, values)


@check("packet_loss", "packets of the autopilot", _C.PACKETS_LOST)
def _losses(measured: Measured) -> Finding:
    lost = measured.packet_loss
    level = graded(missing=lost > MAX_LOSS, warning=lost > 0.5 * MAX_LOSS)
    wanted = f"below {100 * MAX_LOSS:.0f} %, above it no mode is requested"
    remedy = "let routers pass all packets of the autopilot, or mend the link"
    return Finding(level, f"{100 * lost:.0f} % lost", wanted, remedy, {"lost": lost})


#: Words of MAV_TYPE; others have their number.
_KINDS = {6: "ground station", 18: "companion computer", 26: "gimbal", 27: "ADS-B receiver", 30: "camera"}


@check("others", "who else is heard")
def _others(measured: Measured) -> Finding:
    """Every other component, and every address beside the one to which setpoints go."""
    others = [f"{_KINDS.get(kind, f'type {kind}')} {at[0]}/{at[1]}" for at, kind in sorted(measured.others.items())]
    (_, own), *rest = measured.addresses.items() or (("", frozenset()),)
    whose = [", ".join(f"{system}/{component}" for system, component in sorted(heard)) for _, heard in rest]
    addresses = [f"{at} ({who or 'no MAVLink'})" for (at, _), who in zip(rest, whose, strict=True)]
    twice = any(component == mavlink.MAV_COMP_ID_AUTOPILOT1 for _, heard in rest for _, component in heard & own)
    remedy = "let one sender alone pass the autopilot's packets: setpoints go where its last heartbeat came from"
    values = {"others": ", ".join(others), "addresses": ", ".join(addresses)}
    wanted = "the autopilot from one address" if rest else ""
    return Finding(graded(warning=twice), ", ".join([*others, *addresses]), wanted, remedy, values)


@check("vehicles", "vehicles on the link", _C.SEVERAL_VEHICLES)
def _several(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    names = ", ".join(map(str, sorted(measured.systems)))
    level, remedy = graded(missing=not config.target_system_id), "set target_system_id to the system of your vehicle"
    return Finding(level, f"systems {names}", "one, or a chosen one", remedy, {"systems": names})


def _rate(
    config: MavlinkBridgeConfig, measured: Measured, name: str, stream: Stream
) -> tuple[Finding, tuple[ConditionCode, ...]]:
    parameter, conditions = _WATCHED.get(name, ("", ()))
    limit_s, (real, wanted, gap_s) = float(getattr(config, parameter, 0.0)), stream
    found = f"{real:.1f} Hz" + (f", longest gap {gap_s:.2f} s" if real > 0 and math.isfinite(gap_s) else "")
    needed = f"{wanted:g} Hz, gaps below {limit_s:g} s" if limit_s else f"{wanted:g} Hz"
    autopilot = _autopilot(measured)
    short = not real >= config.rate_shortfall * wanted or real * limit_s < 1.0
    level, cause = _judged(stream, limit_s, short=short and bool(conditions))
    in_control = measured.vehicle is not None and measured.vehicle.mode == autopilot.control_mode
    if name == _ECHO and level != Level.OK and not in_control:
        level, found = Level.OK, f"{found}, as outside the control mode"
    elif name == _HEARTBEAT and level == Level.MISSING and real * limit_s >= 1.0:
        level, cause = Level.WARNING, f"the pilot's change of mode is seen up to {1 / real:.1f} s late; "
    remedy = cause + _own_port(autopilot)
    if level != Level.OK and name in measured.refused:
        found += f", refused with result {measured.refused[name]}"
        remedy = cause + "this autopilot grants no other rate"
    values = {"real_hz": real, "wanted_hz": wanted, "longest_gap_s": gap_s}
    return Finding(level, found, needed, remedy, values), conditions


def _judged(stream: Stream, limit_s: float, *, short: bool) -> tuple[Level, str]:
    """Level of a stream, and its cause; ``short``: with its rate, were it too low, no orbit is flown."""
    if not stream.real_hz >= _ENOUGH * stream.wanted_hz:
        return graded(missing=short, warning=True), ""
    if 0.0 < limit_s < stream.longest_gap_s:
        return Level.WARNING, f"a gap above {limit_s:g} s ends an orbit by a hold; "
    return Level.OK, ""


@check("telemetry_delay", "delay of telemetry", _C.ATTITUDE_OUTDATED)
def _delay(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    typical, late = (float(v) for v in np.percentile(measured.delays_s, (50, 99)))
    limit = config.max_state_age_s
    level = graded(missing=late > limit, warning=late > 0.5 * limit)
    found, wanted = _spread(typical, late), f"below {_ms(0.5 * limit)} (max_state_age_s {limit:g})"
    remedy = f"stop what loads this computer, or: {_own_port(_autopilot(measured))}"
    return Finding(level, found, wanted, remedy, {"median_s": typical, "p99_s": late})


@check("round_trip", "round trip", _C.ROUND_TRIP_TOO_LONG)
def _round_trip(config: MavlinkBridgeConfig, measured: Measured) -> Finding:
    limit = config.max_round_trip_s
    if not len(measured.round_trips_s):
        remedy = (
            "connect TX of this computer too, let the router pass TIMESYNC, and set signing_key_file if the autopilot "
            "drops unsigned packets"
        )
        return Finding(Level.MISSING, "no answer to time synchronization", f"below {limit:g} s", remedy)
    typical, late = (float(v) for v in np.percentile(measured.round_trips_s, (50, 99)))
    period_s = 1.0 / config.time_sync_hz
    worst = late + period_s  # the condition counts from the sending of the message that was answered last
    level = graded(missing=worst > limit, warning=worst > 0.7 * limit)
    wanted = f"with the period of {period_s:g} s below {limit:g} s (max_round_trip_s)"
    values = {"median_s": typical, "p99_s": late}
    return Finding(level, _spread(typical, late), wanted, _own_port(_autopilot(measured)), values)


@check("clock_offset", "clock of the autopilot")
def _clock_offset(measured: Measured) -> Finding:
    # The exchanges with the shortest round trips are the sure ones: the rest adds its queueing.
    chosen = np.flatnonzero(measured.round_trips_s <= np.percentile(measured.round_trips_s, 50))
    sure = measured.offsets_s[chosen]
    steady = sure - np.polyval(np.polyfit(chosen, sure, 1), chosen) if len(sure) > 2 else sure  # without a steady drift
    spread = float(np.ptp(np.percentile(steady, (5, 95))))
    values = {"spread_s": spread, "drift_s": float(np.median(sure))}
    remedy = (
        "a pose belongs to another instant than its image; stop NTP steps (chrony: makestep at the start only), and "
        "lower the load of the link"
    )
    level = graded(warning=spread > _MOST_SPREAD_S)
    return Finding(level, f"offset steady to {_ms(spread)}", f"to {_ms(_MOST_SPREAD_S)}", remedy, values)


def _own_port(autopilot: Autopilot) -> str:
    how = f"921600 baud{autopilot.hints.port}"
    return f"give the bridge a telemetry port of its own at {how}; a radio or a router thins the stream"


def _autopilot(measured: Measured) -> Autopilot:
    return UNKNOWN if measured.vehicle is None else autopilot_of(measured.vehicle.autopilot)


def _spread(typical_s: float, late_s: float) -> str:
    return f"{_ms(typical_s)} typical, {_ms(late_s)} in 99 %"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms"
