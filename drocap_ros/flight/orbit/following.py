"""Whether the vehicle follows the setpoints, by the autopilot's echo and the vehicle's motion, and keeps the orbit.

Autopilots stream POSITION_TARGET_LOCAL_NED throughout the control mode or in every mode, whether or not setpoints
arrive: its age shows nothing but the loss of the stream.  It contains the target that is followed: the setpoint,
continued until the time-out, which sets its velocity to zero, or the place as it came, with the correction of the
position in the velocity.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.autopilot import Autopilot
from drocap_ros.flight.bridge_config import OrbitConfig
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.orbit.motion_checks import away_limit_m
from drocap_ros.flight.vehicle import VehicleState

_SENT_S = 0.7  # a setpoint may be echoed for so long at most: two transmissions and the period of the echo
_ECHOED_S = 0.25  # two periods of the echo, and a step: beyond its age and two transmissions, and without agreement
#: Window in s, least commanded speed in m/s, and share of the commanded speed below which the vehicle stands for all
#: of the window.  In every recorded flight of the orbit it reached 0.46, and along the command, with the way, 0.27.
_BY_SPEED, _BY_WAY = (1.0, 0.6, 0.25), (2.0, 0.6, 0.15)


class Echoes(NamedTuple):
    """What the link knows of the setpoints.

    sent : (monotonic s, SET_POSITION_TARGET_LOCAL_NED) in order of time
    echo : (age in s, POSITION_TARGET_LOCAL_NED), or None before the first
    trip_s : since the sending of the message that was answered last: two transmissions at least; NaN = unknown
    """

    sent: Sequence[tuple[float, Message]]
    echo: tuple[float, Message] | None = None
    trip_s: float = math.nan


class Following:
    """Judges an orbit step by step.

    max_echo_age_s : time without any echo after which the setpoints count as not followed
    watchdog_s : time between two steps after which others hold the vehicle
    """

    def __init__(self, max_echo_age_s: float, watchdog_s: float) -> None:
        self._max_echo_age_s, self._watchdog_s = max_echo_age_s, watchdog_s
        self._stepped_s = self._stood_s = -math.inf
        self._matched_s = math.nan  # when an echo last agreed in this orbit
        self._by_speed, self._by_way = _Standing(*_BY_SPEED), _Standing(*_BY_WAY)

    def step(self, now_s: float, orbiting_s: float, echoes: Echoes, vehicle: VehicleState | None) -> str:
        """Why the setpoints count as not followed, in words; "" = they are followed, or it is not known.

        now_s : monotonic
        orbiting_s : how long the orbit has been flown; 0 = it is not
        """
        if orbiting_s == 0.0 or not echoes.sent or vehicle is None:
            self._matched_s = math.nan
            self._by_speed.clear()
            self._by_way.clear()
            return ""
        if now_s - self._stepped_s > self._watchdog_s:  # the echo is that of a hold that others have sent
            self._stood_s = now_s
        self._stepped_s, autopilot = now_s, autopilot_of(vehicle.autopilot)
        evidence = self._by_echo(now_s, orbiting_s, echoes, autopilot)
        return evidence or self._by_motion(now_s, echoes.sent[-1][1], vehicle, autopilot.position_gain_per_s)

    def _by_echo(self, now_s: float, orbiting_s: float, echoes: Echoes, autopilot: Autopilot) -> str:
        sent, echo, trip_s = echoes
        if echo is None:
            return ""
        age_s, target = echo
        if min(age_s, orbiting_s) > self._max_echo_age_s:
            return f"no echo of a target for {age_s:.1f} s"
        oldest_s = min(_SENT_S, age_s + trip_s + _ECHOED_S) if math.isfinite(trip_s) else _SENT_S
        followed = [message for at_s, message in sent if now_s - at_s <= oldest_s]
        if _agrees(target, followed, autopilot):
            self._matched_s = now_s
        elif now_s - self._stood_s < _ECHOED_S:
            return ""
        elif self._matched_s == self._matched_s and _stands(target) and not any(map(_stands, followed)):
            return "the autopilot has stopped by its time-out, without setpoints"
        # NaN: its content has not agreed yet, and is not judged.
        return "the autopilot's target is none that was sent" if now_s - self._matched_s > _ECHOED_S else ""

    def _by_motion(self, now_s: float, setpoint: Message, vehicle: VehicleState, gain_per_s: float) -> str:
        flown = vehicle.velocity_enu_m_s[:2]
        commanded = np.array([setpoint.vy, setpoint.vx], dtype=float)
        along_m_s = float(np.hypot(*commanded))
        # Before a vehicle that stands the reference waits: its speed falls, and the way to its place remains.
        way = np.array([setpoint.y, setpoint.x], dtype=float) - vehicle.position_enu_m[:2]
        # A walking subject in wind keeps the vehicle at a distance from its place, and it flies.
        commanded += gain_per_s * min(1.0, 1.0 / max(float(np.hypot(*way)), 1e-6)) * way
        speed_m_s = float(np.hypot(*commanded))
        # A vehicle stands where the way to its place and the velocity there cancel, as after an adjustment.
        stands = self._by_speed.judge(now_s, min(along_m_s, speed_m_s), float(np.hypot(*flown)))
        # Along the command: after a stop a vehicle may spring back.
        return self._by_way.judge(now_s, speed_m_s, float(flown @ commanded) / max(speed_m_s, 1e-6)) or stands


class _Standing:
    """Speeds of the last ``window_s``, where at least ``least_m_s`` was commanded in each step.

    share : of the mean commanded speed; a vehicle that was slower in each step stands
    """

    def __init__(self, window_s: float, least_m_s: float, share: float) -> None:
        self._window_s, self._least_m_s, self._share = window_s, least_m_s, share
        self._speeds: deque[tuple[float, float, float]] = deque()  # time, commanded m/s, flown m/s

    def clear(self) -> None:
        self._speeds.clear()

    def judge(self, now_s: float, commanded_m_s: float, flown_m_s: float) -> str:
        """Take the speeds of a step; returns how the vehicle stands, in words; "" = it does not, or it is not known."""
        if not commanded_m_s >= self._least_m_s:  # NaN: not judged
            self._speeds.clear()
            return ""
        self._speeds.append((now_s, commanded_m_s, flown_m_s))
        whole = now_s - self._speeds[0][0] >= self._window_s
        while now_s - self._speeds[0][0] > self._window_s:
            self._speeds.popleft()
        mean = sum(wanted for _, wanted, _ in self._speeds) / len(self._speeds)
        fastest = max(flown for _, _, flown in self._speeds)
        if whole and fastest < self._share * mean:
            return f"it flies at {max(fastest, 0.0):.1f} m/s where {mean:.1f} m/s are commanded"
        return ""


class Keeping:
    """How long the vehicle has been too far from its place on the orbit: the reference waits, and it does not come.

    Wind can be stronger than the vehicle, and a subject faster.
    """

    def __init__(self, config: OrbitConfig) -> None:
        self._limit_m = away_limit_m(config)
        self._near_s = 0.0

    def watch(self, reference: np.ndarray | None, position: np.ndarray, now_s: float) -> tuple[float, float]:
        """Distance in m from the place on the orbit (3,), and for how long it has been too far; None = no orbit."""
        away_m = 0.0 if reference is None else float(np.hypot(*(reference - position)[:2]))
        if not away_m > self._limit_m:  # NaN: other conditions decide
            self._near_s = now_s
        return away_m, now_s - self._near_s


def _stands(target: Message) -> bool:
    """Whether a target has no velocity."""
    # The time-out writes zeros.
    return math.hypot(target.vx, target.vy) < 1e-3


def _agrees(echo: Message, sent: list[Message], most: Autopilot) -> bool:
    """Whether the echoed target lies on the way of a setpoint, and has its velocity."""
    place = np.array([echo.x, echo.y], dtype=float)
    if not sent or not np.isfinite(place).all():
        return False
    begin = np.array([[m.x, m.y] for m in sent], dtype=float)
    velocity = np.array([[m.vx, m.vy] for m in sent], dtype=float)
    # The echoed place may be ahead along the velocity by half a second.
    way = 0.5 * velocity
    part = ((place - begin) * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-9)
    nearest = begin + np.clip(part, 0.0, 1.0)[:, None] * way
    near = np.hypot(*(place - nearest).T) <= most.echo_m
    if math.isfinite(most.echo_m_s):
        near &= np.hypot(*(np.array([echo.vx, echo.vy], dtype=float) - velocity).T) <= most.echo_m_s
    return bool(near.any())
